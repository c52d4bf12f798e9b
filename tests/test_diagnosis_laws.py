from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.edge_scores import area_under_roc
from diagnosis_graphs import measured, near_pairs, poses_on_a_ring, spoiled
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG
from hodge_pipeline.diagnosis.short_cycles import short_cycles
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import ViewGraph

QUICK = DiagnosisOptions()


@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_right_edges_alone_are_never_blamed(seed: int) -> None:
    graph = measured(poses_on_a_ring(14, seed), near_pairs(14, 3), seed)
    found = diagnose(graph, QUICK)
    assert set(found.verdict) == {CONSISTENT} and found.kept.all() and found.probability.min() > 0.5
    bridged = replace(graph.select(np.arange(13)), source=graph.source[:13])
    chain = diagnose(bridged, QUICK)
    assert set(chain.verdict) == {UNTESTABLE} and np.isnan(chain.probability).all()
    assert chain.kept.all(), "untestable is not the same as bad"


def test_one_wrong_edge_is_found_with_its_witnesses() -> None:
    graph, right = spoiled(measured(poses_on_a_ring(16), near_pairs(16, 3)), np.array([20]))
    found = diagnose(graph, QUICK)
    assert found.verdict[20] == WRONG and (found.verdict[right] == CONSISTENT).all()
    (row, *_) = found.witnesses_against[20]
    assert row >= 0 and not found.cycles.closes[row]
    entry = slice(found.cycles.loops.offsets[row], found.cycles.loops.offsets[row + 1])
    assert 20 in found.cycles.loops.edge[entry]
    assert "fails by" in found.reason[20] and "cycles close" in found.reason[20]
    assert found.leverage[20] == 0 and found.residual_m[20] > 0.3


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_many_wrong_edges_are_told_apart_and_left_out_of_the_poses(share: float) -> None:
    poses = poses_on_a_ring(24)
    clean = measured(poses, near_pairs(24, 6))
    rng = np.random.default_rng(3)
    wrong = rng.choice(clean.edge_count, int(share * clean.edge_count), replace=False)
    graph, right = spoiled(clean, wrong)
    found = diagnose(graph, QUICK)
    assert area_under_roc(found.probability, right) > 0.97
    main = np.flatnonzero(found.piece == 0)
    assert len(main) >= 20
    relative = se3.inverse(found.world_from_cam[main[0]]) @ found.world_from_cam[main]
    expected = se3.inverse(poses[main[0]]) @ poses[main]
    assert np.abs(relative[:, :3, 3] - expected[:, :3, 3]).max() < 0.1


def test_relabelling_and_turning_edges_round_changes_no_verdict() -> None:
    clean = measured(poses_on_a_ring(16), near_pairs(16, 4))
    graph, _ = spoiled(clean, np.array([5, 20, 33]))
    options = DiagnosisOptions(order_prior=False)
    first = diagnose(graph, options)
    rng = np.random.default_rng(0)
    names, order = rng.permutation(16), rng.permutation(graph.edge_count)
    relabelled = ViewGraph.from_edges(np.arange(16), names[graph.edges][order], graph.i_from_j[order])
    assert (diagnose(relabelled, options).verdict == first.verdict[order]).all()
    turned = ViewGraph.from_edges(graph.vertex_ids, graph.edges[:, ::-1], se3.inverse(graph.i_from_j))
    assert (diagnose(turned, options).verdict == first.verdict).all()


def test_a_chain_with_one_bad_loop_edge_blames_the_loop_and_names_it() -> None:
    """0 - 1 - 2 - ... - 9, and 9 back to 0 by a wrong edge: one loop, nobody to say which edge."""
    k = np.arange(10)
    edges = np.concatenate([np.stack([k[:-1], k[1:]], axis=1), [[9, 0]]])
    graph, _ = spoiled(measured(poses_on_a_ring(10), edges), np.array([9]))
    found = diagnose(graph)
    assert not (found.verdict == CONSISTENT).any(), "nothing vouches for any edge of this loop"
    assert set(found.verdict) <= {UNTESTABLE, WRONG, SUSPECT}
    assert "9-0-1-2-3-4" in found.reason[9] and "fails by" in found.reason[9]


def test_two_scenes_are_two_pieces_and_a_wrong_edge_does_not_glue_them() -> None:
    one, two = measured(poses_on_a_ring(12), near_pairs(12, 3)), measured(poses_on_a_ring(12, 1), near_pairs(12, 3), 1)
    edges = np.concatenate([one.edges, two.edges + 12, [[3, 15], [8, 20]]])
    motion = np.concatenate([one.i_from_j, two.i_from_j, np.eye(4)[None].repeat(2, 0)])
    motion[-2:, :3, 3] = [[5, 0, 0], [0, 0, 5]]
    found = diagnose(ViewGraph.from_edges(np.arange(24), edges, motion), QUICK)
    assert (found.verdict[:-2] == CONSISTENT).all() and not (found.verdict[-2:] == CONSISTENT).any()


def test_copies_of_edges_tell_nothing_of_how_exact_the_others_are() -> None:
    once = measured(poses_on_a_ring(40), near_pairs(40, 1))
    across = measured(poses_on_a_ring(40), np.array([[k, k + 20] for k in range(0, 20, 4)]))
    twice = [once.i_from_j, once.i_from_j, across.i_from_j]
    edges = np.concatenate([once.edges, once.edges, across.edges])
    stated = np.diag(1 / np.repeat([0.005, 0.01], 3) ** 2)
    graph = ViewGraph.from_edges(np.arange(40), edges, np.concatenate(twice))
    graph = replace(graph, information=np.tile(stated, (graph.edge_count, 1, 1)))
    assert diagnose(graph).kept.all()


def test_information_that_explains_nearly_all_cycles_is_believed() -> None:
    """One edge in eight is as exact as the information says, the others a hundred times as exact."""
    poses, edges = poses_on_a_ring(40), near_pairs(40, 4)
    loose, tight = measured(poses, edges), measured(poses, edges, 1, noise=0.01)
    information = np.tile(np.diag(1 / np.repeat([0.005, 0.01], 3) ** 2), (len(edges), 1, 1))
    motion = np.where((np.arange(len(edges)) < 140)[:, None, None], tight.i_from_j, loose.i_from_j)
    graph = replace(ViewGraph.from_edges(np.arange(40), edges, motion), information=information)
    assert diagnose(graph).kept.all()
    for rows in (np.array([7]), np.arange(5, len(edges), 15)):
        bad, right = spoiled(graph, rows)
        found = diagnose(replace(bad, information=information))
        assert not found.kept[~right].any() and found.kept[right].mean() > 0.95


def test_the_same_seed_gives_the_same_answer() -> None:
    graph, _ = spoiled(measured(poses_on_a_ring(16), near_pairs(16, 4)), np.arange(0, 60, 3))
    first, second = diagnose(graph, QUICK), diagnose(graph, QUICK)
    np.testing.assert_array_equal(first.probability, second.probability)
    np.testing.assert_array_equal(first.world_from_cam, second.world_from_cam)


def test_empty_and_odd_graphs_have_answers_and_bad_numbers_are_refused() -> None:
    empty = ViewGraph.from_edges(np.arange(3), np.zeros((0, 2), int), np.zeros((0, 4, 4)))
    assert diagnose(empty).verdict.shape == (0,)
    loop = ViewGraph.from_edges(np.arange(2), np.array([[0, 0], [0, 1]]), np.eye(4)[None].repeat(2, 0))
    assert (diagnose(loop).verdict == UNTESTABLE).all()
    bad = np.eye(4)[None].copy()
    bad[0, 0, 3] = np.nan
    with pytest.raises(GraphError, match="not finite"):
        diagnose(ViewGraph.from_edges(np.arange(2), np.array([[0, 1]]), bad))
    with pytest.raises(GraphError, match="vertex row"):
        diagnose(ViewGraph.from_edges(np.arange(2), np.array([[0, 7]]), np.eye(4)[None]))


def test_no_cycle_is_listed_twice() -> None:
    k = np.arange(12)
    rings = [np.stack([k, (k + 1) % 12], 1), np.stack([k + 12, (k + 1) % 12 + 12], 1)]
    grid = np.concatenate([*rings, np.stack([k, k + 12], 1)])
    loops = short_cycles(np.concatenate([grid, grid[:2]]), 24, 64)
    named = [tuple(sorted(loops.edge[a:b].tolist())) for a, b in pairwise(loops.offsets.tolist())]
    assert len(set(named)) == len(named) and set(loops.edge.tolist()) == set(range(38))
    assert {len(name) for name in named} >= {2, 4}


def test_a_reason_names_what_spoke_against_an_edge_whose_cycles_all_close() -> None:
    # the two edges 2-9 close over each other, and over nothing else
    clean = measured(poses_on_a_ring(16), np.concatenate([near_pairs(16, 3), [[2, 9]] * 2]))
    graph, _ = spoiled(clean, np.array([48, 49]))
    motion = graph.i_from_j.copy()
    motion[49] = motion[48]
    found = diagnose(replace(graph, i_from_j=motion), QUICK)
    for row in (48, 49):
        assert found.verdict[row] == WRONG
        assert found.reason[row].startswith("1 of 1 cycles close, each over another edge that is left out; against it")

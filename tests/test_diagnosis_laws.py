from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from backbone_graphs import drive
from benchmarks.edge_scores import area_under_roc
from diagnosis_graphs import SIGMA, every_pair_tried, measured, near_pairs, poses_on_a_ring, spoiled
from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import chi2_by_information, mean_variances, residual_twists, squares_at_both_ends
from hodge_pipeline.complex.short_cycles import short_cycles
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.diagnosis.wording import name_cycle
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.solvers.backbone.linear import linearise
from hodge_pipeline.solvers.backbone.scales import Scales
from hodge_pipeline.solvers.backbone.trust import NONE, SEQUENTIAL, find_backbone
from hodge_pipeline.types import Floats, Ints, ViewGraph
from test_backbone import chain_of

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
    found = diagnose(graph, DiagnosisOptions(trust=NONE))
    assert found.verdict[20] == WRONG and (found.verdict[right] == CONSISTENT).all()
    (row, *_) = found.witnesses_against[20]
    assert row >= 0 and not found.cycles.closes[row]
    entry = slice(found.cycles.loops.offsets[row], found.cycles.loops.offsets[row + 1])
    assert 20 in found.cycles.loops.edge[entry]
    assert "fails by" in found.reason[20] and "cycles close" in found.reason[20]
    assert found.leverage[20] == 0 and found.residual_m[20] > 0.3


@pytest.mark.parametrize("share", [0.1, 0.5])
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


def turned_round(graph: ViewGraph, rows: Ints) -> ViewGraph:
    """The same measurements with these edges written the other way round, their information moved along."""
    edges, motion, information = graph.edges.copy(), graph.i_from_j.copy(), graph.information.copy()
    edges[rows], motion[rows] = edges[rows, ::-1], se3.inverse(motion[rows])
    back = se3.adjoint(motion[rows])
    information[rows] = np.swapaxes(back, 1, 2) @ information[rows] @ back
    return replace(graph, edges=edges, i_from_j=motion, information=information)


def correlated(seed: int) -> tuple[ViewGraph, Floats]:
    """36 right edges whose errors of rotation act from 4 m away, with their information, and the true poses."""
    rng, poses, edges = np.random.default_rng(seed), poses_on_a_ring(12, seed), near_pairs(12, 3)
    shape = SIGMA[:, None] * rng.normal(size=(len(edges), 6, 6)) * 0.3
    covariance = shape @ np.swapaxes(shape, 1, 2) + np.diag(SIGMA**2)
    far = se3.adjoint(se3.from_parts(np.eye(3), np.array([0.0, 0.0, 4.0])))
    covariance = far @ covariance @ far.T
    xi = np.einsum("eij,ej->ei", np.linalg.cholesky(covariance), rng.normal(size=(len(edges), 6)))
    motion = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ se3.exp(xi)
    graph = ViewGraph.from_edges(np.arange(12), edges, motion)
    return replace(graph, information=np.linalg.inv(covariance)), poses


def test_the_chi2_of_an_edge_is_the_same_written_the_other_way_round() -> None:
    graph, poses = correlated(0)
    turned = turned_round(graph, np.arange(0, 36, 2))
    np.testing.assert_allclose(chi2_by_information(turned, poses), chi2_by_information(graph, poses), rtol=1e-8)
    for one, other in zip(mean_variances(turned, False), mean_variances(graph, False), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    squares = [squares_at_both_ends(each.i_from_j, residual_twists(each, poses)) for each in (graph, turned)]
    np.testing.assert_allclose(squares[0], squares[1], rtol=1e-8, atol=1e-15)


@pytest.mark.parametrize("views", [30, 50])
def test_the_diagnosis_of_edges_written_the_other_way_round_is_the_same_to_rounding(views: int) -> None:
    """A scene in which every pair was tried, judged on its steps or, of more views, without: one other choice in its
    long search would end elsewhere.
    """
    graph, _, _ = every_pair_tried(2, views)
    rng = np.random.default_rng(2)
    rows = np.flatnonzero(rng.random(graph.edge_count) < 0.5)
    edges, motion = graph.edges.copy(), graph.i_from_j.copy()
    edges[rows], motion[rows] = edges[rows, ::-1], se3.inverse(motion[rows])
    first, second = diagnose(graph), diagnose(replace(graph, edges=edges, i_from_j=motion))
    assert (first.verdict == second.verdict).all()
    np.testing.assert_allclose(first.probability, second.probability, atol=1e-6)
    np.testing.assert_allclose(first.world_from_cam, second.world_from_cam, atol=1e-6)
    named = [
        name_cycle(each, found.cycles, 0) for each, found in ((graph, first), (replace(graph, edges=edges), second))
    ]
    assert named[0] == named[1]


def test_unknown_errors_hold_at_both_ends_on_a_backbone() -> None:
    """Whichever end a sequence is numbered from, and whichever way an edge is written."""
    made = drive(seed=3, count=60, loops=20, wrong=0.0, dimension=3)
    noise = se3.exp(1e-6 * np.random.default_rng(0).normal(size=(made.graph.edge_count, 6)))
    motion = se3.between(made.truth, made.graph.edges) @ noise
    graph = ViewGraph.from_edges(made.graph.vertex_ids, made.graph.edges, motion)
    from_the_end, chi2 = replace(graph, edges=graph.vertex_count - 1 - graph.edges), []
    for each in (graph, from_the_end):
        linear = linearise(chain := Scales(0.3, 0.1, 0.2, 0.05).applied(chain_of(each)), chain.poses)
        residual, covariance = linear.loops
        found = mahalanobis(residual, covariance + linear.path(*chain.ends.T).astype(float))[0]
        chi2.append(found[np.argsort(chain.loop_edge)])
    np.testing.assert_allclose(chi2[0], chi2[1], rtol=1e-4)
    backbone, edges = find_backbone(graph, SEQUENTIAL), graph.edges[:, ::-1]
    assert backbone is not None
    written = [backbone.weighted(each) for each in (graph, replace(graph, edges=edges, i_from_j=se3.inverse(motion)))]
    np.testing.assert_allclose(*(chi2_by_information(each, made.truth) for each in written), rtol=1e-4)


def test_scales_that_the_search_finds_twofold_apart_do_not_differ_much() -> None:
    """Rounding told 18 of 33 such pairs from the others."""
    for step in range(-16, 17):
        scale, near, far = (Scales(loop_turn=float(2 ** ((step + more) / 2))) for more in (0, 2, 3))
        assert scale.differ_much(far) and far.differ_much(scale) and not scale.differ_much(near)


@pytest.mark.parametrize("seed", range(4))
def test_robust_keeps_the_same_right_edges_written_either_way(seed: int) -> None:
    """Judged by the isotropic weights of the frame that an edge happens to name second, 8 to 13 of 36 were lost."""
    graph, _ = correlated(seed)
    kept = solve_robust(graph).weights > 0
    turned = solve_robust(turned_round(graph, np.arange(0, 36, 2))).weights > 0
    assert (kept == turned).all()
    assert (~kept).sum() <= 3


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


@pytest.mark.parametrize("sigma", [None, 0.01, 0.1])
@pytest.mark.parametrize("group", [1, 8])
def test_edges_that_were_made_of_poses_do_not_excuse_wrong_ones(sigma: float | None, group: int) -> None:
    """Cycles of near views close exactly; those of wrong edges that happen to close tell of no errors."""
    count, rng = 40, np.random.default_rng(2)
    near = near_pairs(count, 3)
    begin = rng.integers(0, count - group, (104 // group, 2))
    far = (begin[:, None] + np.arange(group)[:, None]).reshape(-1, 2)
    edges = np.concatenate([near, far])
    graph = measured(poses_on_a_ring(count), edges, noise=1e-5)
    motions = graph.i_from_j.copy()
    motions[len(near) :] = np.repeat(motions[rng.integers(0, len(near), len(begin))], group, axis=0)
    graph = ViewGraph.from_edges(graph.vertex_ids, edges, motions)
    if sigma is not None:
        graph = replace(graph, information=np.tile(np.eye(6) / sigma**2, (len(edges), 1, 1)))
    wrong = (np.arange(len(edges)) >= len(near)) & (np.abs(np.diff(edges, axis=1)[:, 0]) > 3)
    found = diagnose(graph)
    assert found.kept[: len(near)].all() and found.kept[wrong].sum() <= 2


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


@pytest.mark.parametrize("seed", range(3))
def test_steps_that_state_their_errors_are_not_judged_by_the_unit_of_loops(seed: int) -> None:
    """Loops that state hundreds of times their errors, as a constant covariance does, and steps that state theirs."""
    poses, steps, loops = poses_on_a_ring(60), *np.split(near_pairs(60, 4), [60])
    one, others = measured(poses, steps, seed), measured(poses, loops, seed + 1, noise=0.2)
    stated = SIGMA * np.repeat([1, 30], (len(steps), len(loops)))[:, None]
    information = np.eye(6) / stated[:, :, None] ** 2
    edges, motion = np.concatenate([steps, loops]), np.concatenate([one.i_from_j, others.i_from_j])
    graph = ViewGraph.from_edges(np.arange(60), edges, motion, information)
    assert diagnose(graph, DiagnosisOptions(trust=NONE)).kept.all()


@pytest.mark.parametrize("seed", range(3))
def test_what_the_information_states_holds_where_the_poses_are_and_not_where_they_turn_about(seed: int) -> None:
    """Poses on a sphere of 100 m turn about its middle, where an error of rotation is a hundred times as far."""
    number = np.arange(64)
    tilt = np.pi * number / 64 - np.pi / 2
    turn = se3.so3_exp(np.outer(np.pi * number / 4, [0, 0, 1])) @ se3.so3_exp(np.outer(tilt, [0, 1, 0]))
    edges = np.concatenate([np.stack([number, number + step], axis=1)[:-step] for step in (1, 7, 8, 9)])
    poses, sigma = se3.from_parts(turn, 100 * turn[:, :, 0]), np.repeat([0.01, 0.01], 3)
    noise = se3.exp(sigma * np.random.default_rng(seed).normal(size=(len(edges), 6)))
    motion = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ noise
    graph = ViewGraph.from_edges(number, edges, motion, np.tile(np.diag(1 / sigma**2), (len(edges), 1, 1)))
    assert diagnose(graph).kept.all()


def test_the_same_graph_gives_the_same_answer() -> None:
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


def test_a_reason_names_the_evidence_against_an_edge_whose_cycles_all_close() -> None:
    # the two edges 2-9 close over each other, and over nothing else
    clean = measured(poses_on_a_ring(16), np.concatenate([near_pairs(16, 3), [[2, 9]] * 2]))
    graph, _ = spoiled(clean, np.array([48, 49]))
    motion = graph.i_from_j.copy()
    motion[49] = motion[48]
    found = diagnose(replace(graph, i_from_j=motion), QUICK)
    for row in (48, 49):
        assert found.verdict[row] == WRONG
        reason = "1 of 1 cycles close, each over another edge that is left out; all kept edges together place its ends"
        assert found.reason[row].startswith(reason)


def test_pieces_of_a_lattice_that_wrong_edges_cut_grow_again() -> None:
    rng = np.random.default_rng(0)
    at = np.stack([*np.divmod(np.arange(16 * 16), 16), np.zeros(16 * 16)], axis=1)
    poses = se3.from_parts(se3.so3_exp(rng.normal(size=at.shape)), at)
    pairs = np.argwhere(np.triu(np.linalg.norm(at[:, None] - at, axis=2) < 1.01, 1))
    pairs = pairs[rng.random(len(pairs)) < 0.75]
    wrong = rng.choice(len(pairs), int(0.15 * len(pairs)), replace=False)
    graph, right = spoiled(measured(poses, pairs, noise=3.0), wrong)
    found = diagnose(graph, DiagnosisOptions(trust=NONE))
    assert found.kept[right].mean() > 0.9 and found.kept[~right].mean() < 0.45


def test_a_long_loop_that_drifted_is_closed_and_nobody_blamed() -> None:
    k = np.arange(600)
    angle = 2 * np.pi * k / 600
    turn = se3.so3_exp(np.outer(angle, [0, 0, 1]))
    poses = se3.from_parts(turn, 60 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    graph = measured(poses, near_pairs(600, 2), noise=2.0)
    found = diagnose(ViewGraph.from_edges(k, graph.edges, graph.i_from_j))
    assert set(found.verdict) == {CONSISTENT} and found.piece.max() == 0

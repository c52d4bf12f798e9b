"""Steps that two sensors state: one backbone of their mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backbone_graphs import STEP, drive
from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import has_unit_information, in_vertex_order
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.solvers.backbone.parallel import FEWEST, fused, loops_once
from hodge_pipeline.solvers.backbone.sequence import consecutive_edges
from hodge_pipeline.solvers.backbone.trust import find_backbone
from hodge_pipeline.types import Ints, ViewGraph
from test_backbone_window import with_window


def with_second_odometry(
    graph: ViewGraph, seed: int = 0, times: float = 1.0, turned: float = 0.5
) -> tuple[ViewGraph, Ints]:
    """The graph and, behind its edges, each step once more, as exact but for a factor, this share of them written the
    other way round; and the rows of these steps.
    """
    rng, rows = np.random.default_rng(seed), np.flatnonzero(consecutive_edges(graph))
    more, motions, edges = graph.select(rows), graph.i_from_j[rows], graph.edges[rows].copy()
    noise = times * rng.normal(size=(len(rows), 6)) * np.repeat(STEP, 3)
    if graph.dimension == 2:
        noise[:, [0, 1, 5]] = 0.0
    motions, back = motions @ se3.exp(noise), rng.random(len(rows)) < turned
    edges[back], motions[back] = edges[back][:, ::-1], se3.inverse(motions[back])
    information = more.information / max(times, 1.0) ** 2
    information[back] = se3.pull_back(motions[back], information[back])
    return ViewGraph.joined([graph, replace(more, edges=edges, i_from_j=motions, information=information)]), rows


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("times", [1.0, 5.0])
def test_two_odometries_are_one_backbone(dimension: int, times: float) -> None:
    """Each step closed a cycle of two edges, so that no backbone was sought: 29 m where odometry has 4."""
    made = drive(dimension=dimension, world="corridor", wrong=0.5, loops=60)
    graph, rows = with_second_odometry(made.graph, times=times)
    found = diagnose(graph)
    np.testing.assert_array_equal(found.kept, np.concatenate([made.right, np.ones(len(rows), bool)]))
    assert made.error_m(found.world_from_cam) < 0.5 * made.error_m(made.odometry())
    why = list(found.reason)
    assert why[made.graph.edge_count :] == [why[row] for row in rows]


def test_the_mean_is_by_information_whichever_way_a_step_is_written() -> None:
    made = drive(dimension=3, wrong=0.0, loops=10).graph
    graph, rows = with_second_odometry(made, times=2.0)
    one = fused(graph, consecutive_edges(graph))
    assert one.graph.edge_count == made.edge_count
    np.testing.assert_array_equal(np.sort(one.merged), np.arange(made.edge_count, graph.edge_count))
    ahead = in_vertex_order(graph)[0].i_from_j[made.edge_count :]
    apart = se3.log(se3.inverse(made.i_from_j[rows]) @ ahead)
    moved = se3.log(se3.inverse(made.i_from_j[rows]) @ one.graph.i_from_j[rows])
    np.testing.assert_allclose(moved, apart / 5, atol=1e-3)  # 1 to 1/4 of the information
    np.testing.assert_allclose(one.graph.information[rows], 1.25 * made.information[rows], rtol=0.02, atol=1.0)


def test_a_second_statement_that_differs_is_judged_by_itself() -> None:
    made = drive(wrong=0.0, loops=60)
    graph, rows = with_second_odometry(made.graph)
    off = graph.i_from_j.copy()
    row = made.graph.edge_count + 150
    off[row] = off[row] @ se3.exp(np.array([0, 0, 0.5, 2.0, 0, 0]))
    found = diagnose(replace(graph, i_from_j=off))
    assert found.verdict[row] == "wrong" and found.kept.sum() == graph.edge_count - 1


def test_information_that_is_unknown_stays_so() -> None:
    made = drive(wrong=0.5, loops=60)
    graph, _ = with_second_odometry(made.graph)
    unknown = replace(graph, information=np.tile(np.eye(6), (graph.edge_count, 1, 1)))
    assert has_unit_information(fused(unknown, consecutive_edges(unknown)).graph)
    found = diagnose(unknown)
    assert not (found.kept[: made.graph.edge_count] & ~made.right).any()
    assert made.error_m(found.world_from_cam) < made.error_m(made.odometry())


def test_copies_of_steps_are_the_same_steps_where_information_is_unknown() -> None:
    """Copies that differ by rounding were contradictions where most differ by nothing: all right loops were lost."""
    made = drive(wrong=0.5, loops=60)
    twice, rows = with_second_odometry(made.graph, times=0.0, turned=0.3)
    unknown, twice = (
        replace(graph, information=np.tile(np.eye(6), (graph.edge_count, 1, 1))) for graph in (made.graph, twice)
    )
    assert len(fused(twice, consecutive_edges(twice)).merged) == len(rows)
    found, expected = diagnose(twice), diagnose(unknown)
    assert (found.kept[: unknown.edge_count] != expected.kept).sum() <= 1
    assert made.error_m(found.world_from_cam) < 1.1 * made.error_m(expected.world_from_cam)


def test_few_parallel_edges_stay_as_they_are() -> None:
    made = drive(wrong=0.0, loops=60).graph
    graph, _ = with_second_odometry(made)
    few = graph.select(np.arange(made.edge_count + FEWEST - 1))
    assert fused(few, consecutive_edges(few)).graph is few


def test_edges_of_another_source_are_not_trusted_with_the_one_that_is() -> None:
    made = drive(wrong=0.0, loops=60).graph
    graph, rows = with_second_odometry(made)
    source = np.where(np.arange(graph.edge_count) < made.edge_count, "wheels", "scans")
    backbone = find_backbone(replace(graph, source=source), "wheels")
    assert backbone is not None and backbone.steps[rows].all() and not backbone.steps[made.edge_count :].any()


def with_copies(graph: ViewGraph, row: int, times: int, apart: float = 1e-4) -> ViewGraph:
    """The graph and, behind its edges, one loop so many times more, every other one written the other way round."""
    rng, axes = np.random.default_rng(0), [2, 3, 4] if graph.dimension == 2 else range(6)
    more, noise = graph.select(np.full(times, row)), np.zeros((times, 6))
    noise[:, axes] = apart * rng.normal(size=(times, len(axes)))
    motions, edges, information = more.i_from_j @ se3.exp(noise), more.edges.copy(), more.information.copy()
    motions[::2], edges[::2] = se3.inverse(motions[::2]), edges[::2, ::-1]
    information[::2] = se3.pull_back(motions[::2], information[::2])
    return ViewGraph.joined([graph, replace(more, edges=edges, i_from_j=motions, information=information)])


@pytest.mark.parametrize("stated", [True, False])
def test_copies_of_a_loop_count_once(stated: bool) -> None:
    """Their common error set the scale of errors: right loops were lost, and in a real graph a right step."""
    made = drive(wrong=0.3, loops=20)
    wrong = int(np.flatnonzero(~made.right)[0])
    graph = with_copies(made.graph, wrong, 100)
    if not stated:
        graph = replace(graph, information=np.tile(np.eye(6), (graph.edge_count, 1, 1)))
    found, alone = diagnose(graph), diagnose(graph.select(np.arange(made.graph.edge_count)))
    np.testing.assert_array_equal(found.kept[: made.graph.edge_count], alone.kept)
    copies = found.verdict[made.graph.edge_count :]
    assert set(copies.tolist()) == {alone.verdict[wrong]} and alone.kept[consecutive_edges(made.graph)].all()
    np.testing.assert_allclose(found.world_from_cam, alone.world_from_cam, atol=1e-2)


def test_a_loop_that_is_written_again_otherwise_is_no_copy() -> None:
    made = drive(wrong=0.0, loops=40)
    row = int(np.flatnonzero(~consecutive_edges(made.graph))[3])
    graph = with_copies(made.graph, row, 2)
    motions = graph.i_from_j.copy()
    motions[-1] = motions[-1] @ se3.exp(np.array([0, 0, 0.5, 3.0, 0, 0]))
    found = diagnose(replace(graph, i_from_j=motions))
    assert found.kept[:-1].all() and found.verdict[-1] == "wrong"


def test_two_loops_between_the_same_views_that_differ_are_no_copies_where_information_is_unknown() -> None:
    """One of them may be wrong, and how far copies differ is not known from a few pairs."""
    graph = drive(wrong=0.0, loops=40).graph
    steps = np.append(consecutive_edges(graph), [False] * 4)
    for number, row in enumerate(np.flatnonzero(~steps)[:4]):
        graph = with_copies(graph, int(row), 1, apart=0.02 * (1 + number))
    graph = replace(graph, information=np.tile(np.eye(6), (graph.edge_count, 1, 1)))
    assert not len(loops_once(fused(graph, steps), ~steps).copies)


def test_copies_of_an_edge_of_a_window_are_of_its_steps() -> None:
    made, _ = with_window(drive(wrong=0.0, loops=20), 3)
    graph = with_copies(made.graph, made.graph.edge_count - 5, 30)
    backbone = find_backbone(graph)
    assert backbone is not None and backbone.merged[made.graph.edge_count :].all() and backbone.used.all()

"""Odometry that registers each frame to several before it: one backbone of all edges over a few steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backbone_graphs import STEP, Drive, drive
from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import has_unit_information
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.solvers.backbone.parallel import Fused
from hodge_pipeline.solvers.backbone.sequence import consecutive_edges
from hodge_pipeline.solvers.backbone.trust import find_backbone
from hodge_pipeline.solvers.backbone.window import windowed
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph


def with_window(made: Drive, reach: int, *, wrong: float = 0.0, seed: int = 0) -> tuple[Drive, Ints]:
    """The graph and, behind its edges, one over each 2 to `reach` steps, some written the other way round, a share of
    them `wrong`; and the rows of these.
    """
    rng, graph = np.random.default_rng(seed), made.graph
    count, planar = graph.vertex_count, graph.dimension == 2
    edges = np.concatenate([np.stack([np.arange(count - g), np.arange(g, count)], axis=1) for g in range(2, reach + 1)])
    size = np.sqrt(np.diff(edges, axis=1)) * np.repeat(STEP, 3)
    motions = se3.inverse(made.truth[edges[:, 0]]) @ made.truth[edges[:, 1]]
    motions = motions @ se3.exp(_noise(rng, size, planar))
    off = rng.random(len(edges)) < wrong
    motions[off] = motions[off] @ se3.exp(_noise(rng, np.tile(np.repeat([0.5, 3.0], 3), (off.sum(), 1)), planar))
    information = np.zeros((len(edges), 6, 6))
    axes = [2, 3, 4] if planar else range(6)
    information[:, axes, axes] = 1 / size[:, axes] ** 2
    back = rng.random(len(edges)) < 0.3
    edges[back], motions[back] = edges[back, ::-1], se3.inverse(motions[back])
    information[back] = se3.pull_back(motions[back], information[back])
    window = ViewGraph.from_edges(
        graph.vertex_ids, edges, motions, information, str(graph.source[0]), dimension=graph.dimension
    )
    whole = replace(made, graph=ViewGraph.joined([graph, window]), right=np.concatenate([made.right, ~off]))
    return whole, np.flatnonzero(off) + graph.edge_count


def _noise(rng: np.random.Generator, size: Floats, planar: bool) -> Floats:
    out = rng.normal(size=size.shape) * size
    out[:, [0, 1, 5] if planar else []] = 0.0
    return np.asarray(out)


def whole(graph: ViewGraph) -> Fused:
    rows = np.arange(graph.edge_count)
    return Fused(graph, rows, rows[:0], rows[:0])


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("reach", [2, 5, 25])
def test_a_window_and_its_steps_are_one_backbone(dimension: int, reach: int) -> None:
    """Each step was in short cycles, so that no backbone was sought: 18 m where odometry has 4."""
    made, _ = with_window(drive(dimension=dimension, world="corridor", wrong=0.7, in_groups=True, loops=80), reach)
    found = diagnose(made.graph)
    assert not (found.kept & ~made.right).any() and (made.right & ~found.kept).sum() <= 2
    assert made.error_m(found.world_from_cam) < 0.5 * made.error_m(made.odometry())
    asked_for = diagnose(made.graph, DiagnosisOptions(trust="sequential"))
    np.testing.assert_array_equal(asked_for.kept, found.kept)


def test_loops_that_nothing_confirms_leave_what_the_window_says() -> None:
    made, _ = with_window(drive(world="town", wrong=1.0, in_groups=True, loops=100), 3)
    found = diagnose(made.graph)
    np.testing.assert_array_equal(found.kept, made.right)
    assert made.error_m(found.world_from_cam) < made.error_m(made.odometry())
    assert any("that state the same steps again" in note for note in found.notes)


def test_wrong_steps_and_wrong_edges_of_a_window_are_named() -> None:
    made, off = with_window(drive(wrong=0.5, loops=80), 3, wrong=0.03)
    graph, steps = made.graph, np.array([40, 41, 200, 333])
    motions = graph.i_from_j.copy()
    motions[steps] = motions[steps] @ se3.exp(np.array([0, 0, 0.5, 3.0, -2.0, 0]))
    right = made.right.copy()
    right[steps] = False
    found = diagnose(replace(graph, i_from_j=motions))
    np.testing.assert_array_equal(found.kept, right)
    for row in (*steps, *off):
        assert found.verdict[row] == "wrong"
        assert "the other edges over the same steps contradict it" in found.reason[row]
    assert made.error_m(found.world_from_cam) < 0.5 * made.error_m(made.odometry())


def test_a_window_is_judged_by_the_errors_that_it_shows_not_by_larger_ones_that_it_states() -> None:
    made, off = with_window(drive(count=150, loops=0, wrong=0), 3, wrong=0.03)
    graph, steps = made.graph, np.array([40, 90])
    motions = graph.i_from_j.copy()
    motions[steps] = motions[steps] @ se3.exp(np.array([0, 0, 0.1, 0.5, -0.3, 0]))
    found = windowed(whole(replace(graph, i_from_j=motions, information=graph.information / 10.0**2)))
    assert sorted(found.contradicted) == sorted([*steps, *off])


@pytest.mark.parametrize("dimension", [2, 3])
def test_an_edge_that_errs_as_it_states_is_right_however_exact_the_others_are(dimension: int) -> None:
    """Of 353 registered edges, 2.6 times as exact as they state, one off by a centimetre was called wrong."""
    made, _ = with_window(drive(count=150, loops=0, wrong=0, dimension=dimension), 3)
    graph = replace(made.graph, information=made.graph.information / 4.0**2)
    row = np.flatnonzero(np.abs(np.diff(graph.edges, axis=1)[:, 0]) == 3)[70]
    motions = graph.i_from_j.copy()
    (shift,) = 2.7 / np.sqrt(graph.information[[row], 3, 3])
    i, j = graph.edges[row]
    motions[row] = se3.inverse(made.truth[i]) @ made.truth[j] @ se3.exp(np.array([0, 0, 0, shift, 0, 0]))
    found = windowed(whole(replace(graph, i_from_j=motions)))
    assert row in found.merged and not len(found.contradicted)
    motions[row] = motions[row] @ se3.exp(np.array([0, 0, 0, shift, 0, 0]))
    assert windowed(whole(replace(graph, i_from_j=motions))).contradicted.tolist() == [row]


def test_a_break_under_all_of_the_window_is_found_by_the_loops() -> None:
    """A robot that is carried off: what passes over that step errs alike."""
    made, _ = with_window(drive(wrong=0.3, loops=80), 3)
    graph, at = made.graph, 150
    low, high = np.sort(graph.edges, axis=1).T
    over = (low <= at) & (high > at) & (high - low <= 3)
    carried = se3.exp(np.array([0, 0, 0.5, 5.0, 0, 0]))
    beyond = made.truth.copy()
    beyond[at + 1 :] = beyond[at] @ carried @ se3.inverse(beyond[at]) @ beyond[at + 1 :]
    motions = graph.i_from_j.copy()
    motions[over] = (se3.inverse(beyond[graph.edges[:, 0]]) @ beyond[graph.edges[:, 1]])[over]
    found = diagnose(replace(graph, i_from_j=motions))
    np.testing.assert_array_equal(found.kept, made.right & ~over)
    assert set(found.verdict[over]) == {"wrong"} and made.error_m(found.world_from_cam) < 1.0


@pytest.mark.parametrize(
    ("ends", "is_hole"),
    [
        ([(149, 152), (147, 152), (148, 153), (145, 153), (146, 155), (144, 153), (143, 155)], True),
        ([(150, 152), (149, 151), (149, 152), (148, 152), (147, 153), (146, 154), (145, 153)], False),
    ],
)
def test_a_mistaken_place_in_a_gap_of_the_window_does_not_break_a_step(
    ends: list[tuple[int, int]], is_hole: bool
) -> None:
    """Seven edges that agree with each other outvoted the only right one: few of them are as short as a window's, or
    two loops to another place close a cycle across the step.
    """
    made, _ = with_window(drive(wrong=0.0, loops=80), 3)
    graph, at = made.graph, 150
    low, high = np.sort(graph.edges, axis=1).T
    over = (low <= at) & (high > at) & (high - low > 1) & (high - low <= 3)
    right = graph.select(np.flatnonzero(~over))
    others = np.array([(150, 30), (151, 31), (149, 31), (152, 32)][: 0 if is_hole else 4], np.int64).reshape(-1, 2)
    mistaken = made.truth[at] @ se3.exp(np.array([0, 0, 0.4, 2.0, -1.5, 0])) @ se3.inverse(made.truth[at])
    pairs = np.concatenate([others, np.array(ends)])
    beyond = made.truth[pairs[:, 1]].copy()
    beyond[len(others) :] = mistaken @ beyond[len(others) :]
    motions = se3.inverse(made.truth[pairs[:, 0]]) @ beyond
    information = np.tile(right.information[0], (len(pairs), 1, 1))
    more = ViewGraph.from_edges(graph.vertex_ids, pairs, motions, information, "loop", dimension=graph.dimension)
    found = diagnose(ViewGraph.joined([right, more]))
    assert not found.kept[-len(ends) :].any() and found.kept[: -len(ends)].all()


def test_many_steps_are_known_as_all_edges_over_them_tell() -> None:
    """Edges over g steps as exact as those make a step g times as certain: 1 + 2 + 3 times in all."""
    made = drive(wrong=0.0, loops=10)
    graph = with_window(made, 3)[0].graph
    one = windowed(whole(graph))
    np.testing.assert_array_equal(one.rows, np.arange(made.graph.edge_count))
    inner = np.flatnonzero(consecutive_edges(one.graph))[3:-3]
    stated = made.graph.information[inner][:, [2, 3, 4], [2, 3, 4]]
    told = one.graph.information[inner][:, [2, 3, 4], [2, 3, 4]]
    ratio = told / stated
    assert 5.5 < np.median(ratio[:, 1:]) < 6.5
    off = se3.log(se3.inverse(_exact(made, inner)) @ one.graph.i_from_j[inner])
    before = se3.log(se3.inverse(_exact(made, inner)) @ graph.i_from_j[inner])
    assert np.square(off).mean() < 0.7 * np.square(before).mean()


def _exact(made: Drive, rows: Ints) -> Floats:
    i, j = made.graph.edges[rows].T
    return np.asarray(se3.inverse(made.truth[i]) @ made.truth[j])


@pytest.mark.parametrize("wrong", [0.2, 1.0])
def test_near_edges_that_do_not_agree_are_no_window(wrong: float) -> None:
    """As in a room every pair of whose views was tried, or where a front end takes for the same what it just left."""
    one = whole(with_window(drive(wrong=0.0), 4, wrong=wrong)[0].graph)
    assert windowed(one) is one


@pytest.mark.parametrize("dimension", [2, 3])
def test_wrong_near_edges_of_unknown_information_are_no_window_and_do_not_refute_the_steps(dimension: int) -> None:
    """As a window they gave 17 m, and against the steps, in the plane, 9.7 m, for .6 m of odometry."""
    rng, made = np.random.default_rng(1), drive(count=300, dimension=dimension, world="town", loops=0)
    steps, low = made.graph.select(np.arange(299)), rng.integers(0, 296, 900)
    edges = np.stack([low, low + rng.integers(2, 5, 900)], axis=1)
    off = _noise(rng, np.tile(np.repeat([0.4, 3.0], 3), (900, 1)), dimension == 2)
    motions = se3.inverse(made.truth[edges[:, 0]]) @ made.truth[edges[:, 1]] @ se3.exp(off)
    both = np.concatenate([steps.edges, edges]), np.concatenate([steps.i_from_j, motions])
    graph = ViewGraph.from_edges(steps.vertex_ids, *both, np.tile(np.eye(6), (1199, 1, 1)), dimension=dimension)
    found = diagnose(graph)
    assert found.kept[:299].all()
    assert made.error_m(found.world_from_cam) <= 1.02 * made.error_m(made.odometry())


def test_few_near_edges_are_no_window() -> None:
    one = whole(drive(wrong=0.0, short=150).graph)
    assert windowed(one) is one


def test_where_information_is_unknown_steps_err_as_they_close() -> None:
    """A radian weighed as a metre, rotations erred three times as much as stated and right edges were out."""
    made, _ = with_window(drive(world="corridor", wrong=0.5, loops=80), 8)
    unknown = replace(made.graph, information=np.tile(np.eye(6), (made.graph.edge_count, 1, 1)))
    assert has_unit_information(windowed(whole(unknown)).graph)
    found = solve_robust(unknown)
    np.testing.assert_array_equal(found.weights > 0, made.right)
    assert made.error_m(found.world_from_cam) < 0.1 * made.error_m(made.odometry())


def test_edges_between_two_sequences_are_no_window() -> None:
    """In a graph of twenty vertices each was near, and took the place of the steps."""
    made, _ = with_window(drive(count=20, wrong=0.0, loops=0), 3)
    apart = np.equal(*(made.graph.edges >= 10).T)
    across = np.flatnonzero(~apart & (np.abs(np.diff(made.graph.edges, axis=1)[:, 0]) > 1))
    graph = made.graph.select(np.concatenate([np.flatnonzero(apart), across]))
    found = windowed(whole(graph))
    assert set(range(graph.edge_count - len(across), graph.edge_count)) <= set(found.rows.tolist())


@pytest.mark.parametrize("stated", [True, False])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e6])
def test_an_exact_window_in_any_unit_is_one(stated: bool, unit: float) -> None:
    made, _ = with_window(drive(wrong=0.0, loops=20), 3)
    graph, (i, j) = made.graph, made.graph.edges.T
    motions = se3.inverse(made.truth[i]) @ made.truth[j]
    information = graph.information if stated else np.tile(np.eye(6), (len(i), 1, 1))
    if unit != 1.0:
        motions = se3.rescaled(motions, unit)
        information = se3.rescaled_information(information, unit) if stated else information
    exact = replace(graph, i_from_j=motions, information=information)
    one = windowed(whole(exact))
    assert len(one.merged) > 700 and not len(one.contradicted)
    found = diagnose(exact)
    assert found.kept.all() and made.error_m(se3.rescaled(found.world_from_cam, 1 / unit)) < 1e-6


@pytest.mark.parametrize("stated", [True, False])
def test_the_rounding_of_an_optimised_graph_calls_no_edge_wrong(stated: bool) -> None:
    """Long numbers are rounded more than short ones: those fell out of the window."""
    made, _ = with_window(drive(wrong=0.0, loops=20), 3)
    (i, j), rng = made.graph.edges.T, np.random.default_rng(0)
    motions = se3.inverse(made.truth[i]) @ made.truth[j]
    digits = rng.choice([0.01, 1.0], (len(motions), 1), p=[0.95, 0.05])
    last_digit = _noise(rng, np.repeat([1e-5, 1e-4], 3) * digits, planar=True)
    information = made.graph.information if stated else np.tile(np.eye(6), (len(motions), 1, 1))
    graph = replace(made.graph, i_from_j=motions @ se3.exp(last_digit), information=information)
    assert diagnose(graph).kept.all()


def test_edges_of_a_window_are_loops_beside_the_edges_of_a_source() -> None:
    graph = with_window(drive(wrong=0.0, loops=60), 3)[0].graph
    steps: Bools = np.arange(graph.edge_count) < graph.vertex_count - 1
    backbone = find_backbone(replace(graph, source=np.where(steps, "wheels", "scans")), "wheels")
    assert backbone is not None
    np.testing.assert_array_equal(backbone.steps, steps)


@pytest.mark.parametrize("over", [2, 4])
def test_wrong_loops_of_one_place_replace_no_step_that_no_short_edge_tests(over: int) -> None:
    """With 478 wrong loops put into Duderstadt, two called a right step wrong: 5.2 m where odometry has .34."""
    made, at = drive(count=150, loops=60, wrong=0.0), 100
    graph = with_window(made, 3)[0].graph
    low, high = np.sort(graph.edges, axis=1).T
    graph = graph.select(np.flatnonzero((low > at) | (high <= at) | (high - low == 1) | (high - low > 20)))
    beyond = made.truth.copy()
    beyond[at + 1 :] = (
        beyond[at] @ se3.exp(np.array([0, 0, 0.5, 5.0, 0, 0])) @ se3.inverse(beyond[at]) @ beyond[at + 1 :]
    )
    ends = at - over + np.array([[0, 2 * over], [1, 2 * over + 1]])
    motions = se3.inverse(beyond[ends[:, 0]]) @ beyond[ends[:, 1]]
    mistaken = ViewGraph.from_edges(
        graph.vertex_ids, ends, motions, graph.information[:2], str(graph.source[0]), dimension=graph.dimension
    )
    found = diagnose(ViewGraph.joined([graph, mistaken]))
    np.testing.assert_array_equal(found.kept, np.arange(len(found.kept)) < graph.edge_count)
    assert made.error_m(found.world_from_cam) < made.error_m(made.odometry())

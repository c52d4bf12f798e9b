"""Wrong edges that agree with each other, as when one place looks like the next: cycles win over the order of views."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.edge_scores import area_under_roc
from benchmarks.simulated_edges import simulated
from diagnosis_graphs import measured, near_pairs, poses_on_a_ring
from hodge_pipeline import se3
from hodge_pipeline.complex.short_cycles import short_cycles
from hodge_pipeline.diagnosis.cycles import Cycles
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.evidence import right_by_gap
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

VIEWS, REACH = 120, 9
SLIGHT = np.array([0.0, 0.1, 0.1, 0.2, 0.1, 0.0])
LARGE = np.array([0.3, -1.0, 0.8, 1.5, 1.0, -0.5])


def walk() -> tuple[ViewGraph, Floats]:
    """Two rounds of a room: each view joined to the next nine, and some to those of the round before."""
    poses = np.concatenate([poses_on_a_ring(VIEWS // 2), poses_on_a_ring(VIEWS // 2, 1)])
    near = near_pairs(VIEWS, REACH)
    near = near[near[:, 0] < near[:, 1]]
    k = np.arange(VIEWS // 2 - 2)
    back = np.concatenate([np.stack([k, k + VIEWS // 2 + step], axis=1) for step in (0, 2)])
    return measured(poses, np.concatenate([near, back])), poses


def displaced(graph: ViewGraph, poses: Floats, rows: Ints, centre: int, xi: Floats) -> None:
    """These edges put their later end where it would be if the world turned about one view."""
    about = se3.from_parts(np.eye(3), poses[centre, :3, 3])
    world = about @ se3.exp(xi) @ se3.inverse(about)
    low = poses[graph.edges[rows].min(axis=1)]
    graph.i_from_j[rows] = se3.inverse(low) @ world @ low @ graph.i_from_j[rows]


def across(graph: ViewGraph, place: int, shortest: int, longest: int, most: int) -> Ints:
    """Up to `most` edges from before a place in the order to behind it, whose gap is within the limits."""
    low, high = np.sort(graph.edges, axis=1).T
    rows = np.flatnonzero((low <= place) & (high > place) & (high - low >= shortest) & (high - low <= longest))
    return rows[np.argsort(np.abs(low[rows] - place) + np.abs(high[rows] - place), kind="stable")][:most]


def judged(graph: ViewGraph, right: Bools) -> tuple[float, float, float]:
    """AUC, the share of wrong edges that are kept and of right ones that are not."""
    found = diagnose(graph)
    assert found.probability is not None
    return area_under_roc(found.probability, right), found.kept[~right].mean(), 1 - found.kept[right].mean()


@pytest.mark.parametrize("size", [5, 20])
@pytest.mark.parametrize("xi", [SLIGHT, LARGE])
@pytest.mark.parametrize("places", [(60,), (15, 45, 75, 105)])
def test_groups_between_views_close_in_order_are_found(size: int, xi: Floats, places: tuple[int, ...]) -> None:
    graph, poses = walk()
    right = np.ones(graph.edge_count, bool)
    for place in places:
        rows = across(graph, place, 2, REACH, size)
        displaced(graph, poses, rows, place, xi)
        right[rows] = False
    auc, wrong_kept, right_lost = judged(graph, right)
    assert auc > 0.99 and wrong_kept == 0 and right_lost < 0.02


def test_a_wrong_step_is_found_though_the_edges_beside_it_agree_with_it() -> None:
    """Consecutive views that slid along a wall, and all edges over that place of up to three views."""
    graph, poses = walk()
    rows = across(graph, 60, 1, 3, 6)
    assert len(rows) == 6
    displaced(graph, poses, rows, 60, SLIGHT)
    right = np.ones(graph.edge_count, bool)
    right[rows] = False
    auc, wrong_kept, right_lost = judged(graph, right)
    assert auc > 0.99 and wrong_kept == 0 and right_lost < 0.02


@pytest.mark.parametrize("size", [10, 40])
def test_groups_between_far_views_do_not_win_over_the_sequence(size: int) -> None:
    graph, poses = walk()
    far = np.flatnonzero(graph.edges[:, 1] - graph.edges[:, 0] > REACH)
    rows = far[np.argsort(np.abs(graph.edges[far, 0] - 30), kind="stable")[:size]]
    displaced(graph, poses, rows, 30, LARGE)
    right = np.ones(graph.edge_count, bool)
    right[rows] = False
    auc, wrong_kept, right_lost = judged(graph, right)
    assert auc > 0.99 and wrong_kept == 0 and right_lost < 0.02


def test_a_few_wrong_edges_that_agree_by_chance_move_nothing() -> None:
    """A corridor with a fifth of its edges wrong, which lost three right edges at odds of 1.6 to 1 for a move."""
    _, graph, right = simulated(9025, 0.2)
    kept = diagnose(graph).kept
    assert kept[right].all() and (kept & ~right).sum() <= 1


def shares(count: int, closing: Bools, usual: float) -> tuple[float, float]:
    """Of the short and the long edges of a ladder 0 - 1 - 2 - … with all gaps of two, triangle by triangle."""
    k = np.arange(count - 1)
    edges = np.concatenate([np.stack([k, k + 1], axis=1), np.stack([k[:-1], k[:-1] + 2], axis=1)])
    loops, zero = short_cycles(edges, count, 64), np.zeros(count - 2)
    assert (loops.lengths == 3).all() and len(loops) == count - 2
    share = right_by_gap(edges, count, Cycles(loops, zero, zero, zero, closing), usual)
    return float(share[0]), float(share[-1])


def test_a_gap_is_as_right_as_its_cycles_say_and_no_surer_than_it_has_edges() -> None:
    short, long = shares(502, np.arange(500) % 2 == 0, usual=0.9)
    assert short**2 * long == pytest.approx(0.5, abs=0.02), "so many triangles close"
    sure, _ = shares(502, np.ones(500, bool), usual=1.0)
    assert 0.995 < sure <= 502 / 503
    few, _ = shares(4, np.zeros(2, bool), usual=0.9)
    assert few > 0.7, "three edges say little of their gap"

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.edge_scores import (
    PairTruth,
    area_under_roc,
    pose_recall,
    precision_and_recall,
    right_edges,
)
from hodge_adapters.pose_graphs.pair_log import PairLogReader
from hodge_pipeline import se3
from hodge_pipeline.types import ViewGraph

"""Truth:  0 --1 m-- 1 --1 m-- 2     3 (not joined)"""


def truth() -> PairTruth:
    step = se3.from_parts(np.eye(3), np.array([1.0, 0, 0]))
    information = np.tile(np.diag([4.0, 4, 4, 1, 1, 1]), (2, 1, 1))
    edges = np.array([[0, 1], [1, 2]])
    return PairTruth.from_graph(ViewGraph.from_edges(np.arange(4), edges, np.stack([step, step]), information))


def moved(x: float, turn_rad: float = 0.0) -> np.ndarray:
    return se3.from_parts(se3.so3_exp(np.array([0, 0, turn_rad])), np.array([x, 0.0, 0]))


@pytest.mark.parametrize(
    ("edge", "motion", "right"),
    [
        ((0, 1), moved(1.19), True),
        ((0, 1), moved(1.21), False),
        ((1, 0), se3.inverse(moved(1.19)), True),
        ((1, 0), moved(1.0), False),
        # q_vec = sin(φ/2), counted as 2 m: half of 0.2 m is 0.1 rad on a lever of 2 m
        ((0, 1), moved(1.0, 0.0999), True),
        ((0, 1), moved(1.0, 0.1003), False),
        ((0, 2), moved(2.29), True),
        ((0, 2), moved(2.31), False),
        ((0, 2), moved(2.0, np.radians(10.1)), False),
        ((0, 3), moved(0.0), False),
    ],
)
def test_right_edges_by_hand(edge: tuple[int, int], motion: np.ndarray, right: bool) -> None:
    assert right_edges(truth(), np.array([edge]), motion[None]).tolist() == [right]


def test_pose_recall_counts_pairs_in_one_piece_only() -> None:
    known = truth()
    poses = known.world_from_vertex
    assert pose_recall(known, poses, np.zeros(4, np.int64)) == 1.0
    assert pose_recall(known, poses, np.array([0, 0, 1, 2])) == 0.5
    bent = poses.copy()
    bent[2, 0, 3] += 0.3
    assert pose_recall(known, moved(7.0, 2.0) @ bent, np.zeros(4, np.int64)) == 0.5, "whatever the gauge"


def test_precision_recall_and_roc_by_hand() -> None:
    right = np.array([True, True, False, False])
    assert precision_and_recall(np.array([True, False, True, False]), right) == (0.5, 0.5)
    assert np.isnan(precision_and_recall(np.zeros(4, bool), right)[0])
    assert area_under_roc(np.array([0.9, 0.8, 0.2, 0.1]), right) == 1.0
    assert area_under_roc(np.array([0.9, 0.2, 0.2, 0.1]), right) == 0.875
    assert area_under_roc(np.array([0.9, np.nan, 0.2, np.nan]), right) == 1.0
    assert np.isnan(area_under_roc(np.ones(2), np.ones(2, bool)))


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_roc_is_the_share_of_ordered_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    score, right = rng.integers(0, 5, 30).astype(float), rng.random(30) < 0.5
    if right.all() or not right.any():
        return
    above = score[right][:, None] - score[~right][None]
    expected = (above > 0).mean() + 0.5 * (above == 0).mean()
    assert area_under_roc(score, right) == pytest.approx(expected)
    assert area_under_roc(-score, right) == pytest.approx(1 - expected)


def test_the_published_numbers_of_real_estimates(data_dir: Path) -> None:
    base = data_dir / "fragments/pair_estimates"
    for scene, recall, precision in (("7-scenes-redkitchen", 0.853, 0.721), ("iclnuim-livingroom1", 0.590, 0.312)):
        folder = base / f"{scene}-evaluation"
        graph = PairLogReader(information=folder / "gt.info").open(folder / "gt.log").graph
        estimates = PairLogReader().open(folder / "3dmatch.log").graph
        assert graph is not None and estimates is not None
        known = PairTruth.from_graph(graph)
        assert pose_recall(known, known.world_from_vertex, known.component) == 1.0
        far = estimates.edges[:, 1] - estimates.edges[:, 0] > 1
        listed = (known.pairs[:, None] == estimates.edges).all(axis=2).any(axis=0)
        right = right_edges(known, estimates.edges, estimates.i_from_j) & far & listed
        wanted = (known.pairs[:, 1] - known.pairs[:, 0] > 1).sum()
        assert (right.sum() / wanted, right.sum() / far.sum()) == pytest.approx((recall, precision), abs=6e-4)

"""Which edges and relative poses are right, where the truth of some pairs is known; precision, recall, ROC.

The test of 3DMatch and Redwood (Choi, Zhou and Koltun 2015): a pair is right when the mean squared error of its true
correspondences, as their information matrix has it, is at most (0.2 m)².
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_adapters.pose_graphs.pair_log import PairLogReader
from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.cycles import root_from_vertex, spanning_forest
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

LARGEST_RMSE_M = 0.2
UNLISTED_M, UNLISTED_RAD = 0.3, np.radians(10.0)
"""Of a pair that the truth does not list: how far it may be from the chained true poses."""


@dataclass(frozen=True)
class PairTruth:
    """Pairs whose true motion is known, and what chaining them gives for all others.

    - `pairs (N, 2)` rows of vertices, `i_from_j (N, 4, 4)`, `information (N, 6, 6)` over (rotation, translation).
    - `world_from_vertex (V, 4, 4)` chained along them, `component (V,)` of their graph.
    """

    pairs: Ints
    i_from_j: Floats
    information: Floats
    world_from_vertex: Floats
    component: Ints

    @classmethod
    def from_graph(cls, graph: ViewGraph) -> PairTruth:
        """The truth that a graph of right edges is."""
        forest = spanning_forest(graph.edges, graph.vertex_count)
        chained = root_from_vertex(forest, graph.i_from_j)
        component = connected_components(graph.edges, graph.vertex_count)
        return cls(graph.edges, graph.i_from_j, graph.information, chained, component)


def right_edges(truth: PairTruth, edges: Ints, i_from_j: Floats) -> Bools:
    """Where (E,) an edge is right: the test of its listed pair, or 0.3 m and 10° from the chained poses.

    An edge between vertices that the truth does not join is not right.
    """
    row, backwards = _listed(truth, edges)
    listed = row >= 0
    motion = np.array(i_from_j)
    motion[backwards] = se3.inverse(motion[backwards])
    right = np.zeros(len(edges), bool)
    right[listed] = _passes(truth, row[listed], motion[listed])
    i, j = edges.T
    poses = truth.world_from_vertex
    left = se3.inverse(i_from_j) @ se3.inverse(poses[i]) @ poses[j]
    near = np.linalg.norm(left[:, :3, 3], axis=1) <= UNLISTED_M
    near &= np.linalg.norm(se3.so3_log(left[:, :3, :3]), axis=1) <= UNLISTED_RAD
    return np.where(listed, right, near & (truth.component[i] == truth.component[j]))


def read_estimates(log: Path) -> tuple[ViewGraph, PairTruth, Bools]:
    """The graph of a .log file, the truth that gt.log and gt.info beside it are, and where (E,) its edges are right."""
    true = PairLogReader(information=log.with_name("gt.info")).open(log.with_name("gt.log")).graph
    graph = PairLogReader().open(log).graph
    assert true is not None and graph is not None
    truth = PairTruth.from_graph(true)
    return graph, truth, right_edges(truth, graph.edges, graph.i_from_j)


def pose_recall(truth: PairTruth, world_from_vertex: Floats, piece: Ints) -> float:
    """The share of the listed pairs whose relative pose passes the test; those in two pieces do not."""
    i, j = truth.pairs.T
    relative = se3.inverse(world_from_vertex[i]) @ world_from_vertex[j]
    passed = _passes(truth, np.arange(len(truth.pairs)), relative) & (piece[i] == piece[j])
    return float(passed.mean()) if len(passed) else float("nan")


def precision_and_recall(kept: Bools, right: Bools) -> tuple[float, float]:
    """(share of the kept edges that are right, share of the right edges that are kept); NaN of none."""
    good = float((kept & right).sum())
    precision = good / kept.sum() if kept.any() else float("nan")
    return float(precision), float(good / right.sum() if right.any() else float("nan"))


def area_under_roc(score: Floats, right: Bools) -> float:
    """The probability that a right edge scores above a wrong one, ties half; NaN scores are left out.

    NaN where there are none of either kind.
    """
    known = ~np.isnan(score)
    score, right = score[known], right[known]
    positive, negative = int(right.sum()), int((~right).sum())
    if not positive or not negative:
        return float("nan")
    _, place, count = np.unique(score, return_inverse=True, return_counts=True)
    rank = np.cumsum(count) - (count - 1) / 2
    total = rank[place.reshape(-1)][right].sum()
    return float((total - positive * (positive + 1) / 2) / (positive * negative))


def _listed(truth: PairTruth, edges: Ints) -> tuple[Ints, Bools]:
    """The row (E,) of each edge's pair in the truth, −1 where there is none, and whether it is named backwards."""
    size = len(truth.component)
    keys = truth.pairs[:, 0] * size + truth.pairs[:, 1]
    order = np.argsort(keys, kind="stable")
    row, backwards = np.full(len(edges), -1, np.int64), np.zeros(len(edges), bool)
    for turned in (True, False):
        i, j = edges.T[::-1] if turned else edges.T
        place = np.minimum(np.searchsorted(keys[order], i * size + j), len(keys) - 1)
        found = keys[order][place] == i * size + j
        row[found], backwards[found] = order[place][found], turned
    return row, backwards


def _passes(truth: PairTruth, row: Ints, i_from_j: Floats) -> Bools:
    error = se3.inverse(truth.i_from_j[row]) @ i_from_j
    quat = se3.to_quat_xyzw(error)
    vector = quat[:, :3] * np.where(quat[:, 3:] < 0, -2.0, 2.0)
    xi = np.concatenate([vector, error[:, :3, 3]], axis=1)
    squares = np.einsum("ni,nij,nj->n", xi, truth.information[row], xi) / truth.information[row, 3, 3]
    return np.asarray(squares <= LARGEST_RMSE_M**2)

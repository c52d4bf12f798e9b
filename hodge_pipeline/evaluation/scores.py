"""The paper's score of a set of poses: how well clouds of overlapping frames fit, exp(−d/σ) of their distance d.

Scores of two sets of poses compare only on the same edges. So every set is scored on those of the reference poses, and
its score is always printed beside the reference's own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias, get_args

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation.cloud_distance import NO_NEIGHBOUR_M, DistanceBlock, block_distances
from hodge_pipeline.pairs.centroid import centroids_in_world
from hodge_pipeline.pairs.overlap import pairwise_iou
from hodge_pipeline.scene import Round, has_truth, pose_sets, true_poses
from hodge_pipeline.stages import Step, Steps, Workers
from hodge_pipeline.types import CloudSet, Floats, Ints, PointCloud, Source
from hodge_pipeline.types.arrays import evenly

GraphKind: TypeAlias = Literal["distance", "iou"]
GRAPH_KINDS: tuple[GraphKind, ...] = get_args(GraphKind)

SIGMA_M = 0.069
"""σ of the score. The paper states none; with this one the true poses of red kitchen score the paper's 0.863."""
CENTROID_DISTANCE_M = 0.2
"""Distance of centroids below which frames overlap, in the paper's distance graph."""
IOU, IOU_VOXEL_M = 0.5, 0.1
"""Intersection over union above which frames overlap, in the paper's IoU graph, and the side of the voxels."""
MOST_PAIRS = 1500
"""Pairs of a graph that are scored: their mean distance is known to a fifth of a millimetre (red kitchen)."""
MOST_FRAMES = 500
"""Frames whose pairs with all others are listed, of which `MOST_PAIRS` are scored."""
MOST_POINTS, LEAST_POINTS = 1_000_000, 500
"""Points measured of all pairs together, and at least of each: a third of those of 500 pairs (red kitchen), an eighth
of 1200 (fr1/rpy), which changes mean scores by two ten-thousandths. Every set of poses is measured with the same.
"""
PAIRS_PER_BLOCK = 96
"""About half a second of work: long against the cost of sending a block, short against a whole run."""


def evaluation_pairs(clouds: CloudSet, world_from_cam: Floats, kind: GraphKind, scale: float = 1.0) -> Ints:
    """The edges (P, 2), i < j and sorted, on which poses are scored: near centroids, or overlapping voxels.

    `distance`: centroids closer than 0.2 m in the world. `iou`: intersection over union of occupied 0.1 m voxels of
    the world above 0.5. Frames without points, or whose pose (N, 4, 4) is not finite, have no edges. Of more than 500
    frames those of 500, evenly spread, are listed. Lengths are times `scale`. Raises `GraphError` where there is not
    one pose for each cloud.
    """
    if len(clouds) != len(world_from_cam):
        raise GraphError(f"{len(clouds)} clouds but {len(world_from_cam)} poses: give one pose for each cloud")
    if kind not in GRAPH_KINDS:
        raise ValueError(f"graph kind {kind!r}: expected one of {', '.join(GRAPH_KINDS)}")
    usable = np.flatnonzero((clouds.sizes > 0) & se3.has_pose(world_from_cam))
    if len(usable) < 2:
        return np.zeros((0, 2), np.int64)
    find = _near_centroids if kind == "distance" else _overlapping_voxels
    some = evenly(len(usable), MOST_FRAMES)
    found = find(clouds.read(usable), world_from_cam[usable], some, scale)
    pairs = np.unique(np.sort(found[found[:, 0] != found[:, 1]], axis=1), axis=0)
    return np.asarray(usable[pairs], np.int64)


def _near_centroids(clouds: Iterable[PointCloud], world_from_cam: Floats, some: Ints, scale: float) -> Ints:
    """Pairs (P, 2) of one of `some` rows and any row whose centroids are near."""
    centroids = centroids_in_world(clouds, world_from_cam)
    near = cKDTree(centroids[some]).sparse_distance_matrix(
        cKDTree(centroids), scale * CENTROID_DISTANCE_M, output_type="ndarray"
    )
    return np.stack([some[near["i"]], near["j"]], axis=1)


def _overlapping_voxels(clouds: Iterable[PointCloud], world_from_cam: Floats, some: Ints, scale: float) -> Ints:
    """Pairs (P, 2) of one of `some` rows and any row whose voxels overlap."""
    iou = pairwise_iou(clouds, world_from_cam, scale * IOU_VOXEL_M, above=IOU, partners=some).tocoo()
    return np.stack([iou.row, iou.col], axis=1)


def edge_distances(
    clouds_folder: Path,
    pairs: Ints,
    world_from_cam: Floats,
    workers: Workers,
    *,
    scale: float = 1.0,
) -> Floats:
    """The distance d (..., P) in metres of each pair (P, 2), under each set of poses (..., N, 4, 4).

    `d_ij` is the mean |n·(p − q)| over the points p of cloud j whose nearest neighbour q in cloud i is within 0.1 m
    times `scale`, n the normal at q; that reach itself where there is none, NaN where a pose is not finite. Several
    sets at once share the search trees. Of many pairs only some points, evenly strided, are measured. `clouds_folder`
    is what `CloudSet.save` wrote.
    """
    poses = world_from_cam.reshape(-1, *world_from_cam.shape[-3:])
    distances = np.full((len(poses), len(pairs)), np.nan)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    cuts = [order[start : start + PAIRS_PER_BLOCK] for start in range(0, len(order), PAIRS_PER_BLOCK)]
    points = max(LEAST_POINTS, MOST_POINTS // max(1, len(pairs)))
    blocks = [DistanceBlock(clouds_folder, pairs[cut], se3.between(poses, pairs[cut]), points, scale) for cut in cuts]
    for block, found in workers.map(block_distances, blocks):
        distances[:, cuts[block]] = found
    return distances.reshape(*world_from_cam.shape[:-3], len(pairs))


@dataclass(frozen=True)
class GraphScores:
    """The scores of S sets of poses on one graph: `pairs (P, 2)`, `distances_m (S, P)`, NaN where a pose is unknown.

    σ and the reach of 0.1 m are multiplied by `scale`, for scenes that are no rooms.
    """

    kind: GraphKind
    pairs: Ints
    distances_m: Floats
    scale: float = 1.0

    @property
    def scores(self) -> Floats:
        """`exp(−d/σ)` (S, P)."""
        return np.asarray(np.exp(-self.distances_m / (self.scale * SIGMA_M)))

    @property
    def counts(self) -> Ints:
        """How many edges (S,) each set of poses was scored on."""
        return np.asarray(np.isfinite(self.distances_m).sum(axis=1), np.int64)

    @property
    def unmatched(self) -> Ints:
        """How many edges (S,) have no point within 0.1 m of the other cloud."""
        return np.asarray((self.distances_m >= self.scale * NO_NEIGHBOUR_M).sum(axis=1), np.int64)

    @property
    def mean_distance_m(self) -> Floats:
        """Mean d (S,), NaN without edges."""
        return _mean(self.distances_m)

    @property
    def mean_score(self) -> Floats:
        """Mean score (S,), NaN without edges."""
        return _mean(self.scores)


def _mean(values: Floats) -> Floats:
    """The mean (S,) of the finite values (S, P) of each row; NaN of none."""
    known = np.isfinite(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@dataclass(frozen=True)
class ScoreTable:
    """The named sets of poses (S of them), scored on each graph; `reference` names the set that made the graphs."""

    names: tuple[str, ...]
    reference: str
    graphs: tuple[GraphScores, ...]

    @property
    def scale(self) -> float:
        """The factor on the lengths of the scores."""
        return max((graph.scale for graph in self.graphs), default=1.0)


def score_table(
    clouds_folder: Path,
    sets: Mapping[str, Floats],
    reference: str,
    workers: Workers,
    *,
    kinds: tuple[GraphKind, ...] = GRAPH_KINDS,
    scale: float = 1.0,
) -> ScoreTable:
    """Every set of poses (N, 4, 4), scored on the graphs of the one that `reference` names.

    The reference is the ground truth where there is one, else the result. Of more than 1500 pairs so many, evenly
    spread, are scored; pairs of both graphs are measured once. Lengths are multiplied by `scale`, for scenes that are
    no rooms. Raises `GraphError` for an unknown reference.
    """
    if reference not in sets:
        raise GraphError(f"reference poses {reference!r} are not among {', '.join(sets)}")
    clouds = CloudSet.open(clouds_folder)
    every = [evaluation_pairs(clouds, sets[reference], kind, scale) for kind in kinds]
    graphs = [pairs[evenly(len(pairs), MOST_PAIRS)] for pairs in every]
    union, rank = np.unique(np.concatenate(graphs), axis=0, return_inverse=True)
    poses = np.stack(list(sets.values()))
    distances = edge_distances(clouds_folder, union, poses, workers, scale=scale)
    columns = np.split(rank.reshape(-1), np.cumsum([len(pairs) for pairs in graphs])[:-1])
    scored = (
        GraphScores(kind, pairs, distances[:, c], scale) for kind, pairs, c in zip(kinds, graphs, columns, strict=True)
    )
    return ScoreTable(tuple(sets), reference, tuple(scored))


def score_rounds(
    source: Source, clouds: CloudSet, rounds: Sequence[Round], scale: float, steps: Steps, workers: Workers
) -> ScoreTable:
    """The scores of every round and of the true poses where there are any, which then are the reference.

    Lengths of the scores are multiplied by `scale`.
    """
    sets = pose_sets(rounds, source)
    sets = {"truth": true_poses(source), **sets} if has_truth(source) else sets
    reference = "truth" if has_truth(source) else "result"
    return steps.step(evaluate, clouds, sets, reference, scale, title="evaluation", workers=workers)


def evaluate(
    clouds: CloudSet, sets: dict[str, Floats], reference: str, scale: float, *, workers: Workers, step: Step
) -> ScoreTable:
    """Step: the scores of named sets of poses (K, 4, 4), on the pairs that overlap under the `reference` one."""
    return score_table(clouds.folder, sets, reference, workers, scale=scale)

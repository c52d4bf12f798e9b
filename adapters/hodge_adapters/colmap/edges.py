"""Measured edges of a COLMAP model: pairs by covisibility, or by the two-view geometries of its database."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array

from hodge_adapters.colmap.cameras import colmap_camera
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import NO_POINT, Model
from hodge_adapters.colmap.relative import Relative, Sighting, by_structure, estimate
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints, ViewGraph
from hodge_pipeline.types.text import counted

COVISIBILITY, STRUCTURE = "covisibility", "structure"
"""Edges of two views alone, and of the points that they share."""
CLEAR_SHARE = 0.8
"""Of the shared points: where so many place both images there is nothing else to ask."""
SAME_TURN = 0.035
"""Radians: two degrees, what two views of a few dozen points leave open."""


@dataclass(frozen=True)
class Pair:
    """Rows i and j of the images, and what both saw."""

    i: int
    j: int
    sighting: Sighting
    source: str


def measured_graph(model: Model, pairs: Iterator[Pair], min_inliers: int, seed: int, notes: list[str]) -> ViewGraph:
    """The graph of the pairs whose relative pose was found; the others are counted in the notes."""
    refused: Counter[str] = Counter()
    kept: list[Pair] = []
    found: list[Relative] = []
    for pair in pairs:
        for hypothesis, source in _hypotheses(pair, min_inliers, seed):
            if isinstance(hypothesis, str):
                refused[hypothesis] += 1
            else:
                kept.append(replace(pair, source=source))
                found.append(hypothesis)
    notes += [f"{counted(count, 'pair')} of images left out: {why}" for why, count in sorted(refused.items())]
    graph = ViewGraph.from_edges(
        np.array([image.name for image in model.images]),
        np.array([(pair.i, pair.j) for pair in kept], np.int64).reshape(-1, 2),
        np.array([edge.i_from_j for edge in found]).reshape(-1, 4, 4),
        np.array([edge.information for edge in found]).reshape(-1, 6, 6),
    )
    inliers = np.array([edge.inliers for edge in found], np.int64)
    shared = np.array([len(pair.sighting.pixels_i) for pair in kept], float)
    names = np.array([pair.source for pair in kept], np.str_)
    return replace(graph, source=names, correspondences=inliers, fitness=inliers / np.maximum(shared, 1))


def _hypotheses(pair: Pair, min_inliers: int, seed: int) -> Iterator[tuple[Relative | str, str]]:
    """What the two images may be to each other: as the points that they share place them, and as two views do.

    The points decide where most agree; where two views say otherwise and few points agree both are given, and the
    solver keeps the one that closes with other edges.
    """
    structure = by_structure(pair.sighting, min_inliers, seed) if pair.source == COVISIBILITY else None
    if structure is not None and structure[1] >= CLEAR_SHARE:
        yield structure[0], STRUCTURE
        return
    views = estimate(pair.sighting, min_inliers, seed)
    if structure is None:
        yield views, pair.source
        return
    yield structure[0], STRUCTURE
    if not isinstance(views, str):
        turn = se3.so3_log(se3.inverse(structure[0].i_from_j)[:3, :3] @ views.i_from_j[:3, :3])
        if np.linalg.norm(turn) > SAME_TURN:
            yield views, pair.source


def covisible_pairs(model: Model, min_shared: int, max_per_image: int) -> Iterator[Pair]:
    """Pairs of images that share enough points, those with most first for each image; i < j."""
    cameras = camera_table(model)
    shared = shared_counts(model)
    seen = [np.unique(image.point_ids, return_index=True) for image in model.images]
    for i, j in _most_shared(shared, min_shared, max_per_image):
        first, second = model.images[i], model.images[j]
        (ids_i, at_i), (ids_j, at_j) = seen[i], seen[j]
        common, rows_i, rows_j = np.intersect1d(ids_i, ids_j, assume_unique=True, return_indices=True)
        real = common != NO_POINT
        sighting = Sighting(
            cameras[first.camera_id],
            cameras[second.camera_id],
            first.pixels[at_i[rows_i[real]]],
            second.pixels[at_j[rows_j[real]]],
            positions(model, common[real]),
        )
        yield Pair(i, j, sighting, COVISIBILITY)


def camera_table(model: Model) -> Mapping[int, pycolmap.Camera]:
    """The cameras of the model as pycolmap has them."""
    return {camera_id: colmap_camera(record) for camera_id, record in model.cameras.items()}


def positions(model: Model, point_ids: Ints) -> Floats:
    """Positions (N, 3) of points by id, NaN for those that the model does not have."""
    rows = model.points.rows_of(point_ids)
    known = rows >= 0
    out = np.full((len(point_ids), 3), np.nan)
    out[known] = model.points.xyz[rows[known]]
    return out


def shared_counts(model: Model) -> coo_array:
    """How many points each pair of images shares, i < j."""
    seen = [np.unique(image.point_ids) for image in model.images]
    seen = [ids[ids != NO_POINT] for ids in seen]
    points, column = np.unique(np.concatenate([np.zeros(0, np.int64), *seen]), return_inverse=True)
    row = np.repeat(np.arange(len(seen)), [len(ids) for ids in seen])
    shape = len(seen), max(len(points), 1)
    sees = coo_array((np.ones(len(row), np.int32), (row, column)), shape=shape).tocsr()
    product = (sees @ sees.T).tocoo()
    upper = product.row < product.col
    return coo_array((product.data[upper], (product.row[upper], product.col[upper])), shape=product.shape)


def _most_shared(shared: coo_array, min_shared: int, max_per_image: int) -> list[tuple[int, int]]:
    """Pairs taken in the order of how much they share, while one of their images still has room."""
    good = shared.data >= min_shared
    count, i, j = shared.data[good], shared.row[good], shared.col[good]
    room = Counter[int]()
    taken = []
    for at in np.lexsort((j, i, -count)):
        a, b = int(i[at]), int(j[at])
        if room[a] < max_per_image or room[b] < max_per_image:
            room[a] += 1
            room[b] += 1
            taken.append((a, b))
    return sorted(taken)

"""Checks of scans: duplicates, surfaces that leave a motion undetermined, reflections of what the scanner saw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.registration.acceptance import SEEN_THROUGH
from hodge_pipeline.registration.global_evidence import free_directions
from hodge_pipeline.registration.global_features import FEWEST_POINTS
from hodge_pipeline.start.unordered.hypotheses import RIVAL_OVERLAP
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, PointCloud
from hodge_pipeline.types.edges import REJECTED

SURFACE_NEIGHBOURS = 30
SAMPLED_POINTS = 2000
VOLUME = 0.12
"""Least share of variance in a neighbourhood of no surface: a third in a volume, a few per cent on a surface."""
POORER = 0.5
"""Share of the usual best overlap of a scan below which its reflection is matched: half, since a right scan is often as
poor, and matching costs seconds, but decides nothing by itself."""
PARTNERS = 3
"""Scans that a reflection is matched with: those that the scan itself overlaps most."""
SAME_M, SAME_RAD = 0.1, np.radians(1.0)
"""Metres in a room and radians within which two scans lie on each other as they come: GICP errs by a tenth of that; of
two scanners that stand at one spot, turned at random, one in 180 pairs does."""

Match = Callable[[CloudSet, Path], Edges]
"""All pairs of a few clouds, matched and weighed; the folder is for scratch."""


def check_scans(clouds: CloudSet, names: NDArray[np.generic]) -> tuple[str, ...]:
    """One line for each scan whose shape cannot be registered, or that is a copy."""
    notes = _copies(clouds, names)
    for name, cloud in zip(names, clouds, strict=True):
        reason = unregistrable(cloud) if len(cloud) else ""
        if reason:
            notes.append(f"scan {name}: cannot be registered by its shape: {reason}")
    return tuple(notes)


def count_from_one_zero(hypotheses: Edges, room_m: float) -> bool:
    """Whether scans were registered before, all in one frame: a third or more of the pairs that fit do so where they
    lie. Where rooms are alike most may fit wrongly. No scanner stood at that zero, so free space says nothing.
    """
    fits = hypotheses.counts | (hypotheses.why == SEEN_THROUGH)
    lying = fits & _lie_on_each_other(hypotheses, room_m)
    return bool(fits.any()) and 3 * int(lying.sum()) >= int(fits.sum())


def within_their_frame(hypotheses: Edges, room_m: float) -> Edges:
    """The table with every pair rejected whose scans both lie on others where they are, but on each other elsewhere."""
    lying = _lie_on_each_other(hypotheses, room_m)
    placed = np.isin(hypotheses.pairs, hypotheses.pairs[hypotheses.counts & lying]).all(axis=1)
    return hypotheses.put(hypotheses.counts & placed & ~lying, status=REJECTED, why="elsewhere than in their frame")


def _lie_on_each_other(hypotheses: Edges, room_m: float) -> Bools:
    twist = se3.log(hypotheses.i_from_j)
    is_near = np.linalg.norm(twist[:, 3:], axis=1) < SAME_M * room_m
    return np.asarray(is_near & (np.linalg.norm(twist[:, :3], axis=1) < SAME_RAD))


def unregistrable(cloud: PointCloud) -> str:
    """Why a scan cannot be placed by its shape alone, an empty word where it can."""
    if len(cloud) < FEWEST_POINTS:
        return f"it has only {len(cloud)} points"
    points = np.asarray(cloud.points_in_cam, float)
    chosen = points[:: max(1, len(points) // SAMPLED_POINTS)]
    normals, least = surface(points, chosen)
    if float(np.median(least)) > VOLUME:
        return "its points lie on no surface (a blob of noise?)"
    free = free_directions(chosen, normals)
    return f"its surfaces leave open {', '.join(free)}" if free else ""


def surface(points: Floats, queries: Floats) -> tuple[Floats, Floats]:
    """Normals (Q, 3) at the queries, and the share (Q,) of the variance along them, of the 30 nearest points."""
    count = min(SURFACE_NEIGHBOURS, len(points))
    _, rows = cKDTree(points).query(queries, count)
    near = points[rows.reshape(len(queries), count)]
    centred = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("qki,qkj->qij", centred, centred))
    return vectors[:, :, 0], np.maximum(values[:, 0], 0) / np.maximum(values.sum(axis=1), 1e-30)


def _copies(clouds: CloudSet, names: NDArray[np.generic]) -> list[str]:
    first: dict[bytes, int] = {}
    notes = []
    for row, cloud in enumerate(clouds):
        if len(cloud):
            before = first.setdefault(np.ascontiguousarray(cloud.points_in_cam).tobytes(), row)
            if before != row:
                notes.append(f"scan {names[row]}: holds the same points as scan {names[before]}")
    return notes


def mirrored_scans(clouds: CloudSet, hypotheses: Edges, match: Match, scratch: Path) -> Ints:
    """Rows of joined scans whose reflection fits the scans that they are joined to clearly better than they do."""
    edges = hypotheses.select(np.flatnonzero(hypotheses.counts))
    best = np.zeros(len(clouds))
    np.maximum.at(best, edges.pairs, edges.overlap[:, None])
    poor = np.flatnonzero((best > 0) & (best < POORER * np.median(best[best > 0]))) if len(edges) else np.zeros(0, int)
    return np.array([row for row in poor.tolist() if _is_mirrored(row, clouds, edges, match, scratch)], np.int64)


def _is_mirrored(row: int, clouds: CloudSet, edges: Edges, match: Match, scratch: Path) -> bool:
    own = edges.select(np.flatnonzero((edges.pairs == row).any(axis=1)))
    own = own.select(np.argsort(-own.overlap, kind="stable")[:PARTNERS])
    partners = own.pairs.sum(axis=1) - row
    folder = scratch / f"mirrored-{row}"
    folder.mkdir(parents=True)
    CloudSet.from_clouds([reflected(clouds[row]), *(clouds[int(partner)] for partner in partners)]).save(folder)
    found = match(CloudSet.open(folder), folder)
    overlap = np.zeros(len(partners) + 1)
    first = np.flatnonzero(found.counts & (found.pairs[:, 0] == 0))
    overlap[found.pairs[first, 1]] = found.overlap[first]
    return bool((RIVAL_OVERLAP * overlap[1:] > own.overlap).all())


def reflected(cloud: PointCloud) -> PointCloud:
    """The points reflected in x: any other reflection differs from it by a turn."""
    across, normals = np.array([-1, 1, 1], np.float32), cloud.normals_in_cam
    return PointCloud(across * cloud.points_in_cam, None if normals is None else across * normals)

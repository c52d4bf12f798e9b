"""Checks of scans before registration: duplicates, surfaces that leave a motion undetermined."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from hodge_pipeline.registration.global_evidence import free_directions
from hodge_pipeline.registration.global_features import FEWEST_POINTS
from hodge_pipeline.types import CloudSet, Floats, PointCloud

SURFACE_NEIGHBOURS = 30
SAMPLED_POINTS = 2000
VOLUME = 0.12
"""Least share of variance in a neighbourhood of no surface: a third in a volume, a few per cent on a surface."""


def check_scans(clouds: CloudSet, names: NDArray[np.generic]) -> tuple[str, ...]:
    """One line for each scan whose shape cannot be registered, or that is a copy."""
    notes = _copies(clouds, names)
    for name, cloud in zip(names, clouds, strict=True):
        reason = unregistrable(cloud) if len(cloud) else ""
        if reason:
            notes.append(f"scan {name}: cannot be registered by its shape: {reason}")
    return tuple(notes)


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

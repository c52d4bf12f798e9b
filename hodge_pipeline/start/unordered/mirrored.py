"""Scans that are reflections of what the scanner saw, as by an axis of the wrong sign."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from hodge_pipeline.start.unordered.hypotheses import RIVAL_OVERLAP
from hodge_pipeline.types import CloudSet, Edges, Ints, PointCloud

POORER = 0.5
"""Share of the usual best overlap of a scan below which its reflection is matched: half, since a right scan is often as
poor, and matching costs seconds, but decides nothing by itself."""
PARTNERS = 3
"""Scans that a reflection is matched with: those that the scan itself overlaps most."""

Match = Callable[[CloudSet, Path], Edges]
"""All pairs of a few clouds, matched and weighed; the folder is for scratch."""


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

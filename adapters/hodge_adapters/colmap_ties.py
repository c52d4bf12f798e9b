"""What ties two points, or two models, together: keypoints that the database matched, and images that both have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from hodge_adapters.colmap_database import database_matches
from hodge_adapters.colmap_records import NO_POINT
from hodge_pipeline.types import Floats, Ints

MERGE_ERROR_PX = 4.0
"""Two points are one where their common position is this near to all observations of both; COLMAP's own limit."""
NEAR_SHARE = 0.03
"""Of a point's distance from the cameras: how far apart two models may place it and still agree."""
LEAST_TIES = 12
LEAST_TIE_SHARE = 0.15


@dataclass(frozen=True)
class Ties:
    """Points that are the same: `ids (T, 2)` in the one model and the other."""

    ids: Ints


def point_ids_by_name(reconstruction: pycolmap.Reconstruction) -> dict[str, Ints]:
    """The point of each keypoint of each posed image, `NO_POINT` where it has none."""
    invalid = pycolmap.INVALID_POINT3D_ID
    out = {}
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.images[image_id]
        ids = (NO_POINT if p.point3D_id == invalid else p.point3D_id for p in image.points2D)
        out[image.name] = np.fromiter(ids, np.int64, image.num_points2D())
    return out


def merge_matched_points(reconstruction: pycolmap.Reconstruction, database: Path) -> int:
    """How many pairs of points that a match calls one were merged, where one position serves all their images."""
    of_name = point_ids_by_name(reconstruction)
    merged: dict[int, int] = {}
    count = 0
    for a, b in _matched_points(of_name, of_name, database):
        first, second = _current(merged, a), _current(merged, b)
        if first == second or not _is_one(reconstruction, first, second):
            continue
        new = reconstruction.merge_points3D(first, second)
        merged[first] = merged[second] = new
        merged.pop(new, None)
        count += 1
    return count


def tie_points(first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, database: Path | None) -> Ties:
    """Points of two models that a match, or an image in both, calls one."""
    of_first, of_second = point_ids_by_name(first), point_ids_by_name(second)
    pairs: set[tuple[int, int]] = set()
    for name in of_first.keys() & of_second.keys():
        a, b = of_first[name], of_second[name]
        if len(a) == len(b):
            both = (a != NO_POINT) & (b != NO_POINT)
            pairs.update(zip(a[both].tolist(), b[both].tolist(), strict=True))
    if database is not None:
        pairs.update(_matched_points(of_first, of_second, database))
    return Ties(np.array(sorted(pairs), np.int64).reshape(-1, 2))


def similarity(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, ties: Ties
) -> tuple[pycolmap.Sim3d, int] | None:
    """`first_from_second` by the tied points, and how many agree with it; None where too few do."""
    if len(ties.ids) < LEAST_TIES:
        return None
    here = np.array([first.points3D[a].xyz for a in ties.ids[:, 0].tolist()])
    there = np.array([second.points3D[b].xyz for b in ties.ids[:, 1].tolist()])
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = NEAR_SHARE * _distance(first), 0
    options.min_inlier_ratio, options.confidence, options.max_num_trials = 0.05, 0.9999, 20_000
    found: Any = pycolmap.estimate_sim3d_robust(there, here, options)
    if found is None or found["num_inliers"] < max(LEAST_TIES, LEAST_TIE_SHARE * len(ties.ids)):
        return None
    return found["tgt_from_src"], int(found["num_inliers"])


def _matched_points(of_first: dict[str, Ints], of_second: dict[str, Ints], database: Path) -> Iterator[tuple[int, int]]:
    """Distinct pairs of different points that matched keypoints of the two sets of images belong to."""
    names = list(dict.fromkeys([*of_first, *of_second]))
    seen = set()
    for i, j, matches in database_matches(database, {name: row for row, name in enumerate(names)}):
        for one, other, columns in ((names[i], names[j], matches), (names[j], names[i], matches[:, ::-1])):
            a, b = of_first.get(one), of_second.get(other)
            if a is None or b is None or not len(columns):
                continue
            inside = (columns[:, 0] < len(a)) & (columns[:, 1] < len(b))
            first, second = a[columns[inside, 0]], b[columns[inside, 1]]
            both = (first != NO_POINT) & (second != NO_POINT)
            if of_first is of_second:
                both &= first < second
            for pair in zip(first[both].tolist(), second[both].tolist(), strict=True):
                if pair not in seen:
                    seen.add(pair)
                    yield pair


def _current(merged: dict[int, int], point_id: int) -> int:
    while point_id in merged:
        point_id = merged[point_id]
    return point_id


def _is_one(reconstruction: pycolmap.Reconstruction, first: int, second: int) -> bool:
    a, b = reconstruction.points3D[first], reconstruction.points3D[second]
    elements = [*a.track.elements, *b.track.elements]
    if len({element.image_id for element in elements}) < len(elements):
        return False  # an image would see it twice
    share = a.track.length() / len(elements)
    xyz = share * a.xyz + (1 - share) * b.xyz
    for element in elements:
        image = reconstruction.images[element.image_id]
        pixel = image.project_point(xyz)
        if pixel is None or np.linalg.norm(pixel - image.points2D[element.point2D_idx].xy) > MERGE_ERROR_PX:
            return False
    return True


def _distance(reconstruction: pycolmap.Reconstruction) -> float:
    """The median distance of the points from the middle of the cameras."""
    centres = np.array([reconstruction.images[i].projection_center() for i in reconstruction.reg_image_ids()])
    points = np.array([point.xyz for point in reconstruction.points3D.values()]).reshape(-1, 3)
    distances: Floats = np.linalg.norm(points - np.median(centres, axis=0), axis=1)
    return float(np.median(distances))

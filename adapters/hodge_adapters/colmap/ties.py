"""What ties two points, or two models, together: keypoints that the database matched, and images that both have."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.colmap.database import database_matches
from hodge_adapters.colmap.points import nearest_to_rays
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import NO_POINT
from hodge_pipeline.types import Floats, Ints

MERGE_ERROR_PX = 4.0
"""Two points are one where their common position is this near to all observations of both; COLMAP's own limit."""
NEAR_SHARE = 0.03
"""Of a point's distance from the cameras: how far apart two models may place it and still agree."""
LEAST_TIES = 12
LEAST_TIE_SHARE = 0.15
REFITS = 5
"""Each to the better half, as least trimmed squares concentrate."""


def point_ids_by_name(reconstruction: pycolmap.Reconstruction) -> dict[str, Ints]:
    """The point of each keypoint of each posed image, `NO_POINT` where it has none."""
    invalid = pycolmap.INVALID_POINT3D_ID
    out = {}
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.images[image_id]
        ids = (NO_POINT if p.point3D_id == invalid else p.point3D_id for p in image.points2D)
        out[image.name] = np.fromiter(ids, np.int64, image.num_points2D())
    return out


def merge_matched_points(reconstruction: pycolmap.Reconstruction, database: Path, min_shared: int) -> int:
    """How many pairs of points that a match calls one were merged, where one position serves all their images.

    Only between images that the database matches well and the model holds apart: the ends of a chain that should meet,
    two models just joined. What COLMAP did not merge elsewhere it had reason to leave.
    """
    of_name = point_ids_by_name(reconstruction)
    merged: dict[int, int] = {}
    count = 0
    for a, b in _matched_points(of_name, of_name, database, min_shared):
        first, second = _current(merged, a), _current(merged, b)
        xyz = None if first == second else _common_position(reconstruction, first, second)
        if xyz is None:
            continue
        new = reconstruction.merge_points3D(first, second)
        reconstruction.points3D[new].xyz = xyz
        merged[first] = merged[second] = new
        merged.pop(new, None)
        count += 1
    return count


def held_apart(reconstruction: pycolmap.Reconstruction, database: Path, min_shared: int) -> int:
    """How many pairs of images the database matches well while the model holds them apart."""
    of_name = point_ids_by_name(reconstruction)
    names = list(of_name)
    pairs = database_matches(database, {name: row for row, name in enumerate(names)})
    return sum(_is_apart(of_name[names[i]], of_name[names[j]], len(matches), min_shared) for i, j, matches in pairs)


def tie_points(first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, database: Path | None) -> Ints:
    """The ids (T, 2) of points of two models that a match, or an image in both, calls one."""
    of_first, of_second = point_ids_by_name(first), point_ids_by_name(second)
    pairs: set[tuple[int, int]] = set()
    for name in of_first.keys() & of_second.keys():
        a, b = of_first[name], of_second[name]
        if len(a) == len(b):
            both = (a != NO_POINT) & (b != NO_POINT)
            pairs.update(zip(a[both].tolist(), b[both].tolist(), strict=True))
    if database is not None:
        pairs.update(_matched_points(of_first, of_second, database))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)


def similarity(
    first: pycolmap.Reconstruction, second: pycolmap.Reconstruction, ties: Ints
) -> tuple[pycolmap.Sim3d, int] | None:
    """`first_from_second` by the tied points (T, 2), and how many agree with it; None where too few do."""
    if len(ties) < LEAST_TIES:
        return None
    here = np.array([first.points3D[a].xyz for a in ties[:, 0].tolist()])
    there = np.array([second.points3D[b].xyz for b in ties[:, 1].tolist()])
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = NEAR_SHARE * _distance(first), 0
    options.min_inlier_ratio, options.confidence, options.max_num_trials = 0.05, 0.9999, 20_000
    found: Any = pycolmap.estimate_sim3d_robust(there, here, options)
    if found is None or found["num_inliers"] < max(LEAST_TIES, LEAST_TIE_SHARE * len(ties)):
        return None
    return _refitted(found["tgt_from_src"], there, here, found["inlier_mask"]), int(found["num_inliers"])


def _refitted(motion: pycolmap.Sim3d, there: Floats, here: Floats, mask: Any) -> pycolmap.Sim3d:
    """Fitted again to the ties that agree best: those of a keypoint in both models are far better than matched ones."""
    kept = np.asarray(mask, bool)
    for _ in range(REFITS):
        away: Floats = np.linalg.norm(here - np.array([motion * point for point in there]), axis=1)
        near = kept & (away <= np.median(away[kept]))
        if near.sum() < LEAST_TIES:
            break
        again = pycolmap.estimate_sim3d(there[near], here[near])
        if again is None:
            break
        motion = again
    return motion


def _matched_points(
    of_first: dict[str, Ints], of_second: dict[str, Ints], database: Path, min_shared: int = 0
) -> Iterator[tuple[int, int]]:
    """Distinct pairs of different points that matched keypoints of the two sets of images belong to.

    With `min_shared`: only of pairs of images with so many matches that share less than half so many points.
    """
    names = list(dict.fromkeys([*of_first, *of_second]))
    seen = set()
    for i, j, matches in database_matches(database, {name: row for row, name in enumerate(names)}):
        if min_shared and not _is_apart(of_first[names[i]], of_first[names[j]], len(matches), min_shared):
            continue
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


def _is_apart(a: Ints, b: Ints, matches: int, min_shared: int) -> bool:
    return matches >= min_shared and 2 * _shared(a, b) < min_shared


def _shared(a: Ints, b: Ints) -> int:
    """How many points both images see."""
    return len(np.intersect1d(a[a != NO_POINT], b[b != NO_POINT]))


def _current(merged: dict[int, int], point_id: int) -> int:
    while point_id in merged:
        point_id = merged[point_id]
    return point_id


def _common_position(reconstruction: pycolmap.Reconstruction, first: int, second: int) -> Floats | None:
    """Where the rays of both points' tracks meet, None where that is not near every observation."""
    points = (reconstruction.points3D[first], reconstruction.points3D[second])
    elements = [element for point in points for element in point.track.elements]
    if len({element.image_id for element in elements}) < len(elements):
        return None  # an image would see it twice
    images = [reconstruction.images[element.image_id] for element in elements]
    pixels = [image.points2D[e.point2D_idx].xy for image, e in zip(images, elements, strict=True)]
    xyz = _meeting(images, pixels)
    if xyz is None:
        share = points[0].track.length() / len(elements)
        xyz = share * points[0].xyz + (1 - share) * points[1].xyz
    seen = [image.project_point(xyz) for image in images]
    near = (p is not None and np.linalg.norm(p - q) <= MERGE_ERROR_PX for p, q in zip(seen, pixels, strict=True))
    return xyz if all(near) else None


def _meeting(images: list[pycolmap.Image], pixels: list[Floats]) -> Floats | None:
    """The point nearest to the rays of these pixels; None where the rays are parallel."""
    rays = []
    for image, pixel in zip(images, pixels, strict=True):
        camera = image.camera
        plane = None if camera is None else camera.cam_from_img(pixel)
        if plane is None:
            return None
        ray = np.asarray(image.cam_from_world().rotation.matrix()).T @ np.array([*plane, 1.0])
        rays.append(ray / np.linalg.norm(ray))
    centres = np.array([image.projection_center() for image in images])
    found = nearest_to_rays(centres, np.array(rays), np.zeros(len(rays), np.int64), 1)[0]
    return None if np.isnan(found).any() else found


def _distance(reconstruction: pycolmap.Reconstruction) -> float:
    """The median distance of the points from the middle of the cameras."""
    centres = np.array([reconstruction.images[i].projection_center() for i in reconstruction.reg_image_ids()])
    points = np.array([point.xyz for point in reconstruction.points3D.values()]).reshape(-1, 3)
    distances: Floats = np.linalg.norm(points - np.median(centres, axis=0), axis=1)
    return float(np.median(distances))

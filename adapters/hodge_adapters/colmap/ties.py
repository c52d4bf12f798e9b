"""What ties two points, or two models, together: keypoints that the database matched, and images that both have."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.colmap.database import database_matches
from hodge_adapters.colmap.edges import shared_counts
from hodge_adapters.colmap.points import nearest_to_rays
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import NO_POINT, Model
from hodge_pipeline.types import Floats, Ints

MERGE_ERROR_PX = 4.0
"""Two points are one where their common position is this near to all observations of both; COLMAP's own limit."""
NEAR_SHARE = 0.03
"""Of a point's distance from the cameras: how far apart two models may place it and still agree. Halves of nine real
models, each adjusted alone, place four in five ties within 0.04 to 1.9 % of each other, and of one that bends 5.4 %."""
LEAST_TIES = 12
"""Ties that agree: of 12 to 400 random ones at most 5 do, in 360 scenes, flat and deep."""
LEAST_TIE_SHARE = 0.15
"""Of the ties: three right ones of so many are found (1 - 1e-4) in some 8000 trials."""
REFITS = 5
"""Each to the better half, as least trimmed squares concentrate: more of them move points by some 1e-5."""


def merge_matched_points(
    reconstruction: pycolmap.Reconstruction, content: Model, database: Path, min_shared: int
) -> int:
    """How many pairs of points that a match calls one were merged, where one position serves all their images;
    `content`: the reconstruction's.

    Only between images that the database matches well and the model holds apart: the ends of a chain that should meet,
    two models just joined. What COLMAP did not merge elsewhere it had reason to leave.
    """
    ids = [image.point_ids for image in content.images]
    merged: dict[int, int] = {}
    count = 0
    for a, b in _matched_points(ids, ids, apart_matches(content, database, min_shared)):
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


def apart_matches(content: Model, database: Path, min_shared: int) -> Iterator[tuple[int, int, Ints]]:
    """Rows of two images that the database matches well while the model holds them apart, and what matches."""
    shared = shared_counts(content)
    pairs = zip(shared.row.tolist(), shared.col.tolist(), strict=True)
    count = dict(zip(pairs, shared.data.tolist(), strict=True))
    rows = {image.name: row for row, image in enumerate(content.images)}
    for i, j, matches in database_matches(database, rows):
        if len(matches) >= min_shared and 2 * count.get((min(i, j), max(i, j)), 0) < min_shared:
            yield i, j, matches


def tie_points(first: Model, second: Model, database: Path | None) -> Ints:
    """The ids (T, 2) of points of two models that a match, or an image in both, calls one."""
    names = list(dict.fromkeys(image.name for model in (first, second) for image in model.images))
    of_first, of_second = ({image.name: image.point_ids for image in model.images} for model in (first, second))
    pairs: set[tuple[int, int]] = set()
    for name in of_first.keys() & of_second.keys():
        a, b = of_first[name], of_second[name]
        if len(a) == len(b):
            both = (a != NO_POINT) & (b != NO_POINT)
            pairs.update(zip(a[both].tolist(), b[both].tolist(), strict=True))
    if database is not None:
        matches = database_matches(database, {name: row for row, name in enumerate(names)})
        here, there = ([of.get(name, np.zeros(0, np.int64)) for name in names] for of in (of_first, of_second))
        pairs.update(_matched_points(here, there, matches))
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
    options.min_inlier_ratio, options.confidence = LEAST_TIE_SHARE, 0.9999
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
    of_first: list[Ints], of_second: list[Ints], found: Iterable[tuple[int, int, Ints]]
) -> Iterator[tuple[int, int]]:
    """Distinct pairs of different points that matched keypoints of two models belong to, by the points of each row of
    images.
    """
    seen = set()
    for i, j, matches in found:
        for one, other, columns in ((i, j, matches), (j, i, matches[:, ::-1])):
            a, b = of_first[one], of_second[other]
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

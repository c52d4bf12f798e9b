"""The scale of a COLMAP model, which is arbitrary, in metres: by what a depth sensor saw at the model's points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from hodge_adapters.colmap.cameras import colmap_camera, scaled_camera
from hodge_adapters.colmap.edges import positions
from hodge_adapters.colmap.records import NO_POINT, Model
from hodge_adapters.images import pixels
from hodge_adapters.images.lens_models import HALF_PIXEL
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Floats32
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.text import counted

SAMPLED_IMAGES = 12
"""Depth images read where the scale is only stated or a camera only asked for: 4 CPU ms each of 640x480."""
MOST_IMAGES = 200
"""Depth images read for a model's scale, which takes 1 CPU s."""
LEAST_POINTS = 50
"""Points with depth: the median of their ratios is then known to a quarter of what half of them differ from it by."""
FOCAL_FACTORS = (0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2, 1.25)
"""Focal lengths of a depth camera over those of the images: a Kinect has 1.11. Half a step moves a pixel by 2.5 % of
its distance from the centre."""
CLEARLY_BETTER, LEAST_TOLD = 0.7, 300
"""What the spread through another focal length is, of that through the images', where it tells; and of how many ratios:
where all spread alike the best of nine others is so much better in one of 1000 cases (of 50 in every third)."""


def metres_per_unit(
    model: Model, sensors: Mapping[int, Path], units_per_metre: float, no_depth: tuple[int, ...], notes: list[str]
) -> float:
    """The median of sensor depth over model depth at the observations of a few images; 1 where too few."""
    rows = _evenly(sensors, SAMPLED_IMAGES)
    found = _ratios(seen_depths(model, {row: sensors[row] for row in rows}, units_per_metre, no_depth))
    if len(found) < LEAST_POINTS:
        notes.append(f"scale 1 m per unit: only {counted(len(found), 'point has|points have')} sensor depth; set scale")
        return 1.0
    scale = float(np.median(found))
    low, high = np.percentile(found, [25, 75]) / scale
    notes.append(
        f"scale {scale:.6g} m per unit, by sensor depth at {counted(len(found), 'point')} (half within "
        f"{low:.3f}–{high:.3f})"
    )
    return scale


def other_camera_note(
    model: Model, sensors: Mapping[int, Path], units_per_metre: float, no_depth: tuple[int, ...]
) -> str | None:
    """A complaint where depth fits the points much better through a camera of another focal length than the colour's.

    Then depth and colour are of two cameras, and nobody has laid the one onto the other's pixels.
    """
    depths: dict[float, list[Floats]] = {factor: [] for factor in FOCAL_FACTORS}
    rows = _evenly(sensors, SAMPLED_IMAGES)
    for row, depth in _read({row: sensors[row] for row in rows}, units_per_metre, no_depth):
        record = model.cameras[model.images[row].camera_id]
        camera = scaled_camera(record, (depth.shape[1], depth.shape[0]))
        centre = camera.principal_point_x - HALF_PIXEL, camera.principal_point_y - HALF_PIXEL
        for factor, found in depths.items():
            given = factor * camera.focal_length_x, factor * camera.focal_length_y, *centre
            found.append(_seen_depths(model, row, depth, given))
    spreads = {factor: _spread(_ratios(found)) for factor, found in depths.items()}
    best = min(spreads, key=lambda factor: spreads[factor])
    if not spreads[best] < CLEARLY_BETTER * spreads[1.0]:
        return None
    return (
        f"depth seems to be of another camera than the images: half of its ratios to the points lie within "
        f"{spreads[best]:.1%} instead of {spreads[1.0]:.1%} with a focal length {best:g} times theirs: "
        "give --depth-camera"
    )


def seen_depths(
    model: Model,
    sensors: Mapping[int, Path],
    units_per_metre: float,
    no_depth: tuple[int, ...],
    camera: tuple[float, float, float, float] | None = None,
) -> Sequence[Floats]:
    """For each image (by row), of `MOST_IMAGES` evenly: at its observations (K, 3) metres by the sensor, units by the
    model, and the length of the ray to unit depth.

    `camera`: fx fy cx cy of the depth images; none where their pixels are those of the colour images. Raises
    `SourceError` where none of them can be read.
    """
    chosen = {row: sensors[row] for row in _evenly(sensors, MOST_IMAGES)}
    return [_seen_depths(model, row, depth, camera) for row, depth in _read(chosen, units_per_metre, no_depth)]


def _evenly(sensors: Mapping[int, Path], most: int) -> list[int]:
    """At most so many of the rows, evenly."""
    rows = sorted(sensors)
    return [rows[at] for at in evenly(len(rows), most)]


def _read(
    sensors: Mapping[int, Path], units_per_metre: float, no_depth: tuple[int, ...]
) -> Iterator[tuple[int, Floats32]]:
    """Each row with its depth in metres. Raises `SourceError` at the end where none of them can be read."""
    fault: SourceError | None = None
    can_read = False
    for row, path in sensors.items():
        try:
            depth = pixels.read_depth(path, units_per_metre=units_per_metre, no_depth=no_depth)
        except SourceError as error:  # the frame itself reports it when it is read
            fault = fault or error
            continue
        can_read = True
        yield row, depth
    if fault is not None and not can_read:
        raise fault


def _spread(ratios: Floats) -> float:
    """Within which share of their median half of the ratios lie; infinite where they are too few."""
    return float(np.median(np.abs(ratios / np.median(ratios) - 1))) if len(ratios) >= LEAST_TOLD else np.inf


def _ratios(depths: Sequence[Floats]) -> Floats:
    """Metres by the sensor over units by the model, of all images."""
    found = np.concatenate([np.zeros((0, 3)), *depths])
    return np.asarray(found[:, 0] / found[:, 1])


def _seen_depths(model: Model, row: int, depth: Floats32, camera: tuple[float, float, float, float] | None) -> Floats:
    image = model.images[row]
    record = model.cameras[image.camera_id]
    seen = image.point_ids != NO_POINT
    xyz = positions(model, image.point_ids[seen])
    in_cam = se3.transform(se3.inverse(image.world_from_cam), xyz)
    expected: Floats = in_cam[:, 2]
    grid = np.array([depth.shape[1] / record.width, depth.shape[0] / record.height])
    pixels = image.pixels[seen] * grid
    if camera is not None:
        rays = np.nan_to_num(np.asarray(colmap_camera(record).cam_from_img(image.pixels[seen])), nan=-1e3)
        pixels = rays * np.array(camera[:2]) + np.array(camera[2:]) + HALF_PIXEL
    columns, rows = np.floor(pixels).astype(np.int64).T
    good = (columns >= 0) & (rows >= 0) & (columns < depth.shape[1]) & (rows < depth.shape[0]) & (expected > 0)
    measured: Floats = depth[rows[good], columns[good]].astype(np.float64)
    ray = np.linalg.norm(in_cam[good], axis=1) / expected[good]
    return np.stack([measured, expected[good], ray], axis=1)[measured > 0]

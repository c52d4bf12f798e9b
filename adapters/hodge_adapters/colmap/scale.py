"""The scale of a COLMAP model, which is arbitrary, in metres: by what a depth sensor saw at the model's points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_adapters.colmap.cameras import colmap_camera
from hodge_adapters.colmap.edges import positions
from hodge_adapters.colmap.records import NO_POINT, Model
from hodge_adapters.images import pixels
from hodge_adapters.images.lens_models import HALF_PIXEL
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Floats32, ViewGraph
from hodge_pipeline.types.text import counted

SAMPLED_IMAGES = 12
MOST_IMAGES = 200
LEAST_POINTS = 50
FOCAL_FACTORS = (0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2, 1.25)
CLEARLY_BETTER = 0.7


def metres_per_unit(
    model: Model, sensors: Mapping[int, Path], units_per_metre: float, no_depth: tuple[int, ...], notes: list[str]
) -> float:
    """The median of sensor depth over model depth at the observations of a few images; 1 where too few."""
    rows = sorted(sensors)
    picked = np.unique(np.linspace(0, len(rows) - 1, SAMPLED_IMAGES).round().astype(int))
    chosen = {rows[at]: sensors[rows[at]] for at in picked}
    found = _ratios(seen_depths(model, chosen, units_per_metre, no_depth))
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
    rows = np.array(sorted(sensors), np.int64)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, SAMPLED_IMAGES).round().astype(int))]
    spreads = {}
    for factor in FOCAL_FACTORS:
        depths = list[Floats]()
        for row in rows.tolist():
            record = model.cameras[model.images[row].camera_id]
            camera = colmap_camera(record)
            size = pixels.image_size(sensors[row])
            if size != (record.width, record.height):
                camera.rescale(*size)
            given = (
                factor * camera.focal_length_x,
                factor * camera.focal_length_y,
                camera.principal_point_x - HALF_PIXEL,
                camera.principal_point_y - HALF_PIXEL,
            )
            depths += seen_depths(model, {row: sensors[row]}, units_per_metre, no_depth, given)
        found = _ratios(depths)
        spreads[factor] = (
            float(np.median(np.abs(found / np.median(found) - 1))) if len(found) >= LEAST_POINTS else np.inf
        )
    best = min(spreads, key=lambda factor: spreads[factor])
    if not spreads[best] < CLEARLY_BETTER * spreads[1.0]:
        return None
    return (
        f"depth seems to be of another camera than the images: half of its ratios to the points lie within "
        f"{spreads[best]:.1%} instead of {spreads[1.0]:.1%} with a focal length {best:g} times theirs: "
        "give --depth-camera"
    )


def scaled_poses(world_from_cam: Floats, scale: float) -> Floats:
    """The poses with their positions in metres."""
    scaled: Floats = world_from_cam.copy()
    scaled[:, :3, 3] *= scale
    return scaled


def scaled_graph(graph: ViewGraph, scale: float) -> ViewGraph:
    """The graph with translations and their information in metres."""
    unit = np.array([1.0, 1.0, 1.0, scale, scale, scale])
    return replace(
        graph, i_from_j=scaled_poses(graph.i_from_j, scale), information=graph.information / np.outer(unit, unit)
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
    rows = np.array(sorted(sensors), np.int64)
    if len(rows) > MOST_IMAGES:
        rows = rows[np.linspace(0, len(rows) - 1, MOST_IMAGES).round().astype(int)]
    depths, faults = list[Floats](), list[SourceError]()
    for row in rows.tolist():
        try:
            depth = pixels.read_depth(sensors[row], units_per_metre=units_per_metre, no_depth=no_depth)
        except SourceError as fault:  # the frame itself reports it when it is read
            faults.append(fault)
            continue
        depths.append(_seen_depths(model, row, depth, camera))
    if faults and not depths:
        raise faults[0]
    return depths


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

"""Recipes are written for rooms; one factor on all their lengths serves scans of a statue or of a forest as well."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.registration.in_units import InUnits
from hodge_pipeline.stages import Registrar, Step, Steps
from hodge_pipeline.types import Floats, Frame, Source
from hodge_pipeline.types.notes import Note

T = TypeVar("T")
SECTIONS = (
    "clouds",
    "start",
    "edges",
    "registration",
    "complex",
    "acceptance",
    "solver",
    "fusion",
)
FEWEST_VOXELS, MOST_VOXELS, WANTED_VOXELS = 1500, 40_000, 8000
"""Below the first a scan has too few features to be found again; beyond the second matching two takes many seconds;
scans of a room have about the third."""
SCANS_LOOKED_AT = 9
POINTS_LOOKED_AT = 1_000_000
MOST_STEPS = 40
FULL = 0.5
"""Voxels over points, from which smaller voxels show nothing more."""
MILLIMETRES = 100.0
"""The factor from which the unit is doubted: no scanner reaches a hundred rooms."""
POINTS_IN_VOXEL = 3
"""Wanted of a scan of few points: a voxel with one of them knows nothing of a surface."""


def with_scale(recipe: Recipe, source: Source, steps: Steps) -> Recipe:
    """The recipe with its `scale` on every length; auto: measured on the scans first, and reported."""
    if recipe.scale == "auto":
        wanted = steps.step(scale_of_scans, source, recipe.clouds.voxel_m, title="scale of the scans")
    else:
        wanted = recipe.scale
    return dataclasses.replace(scaled_recipe(recipe, wanted), scale=wanted)


def scale_of_scans(source: Source, voxel_m: float, *, step: Step) -> float:
    """Step: the factor on lengths that suits the scans of a source."""
    factor = measured_scale(source.frames, voxel_m)
    if factor != 1.0:
        step.note(Note("millimetres" if factor > MILLIMETRES else "scale", detail=_said(factor, voxel_m)))
    return factor


def scaled_recipe(recipe: Recipe, factor: float) -> Recipe:
    """The recipe with every length of its stages times the factor."""
    if factor == 1.0:
        return recipe
    return dataclasses.replace(recipe, **{name: scaled(getattr(recipe, name), factor) for name in SECTIONS})


def scaled(value: T, factor: float) -> T:
    """Options with every number whose name ends in `_m`, and those of the stages inside, times the factor.

    A registrar keeps its options, and is given clouds in the unit that they are written for.
    """
    if isinstance(value, tuple):
        return type(value)(scaled(each, factor) for each in value)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    if isinstance(value, InUnits):
        return dataclasses.replace(value, unit_m=value.unit_m * factor)
    if isinstance(value, Registrar):
        return cast(T, InUnits(value, factor))
    changed = {}
    for field in dataclasses.fields(value):
        old = getattr(value, field.name)
        changed[field.name] = _times(old, factor) if field.name.endswith("_m") else scaled(old, factor)
    return dataclasses.replace(value, **changed)


def _times(length: Any, factor: float) -> Any:
    if length is None:
        return None
    return tuple(each * factor for each in length) if isinstance(length, tuple) else length * factor


def measured_scale(frames: Sequence[Frame], voxel_m: float) -> float:
    """The factor on lengths that suits these scans, to two digits: 1 where the voxels of most are neither few nor many.

    Frames with depth images are of rooms; unreadable ones are left to whoever reads them next.
    """
    scans = [frame for frame in frames if frame.read_points is not None]
    step = max(1, len(scans) // SCANS_LOOKED_AT)
    factors = [factor for frame in scans[::step] if np.isfinite(factor := _factor(_points(frame), voxel_m))]
    return float(f"{np.exp(np.median(np.log(factors))):.2g}") if factors else 1.0


def _points(frame: Frame) -> Floats:
    try:
        points = frame.read_points().points_in_cam if frame.read_points else np.zeros((0, 3), np.float32)
    except (SourceError, OSError):
        return np.zeros((0, 3))
    some = np.asarray(points[:: max(1, len(points) // POINTS_LOOKED_AT)], float)
    return np.asarray(some[np.isfinite(some).all(axis=1)])


def _factor(points: Floats, voxel_m: float) -> float:
    """The factor on a voxel with which a scan has the wanted number of them; NaN for a handful of points."""
    if len(points) < FEWEST_VOXELS:
        return float("nan")
    factor, count = 1.0, _occupied(points, voxel_m)
    # Where each point has a voxel of its own, as in a scan of few beams, voxels say nothing of the surfaces; in a cloud
    # that was thinned before, twice the voxel holds several.
    is_sparse = _occupied(points, 2 * voxel_m) > FULL * len(points)
    wanted = min(WANTED_VOXELS, len(points) // POINTS_IN_VOXEL) if is_sparse else WANTED_VOXELS
    most = wanted if is_sparse else MOST_VOXELS
    if FEWEST_VOXELS <= count <= most:
        return 1.0
    step = 2.0 if count > most else 0.5
    for _ in range(MOST_STEPS):
        before, factor = count, factor * step
        count = _occupied(points, voxel_m * factor)
        if (count <= wanted) == (step > 1) or (step < 1 and count > FULL * len(points)):
            slope = (np.log(count) - np.log(before)) / np.log(step)
            return float(np.exp(np.log(factor) + (np.log(wanted) - np.log(count)) / slope)) if slope else factor
    return float("nan")  # a single place: no scale shows more


def _occupied(points: Floats, voxel_m: float) -> int:
    """How many voxels hold a point: by hash, since a cell's number may have any size."""
    cells = np.floor((points - points.min(axis=0)) / voxel_m).astype(np.int64)
    return len(np.unique(cells @ np.array([73_856_093, 19_349_663_000_003, 83_492_791_000_000_063])))


def _said(factor: float, voxel_m: float) -> str:
    size = "larger" if factor > 1 else "smaller"
    text = (
        f"the scans are {size} than a room: all lengths of the recipe are taken times {factor:g} (clouds.voxel_m is "
        f"{voxel_m * factor:.3g} m); scale=1 leaves them as they are"
    )
    millimetres = "if their unit is the millimetre, set source.reader.units_per_metre=1000; else "
    return (millimetres if factor > MILLIMETRES else "") + text

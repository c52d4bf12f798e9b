"""The scale of a recipe: one factor on all lengths, which are written for rooms, for a statue or a forest."""

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
SECTIONS = ("clouds", "start", "edges", "registration", "complex", "acceptance", "solver", "fusion")
"""Sections of a recipe that have lengths."""
FEWEST_VOXELS, MOST_VOXELS, WANTED_VOXELS = 1500, 40_000, 8000
"""Occupied voxels of a scan: with fewer it has too few features to be recognised, with more matching two takes many
seconds; scans of a room have about the third number."""
SCANS_SAMPLED, POINTS_SAMPLED = 9, 1_000_000
"""Scans by which the scale is measured, and points of each."""
MOST_STEPS = 40
"""Doublings of the voxel: 1e12 times, beyond which the scan is a single place."""
FULL = 0.5
"""Voxels over points above which smaller voxels show nothing more."""
NO_METRES = 100.0
"""Factor beyond which the unit is in doubt: no scanner reaches a hundred rooms."""
POINTS_IN_VOXEL = 3
"""Points to a voxel wanted of a sparse scan: one point in a voxel tells nothing of a surface."""


def with_scale(recipe: Recipe, source: Source, steps: Steps) -> Recipe:
    """The recipe with every length times its `scale`; `auto` is measured by the scans, as a step, and reported."""
    if recipe.scale == "auto":
        wanted = steps.step(scale_of_scans, source, recipe.clouds.voxel_m, title="scale of the scans")
    else:
        wanted = recipe.scale
    return dataclasses.replace(scaled_recipe(recipe, wanted), scale=wanted)


def scale_of_scans(source: Source, voxel_m: float, *, step: Step) -> float:
    """Step: the factor on lengths that suits the scans of a source; a note where it is not 1."""
    factor = measured_scale(source.frames, voxel_m)
    if factor != 1.0:
        step.note(Note("scan unit" if factor > NO_METRES else "scale", detail=_in_words(factor, voxel_m)))
    return factor


def scaled_recipe(recipe: Recipe, factor: float) -> Recipe:
    """The recipe with every length of its `SECTIONS` times the factor."""
    if factor == 1.0:
        return recipe
    return dataclasses.replace(recipe, **{name: scaled(getattr(recipe, name), factor) for name in SECTIONS})


def scaled(value: T, factor: float) -> T:
    """Options with every number whose name ends in `_m`, also in the stages inside, times the factor.

    A registrar keeps its options and gets clouds in their unit instead (`InUnits`).
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
    """The factor on lengths that suits these scans, to two digits: 1 where most have a suitable number of voxels.

    Frames with depth images are taken to be of rooms; unreadable scans are left out, and reported by the next step.
    """
    scans = [frame for frame in frames if frame.read_points is not None]
    step = max(1, len(scans) // SCANS_SAMPLED)
    factors = [factor for frame in scans[::step] if np.isfinite(factor := _factor(_points(frame), voxel_m))]
    return float(f"{np.exp(np.median(np.log(factors))):.2g}") if factors else 1.0


def _points(frame: Frame) -> Floats:
    """Finite points (N, 3) of a scan, evenly strided; none of one that cannot be read."""
    try:
        points = frame.read_points().points_in_cam if frame.read_points else np.zeros((0, 3), np.float32)
    except (SourceError, OSError):
        return np.zeros((0, 3))
    some = np.asarray(points[:: max(1, len(points) // POINTS_SAMPLED)], float)
    return np.asarray(some[np.isfinite(some).all(axis=1)])


def _factor(points: Floats, voxel_m: float) -> float:
    """The factor on the voxel with which a scan has the wanted number of them; 1 where its number suits already.

    NaN of a scan with few points, or in a single place. The voxel is doubled or halved past the wanted number; between
    the last two the factor is interpolated in logarithms.
    """
    if len(points) < FEWEST_VOXELS:
        return float("nan")
    factor, count = 1.0, _occupied(points, voxel_m)
    # A sparse scan, as of few beams, has one point to a voxel even at twice the voxel, where a down-sampled cloud has
    # several: its voxels tell nothing of surfaces until they are larger.
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
    return float("nan")


def _occupied(points: Floats, voxel_m: float) -> int:
    """How many voxels hold a point; they are told apart by a hash, since their indices may be of any size."""
    cells = np.floor((points - points.min(axis=0)) / voxel_m).astype(np.int64)
    return len(np.unique(cells @ np.array([73_856_093, 19_349_663_000_003, 83_492_791_000_000_063])))


def _in_words(factor: float, voxel_m: float) -> str:
    """The detail of the note on a factor that was measured."""
    size = "larger than a room, or sparser" if factor > 1 else "smaller than a room"
    text = (
        f"the scans are {size}: all lengths of the recipe are taken times {factor:g} (clouds.voxel_m is "
        f"{voxel_m * factor:.3g} m); scale=1 leaves them as they are"
    )
    unit = (
        "if their unit is not the metre, set source.reader.units_per_metre (millimetres: 1000, centimetres: 100); else "
    )
    return (unit if factor > NO_METRES else "") + text

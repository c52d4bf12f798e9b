"""The contract of fusers, one named property after the other."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Fuser
from hodge_pipeline.testing.stage import Contract, raises, room
from hodge_pipeline.types import Floats, Floats32, Frame, Model

WALL_M, TOLERANCE_M = 2.0, 0.02
"""Metres to a wall that cameras side by side see, and what its points may be off: the side of a voxel."""
WORLD = se3.exp(np.array([0.3, -0.5, 0.8, 1.0, -2.0, 3.0]))


def _fused(fuser: Fuser, frames: Sequence[Frame], poses: Floats) -> Model:
    """The model, after asserting that it has the form of one and that every frame was counted."""
    before, advanced = poses.copy(), list[int]()
    model = fuser.fuse(frames, poses, advanced.append)
    assert np.array_equal(poses, before, equal_nan=True), "it changes the poses that it is given"
    assert sum(advanced) == len(frames), f"`advance` heard of {sum(advanced)} of {len(frames)} frames"
    assert isinstance(model, Model) and model.name, f"fuse gives a {type(model).__name__} without a name"
    points, normals, colours, triangles = (
        model.points_in_world, model.normals_in_world, model.colours, model.triangles,
    )  # fmt: skip
    assert points.ndim == 2 and points.shape[1] == 3 and np.isfinite(points).all(), "points are finite, (N, 3)"
    assert normals is None or normals.shape == points.shape, "not one normal for each point"
    assert colours is None or (colours.shape == points.shape and colours.dtype == np.uint8), "colours are 8 bit (N, 3)"
    if triangles is not None and len(triangles):
        assert triangles.min() >= 0 and triangles.max() < len(points), "a triangle has a corner that is no point"
    assert all(isinstance(note, str) for note in model.notes), "notes are sentences"
    return model


def _wall() -> tuple[list[Frame], Floats]:
    """Frames side by side before a flat wall, and their poses in a world that is no camera's."""
    camera = room().frames[0].camera
    assert camera is not None
    depth_m = np.full((camera.height, camera.width), WALL_M, np.float32)
    frames = [Frame(row, float(row), camera, read_depth=partial(np.array, depth_m)) for row in range(6)]
    shifts = se3.from_parts(np.tile(np.eye(3), (6, 1, 1)), np.arange(6)[:, None] * np.array([0.05, 0, 0]))
    return frames, WORLD @ shifts


def _lies_on_the_surface(fuser: Fuser) -> None:
    frames, poses = _wall()
    model = _fused(fuser, frames, poses)
    assert len(model.points_in_world) > 100, f"a wall before six cameras gives {len(model.points_in_world)} points"
    off = np.abs(se3.transform(se3.inverse(WORLD), model.points_in_world.astype(float))[:, 2] - WALL_M).max()
    assert off <= TOLERANCE_M, f"points lie up to {off:.2g} m off the wall that all frames see"


def _repeats_itself(fuser: Fuser) -> None:
    scene = room()
    one, two = (_fused(fuser, scene.frames, scene.world_from_cam) for _ in range(2))
    assert pickle.dumps(one) == pickle.dumps(two), "the same frames and poses give another model"


def _shows_colours(fuser: Fuser) -> None:
    scene = room()
    model = _fused(fuser, scene.frames, scene.world_from_cam)
    assert model.colours is not None and np.ptp(model.colours) > 50, "a coloured room gives a model without colours"


def _tells_what_it_leaves_out(fuser: Fuser) -> None:
    frames, poses = _wall()
    unknown = poses.copy()
    unknown[2] = np.nan
    damaged = [replace(frame, read_depth=_unreadable) if row == 2 else frame for row, frame in enumerate(frames)]
    rest = [row for row in range(len(frames)) if row != 2]
    without = _fused(fuser, [frames[row] for row in rest], poses[rest])
    for what, given, at in (("pose", frames, unknown), ("readable image", damaged, poses)):
        model = _fused(fuser, given, at)
        same = np.array_equal(model.points_in_world, without.points_in_world)
        assert same, f"a frame without a {what} is not left out"
        assert len(model.notes) > len(without.notes), f"no note tells of a frame without a {what}"


def _unreadable() -> Floats32:
    raise SourceError("depth/2.png: is damaged: remove it")


def _refuses_frames_without_geometry(fuser: Fuser) -> None:
    frames, poses = _wall()
    blind = [replace(frame, read_depth=None) for frame in frames]
    message = raises(SourceError, lambda: fuser.fuse(blind, poses))
    assert message is not None, "frames without depth and points must raise SourceError"


check_fuser = Contract(
    Fuser,
    {
        "surface": _lies_on_the_surface,
        "the same bits again": _repeats_itself,
        "colours": _shows_colours,
        "frames left out": _tells_what_it_leaves_out,
        "no geometry": _refuses_frames_without_geometry,
    },
)
"""Checks a fuser on views of a wall and of a room."""

"""Colours of a fused mesh where some views alone give theirs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hodge_pipeline.errors import SourceError
from hodge_pipeline.fusion import block_grid, tsdf
from hodge_pipeline.fusion.block_grid import BlockGrid
from hodge_pipeline.fusion.tsdf import TsdfFuser
from test_fusion import CAMERA, WALL_COLOURS, box_frames, colour_of


def test_colours_of_some_views_do_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    frames, poses = box_frames(12)
    whole = TsdfFuser(voxel_m=0.04).fuse(frames, poses)
    read = list[int]()

    def counted(pose: np.ndarray) -> np.ndarray:
        read.append(1)
        return colour_of(pose, CAMERA)

    monkeypatch.setattr(tsdf, "FEWEST_COLOURED", 4)
    frames = [replace(f, read_colour=partial(counted, pose)) for f, pose in zip(frames, poses, strict=True)]
    some = TsdfFuser(voxel_m=0.04).fuse(frames, poses)
    assert len(read) == 4
    np.testing.assert_allclose(some.points_in_world, whole.points_in_world, atol=1e-5)
    assert some.colours is not None and whole.colours is not None
    off = [np.abs(model.colours[:, None].astype(int) - WALL_COLOURS).max(axis=2).min(axis=1) for model in (some, whole)]
    assert (off[0] < 10).mean() > 0.95 and (off[0] < 10).mean() > (off[1] < 10).mean() - 0.01


def test_images_that_cannot_be_read_darken_nothing() -> None:
    frames, poses = box_frames(12)
    frames[::2] = [replace(frame, read_colour=_damaged) for frame in frames[::2]]
    made = TsdfFuser(voxel_m=0.04).fuse(frames, poses)
    assert made.colours is not None
    off = np.abs(made.colours[:, None].astype(int) - WALL_COLOURS).max(axis=2).min(axis=1)
    assert (off < 10).mean() > 0.95


def _damaged() -> np.ndarray:
    raise SourceError("a colour image that is damaged")


def test_what_no_image_has_coloured_has_the_colour_around_it_and_black_stays_black() -> None:
    frames, poses = box_frames(4)
    grid = BlockGrid(0.04, 6.0, 10_000, colour=True)
    image = colour_of(poses[0], CAMERA)
    image[:, : image.shape[1] // 2] = 0
    assert frames[0].read_depth is not None
    depth = frames[0].read_depth()
    grid.integrate(depth, image, CAMERA, poses[0])
    grid.integrate(depth, None, CAMERA, poses[0])
    colours = grid.mesh(0.0).colours.astype(int)
    assert (colours.max(axis=1) == 0).any()
    known = np.vstack([WALL_COLOURS, [[0, 0, 0]]])
    assert np.percentile(np.abs(colours[:, None] - known).max(axis=2).min(axis=1), 80) < 10
    bare = BlockGrid(0.04, 6.0, 10_000, colour=True)
    bare.integrate(depth, None, CAMERA, poses[0])
    assert bare.coloured == 0 and (bare.mesh(0.0).colours == block_grid.GREY).all()

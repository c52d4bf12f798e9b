"""The contract of starts, one named property after the other."""

from __future__ import annotations

import tempfile
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.scene import Scene
from hodge_pipeline.stages import Start
from hodge_pipeline.store.store import Store
from hodge_pipeline.testing.stage import CLOUD_VOXEL_M, Contract, off_by, room
from hodge_pipeline.types import Floats, Source

CLOUDS = CloudOptions(stride=1, voxel_m=CLOUD_VOXEL_M)
NEAR = 0.1, 0.1
"""Radians and metres that first poses may be off at the end of half a metre's way."""
DARK = 5
"""Row of the frame whose depth has no pixel."""


def _begun(start: Start, source: Source, folder: Path) -> Scene:
    """The scene, after asserting that its parts fit each other."""
    store = Store(folder)
    store.remember(source, "the source of the check")
    scene = start.begin(source, CLOUDS, store, InProcess())
    assert isinstance(scene, Scene), f"begin gives a {type(scene).__name__}"
    keys, count = scene.key_frames, len(source.frames)
    names = [frame.frame_id for frame in scene.whole.frames]
    assert names == [frame.frame_id for frame in source.frames], "`whole` has other frames than the source, or an order"
    assert len(keys.rows) and (np.diff(keys.rows) > 0).all(), "the rows of the key frames do not ascend"
    chosen = [source.frames[row].frame_id for row in keys.rows]
    assert [frame.frame_id for frame in scene.source.frames] == chosen, "`source` is not that of the key frames"
    assert len(scene.clouds) == len(chosen), f"{len(scene.clouds)} clouds of {len(chosen)} key frames"
    first = scene.first
    assert first.vertex_ids.tolist() == chosen, "the first round's vertices are not the key frames"
    assert first.world_from_cam.shape == (len(chosen), 4, 4), f"first poses are {first.world_from_cam.shape}"
    assert se3.is_motion(first.world_from_cam, 1e-6).all(), "a first pose is not a rigid motion"
    pairs = first.edges.pairs
    assert not len(pairs) or pairs.max() < len(chosen), "an edge of the first round has no key frame"
    every = keys.expand(first.world_from_cam)
    assert every.shape == (count, 4, 4) and se3.is_motion(every, 1e-6).all(), "not every frame follows the key frames"
    return scene


@lru_cache(maxsize=1)  # for the properties of one start
def _from_nothing(start: Start) -> tuple[Floats, Floats]:
    """The first poses of its key frames in a folder of its own, and those of all frames."""
    with tempfile.TemporaryDirectory() as folder:
        begun = _begun(start, room().source, Path(folder))
        return begun.first.world_from_cam, begun.key_frames.expand(begun.first.world_from_cam)


def _finds_poses(start: Start) -> None:
    _assert_near_truth(_from_nothing(start)[1])  # type: ignore[arg-type]


def _assert_near_truth(poses: Floats, but: int | None = None) -> None:
    """Asserts that poses of all frames `but` one are the true ones, relative to the first."""
    truth = room().world_from_cam
    for row in set(range(1, len(truth))) - {but}:
        angle, distance_m = off_by(se3.inverse(poses[0]) @ poses[row], se3.inverse(truth[0]) @ truth[row])
        off = f"frame {row}: off by {angle:.2g} rad and {distance_m:.2g} m from the first"
        assert angle <= NEAR[0] and distance_m <= NEAR[1], off


@lru_cache(maxsize=1)
def _twice(start: Start) -> tuple[tuple[Floats, dict[str, int]], ...]:
    """The first poses, and the steps that are there then, of two beginnings in another folder."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        return tuple((_begun(start, room().source, folder).first.world_from_cam, _steps(folder)) for _ in range(2))


def _repeats_itself(start: Start) -> None:
    first, _ = _from_nothing(start)  # type: ignore[arg-type]
    again, _ = _twice(start)[0]  # type: ignore[arg-type]
    assert np.array_equal(first, again), "the same source gives other bits when started again"


def _computes_once(start: Start) -> None:
    (first, before), (again, after) = _twice(start)  # type: ignore[arg-type]
    assert before, "it computes no step: a run that is killed begins anew"
    assert after == before, "a step is computed again when the run goes on: its inputs have other keys"
    assert np.array_equal(first, again), "read back, the poses are others"


def _steps(folder: Path) -> dict[str, int]:
    return {str(path): path.stat().st_mtime_ns for path in sorted(folder.glob("*/step.json"))}


def _poses_the_frames_beside_a_dark_one(start: Start) -> None:
    source = room().source
    dark = tuple(replace(frame, read_depth=_dark) if row == DARK else frame for row, frame in enumerate(source.frames))
    with tempfile.TemporaryDirectory() as folder:
        begun = _begun(start, replace(source, frames=dark), Path(folder))
    _assert_near_truth(begun.key_frames.expand(begun.first.world_from_cam), but=DARK)


def _dark() -> Any:
    camera = room().frames[0].camera
    assert camera is not None
    return np.zeros((camera.height, camera.width), np.float32)


def _refuses_a_source_without_points(start: Start) -> None:
    source = room().source
    dark = replace(source, frames=tuple(replace(frame, read_depth=_dark) for frame in source.frames))
    with tempfile.TemporaryDirectory() as folder, suppress(SourceError):
        _begun(start, dark, Path(folder))
        raise AssertionError("a source without a point must raise SourceError")


check_start = Contract(
    Start,
    {
        "first poses": _finds_poses,
        "the same bits again": _repeats_itself,
        "computed once": _computes_once,
        "a frame without points": _poses_the_frames_beside_a_dark_one,
        "no points at all": _refuses_a_source_without_points,
    },
)
"""Checks a start on eight frames of a room, which have poses of their own for a start that takes them."""

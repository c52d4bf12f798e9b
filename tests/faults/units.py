"""The same scene in other units: the poses and pairs of every registrar, builder and start follow its scale."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from small_run import made, recipe

import hodge_pipeline
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import registry, se3
from hodge_pipeline.errors import HodgeError
from hodge_pipeline.run_folder import Run
from hodge_pipeline.types import Floats32, Frame, Source

UNITS = {"millimetres": 1024.0, "kilometres": 1 / 1024}
"""Powers of two: no digit of any length is lost, so that only a constant in metres makes a difference."""
OPTIONS = {
    "edges/combined": "{stage: combined, builders: [overlap, centroid, {stage: drift, reach: 1}]}",
    "start/key_frames": "{stage: key_frames, whole_up_to: 1, distance_m: 0.05, repose: true, registration: rgbd}",
    "start/odometry": "{stage: odometry, registration: vgicp}",
    "start/unordered": "unordered",
}
"""What a stage needs to be told, and the starts that find poses by themselves."""
CLOSE = 1e-3
"""Of the path's length, and radians: searches that stop within a tolerance stop a little elsewhere."""


def cases(full: bool, scratch: Path, seed: int) -> list[str]:
    """Each registrar, each builder and each start in each unit."""
    stages = [f"{kind}/{name}" for kind in ("registration", "edges") for name in registry.names(kind)]
    stages += [stage for stage in OPTIONS if stage not in stages]
    return [f"{unit}/{stage}" for stage in stages for unit in UNITS]


def check(name: str, scratch: Path) -> dict[str, int]:
    """A whole run in metres and in another unit: the same pairs, poses that differ by the unit alone."""
    unit, kind, stage = name.split("/")
    try:
        metres = _run(kind, stage, 1.0, scratch)
    except (HodgeError, ImportError) as error:
        return {f"left out: {str(error)[:60]}": 1}
    other = _run(kind, stage, UNITS[unit], scratch)
    assert metres.edges.pairs.tolist() == other.edges.pairs.tolist(), "other pairs"
    assert metres.edges.status.tolist() == other.edges.status.tolist(), "other edges accepted"
    poses = other.poses.copy()
    poses[:, :3, 3] /= UNITS[unit]
    apart = np.abs(se3.log(se3.inverse(metres.poses) @ poses)).max()
    assert apart < CLOSE, f"poses differ by {apart:.2g}"
    return {"the same poses": 1}


def _run(kind: str, stage: str, factor: float, scratch: Path) -> Run:
    folder = scratch / "units" / f"{kind}-{stage}-{factor:g}"
    shutil.rmtree(folder, ignore_errors=True)
    option = OPTIONS.get(f"{kind}/{stage}", stage)
    more = [f"{kind}={option}", f"scale={factor}", "clouds.landmarks=200"]
    return hodge_pipeline.run(recipe(made(scratch).source, *more), folder, source=_source(made(scratch).source, factor))


def _source(path: Path, factor: float) -> Source:
    opened = TumReader().open(path)
    return replace(opened, frames=[_scaled(frame, factor) for frame in opened.frames], trajectory=None)


def _scaled(frame: Frame, factor: float) -> Frame:
    return replace(frame, read_depth=partial(_depth, frame, factor), encoded_depth=None, world_from_cam=None)


def _depth(frame: Frame, factor: float) -> Floats32:
    assert frame.read_depth
    return np.asarray(frame.read_depth() * np.float32(factor))

"""The focal length that frames tell by what they saw of their key frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from hodge_pipeline.registration.tracking.focal import estimate_focal
from hodge_pipeline.registration.tracking.sightings import Sightings
from hodge_pipeline.store import artifacts
from test_flow import CAMERA, frames_of, shaken_views


@pytest.mark.parametrize("wrong", [0.8, 1.0, 1.25])
def test_a_wrong_focal_length_is_told_with_the_right_one(tmp_path: Path, wrong: float) -> None:
    poses, twists = shaken_views(tmp_path, 0.0)
    found = artifacts.load(tmp_path / "0.npz", Sightings)
    artifacts.save(tmp_path / "0.npz", replace(found, points=found.points / [wrong, wrong, 1.0]))
    camera = replace(CAMERA, fx=wrong * CAMERA.fx, fy=wrong * CAMERA.fy)
    focal = estimate_focal(tmp_path, frames_of(camera), poses, twists, 0.0, 1.0)
    assert focal is not None and focal.own == camera.fx
    assert focal.best == pytest.approx(CAMERA.fx, rel=0.02)
    assert focal.low < focal.best < focal.high
    assert focal.is_other == (wrong != 1.0)


@pytest.mark.parametrize("speed", [0.0, 0.01, 0.1])
def test_a_camera_that_hardly_moves_tells_no_other_focal_length(tmp_path: Path, speed: float) -> None:
    poses, twists = shaken_views(tmp_path, 0.0, speed)
    focal = estimate_focal(tmp_path, frames_of(CAMERA), poses, twists, 0.0, 1.0)
    assert focal is not None and not focal.is_other
    assert focal.high / focal.low > 1.05


def test_a_read_out_that_is_known_does_not_bend_the_estimate(tmp_path: Path) -> None:
    poses, twists = shaken_views(tmp_path, 0.0225)
    known, ignored = (
        estimate_focal(tmp_path, frames_of(CAMERA), poses, twists, readout_s, 1.0) for readout_s in (0.0225, 0.0)
    )
    assert known is not None and known.best == pytest.approx(CAMERA.fx, rel=0.005)
    assert ignored is not None and ignored.low > 1.005 * CAMERA.fx


def test_no_focal_length_is_told_by_few_key_frames_or_without_a_camera(tmp_path: Path) -> None:
    poses, twists = shaken_views(tmp_path, 0.0)
    assert estimate_focal(tmp_path, frames_of(None), poses, twists, 0.0, 1.0) is None
    found = artifacts.load(tmp_path / "0.npz", Sightings)
    first = found.key[found.corner] < 16  # four key frames
    artifacts.save(
        tmp_path / "0.npz", replace(found, frame=found.frame[first], corner=found.corner[first], seen=found.seen[first])
    )
    assert estimate_focal(tmp_path, frames_of(CAMERA), poses, twists, 0.0, 1.0) is None

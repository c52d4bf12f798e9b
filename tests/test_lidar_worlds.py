"""Odometry of sweeps in simulated worlds: forest, hill, tunnel, corridors by narrow fields."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.demo.sweeps import REVOLUTION_S, Sweep
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.sweep_map import _noise_of_normals, _variances
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start.sweeps import Sweeps, follow
from hodge_pipeline.types import Floats, Frame, Source
from hodge_pipeline.types.notes import Note
from lidar_worlds import scanner_in
from test_lidar import cloud_of

FOLLOWED = [("forest", 0, 20, ""), ("hill", 0, 20, ""), ("tunnel", 0, 60, "path loose")]
"""Worlds, and the kind of note that a part of the path gets where little tells it (more: benchmarks/lidar.py)."""


@pytest.mark.parametrize(("name", "seed", "count", "kind"), FOLLOWED)
def test_other_worlds_are_followed(name: str, seed: int, count: int, kind: str, tmp_path: Path) -> None:
    found, exact, notes = follow_in(name, seed, count, tmp_path)
    path_m = np.linalg.norm(np.diff(exact[:, :3, 3], axis=0), axis=1).sum()
    assert absolute_error(found.world_from_scan, exact).rmse_m < 0.02 * path_m
    assert [note.kind for note in notes if note.kind.endswith("loose")] == [kind] * bool(kind)


def follow_in(
    name: str, seed: int, count: int, folder: Path, field_deg: int = 360, first: int = 0
) -> tuple[Sweeps, Floats, list[Note]]:
    """What is found of so many sweeps from one on, their true poses, and the notes."""
    own, notes = scanner_in(name, seed), list[Note]()
    seen = [ahead(own.sweep(first + row), field_deg) for row in range(count)]
    frames = tuple(Frame(row, row * REVOLUTION_S, read_points=partial(cloud_of, seen[row])) for row in range(count))
    step = Step(folder, no_progress, lambda *told: notes.extend(told))
    every, clouds = np.arange(count), CloudOptions(max_range_m=80.0)
    found = follow(Source(name, folder, frames), (every,), clouds, None, step=step)
    return found, own.road.world_from_car((first + every) * REVOLUTION_S), notes


def ahead(sweep: Sweep, field_deg: int) -> Sweep:
    """The points of a sweep that a scanner with this field sees."""
    x, y, _ = sweep.points.T
    is_seen = np.abs(np.degrees(np.arctan2(y, x))) <= field_deg / 2
    return Sweep(sweep.points[is_seen], sweep.times_s[is_seen])


@pytest.mark.parametrize(("field_deg", "most_m"), [(360, 0.05), (120, 0.2)])
def test_a_walk_along_a_corridor_is_followed(field_deg: int, most_m: float, tmp_path: Path) -> None:
    """0.79 m where noise of normals is as large along the walls as up them, 0.70 m by the narrow field where following
    begins, as each pass for the first velocity, with nothing known of it."""
    found, exact, _ = follow_in("office", 3, 30, tmp_path, field_deg)
    assert absolute_error(found.world_from_scan, exact).rmse_m < most_m


def test_noise_of_normals_is_least_along_the_long_side_of_their_points() -> None:
    """Ten points, variances 4 and 1 in the plane, 0.01 across it: 0.01 / 4 / 10 and 0.01 / 1 / 10."""
    turn = se3.so3_exp(np.array([0.3, -0.5, 0.9]))
    scatter = (turn * [4, 1, 0.01] @ turn.T)[None]
    noise = _noise_of_normals(scatter, *_variances(scatter))
    np.testing.assert_allclose(turn.T @ noise @ turn, np.diag([0.00025, 0.001, 0]), atol=1e-9)
    ball = np.eye(3)[None]
    assert np.isfinite(_noise_of_normals(ball, *_variances(ball))).all()


def test_a_path_that_little_tells_is_said(tmp_path: Path) -> None:
    _, _, notes = follow_in("bare", 0, 30, tmp_path)
    assert [note.kind for note in notes if note.kind.endswith("loose")] == ["path loose"]


def test_a_path_that_slides_is_said_where_alignments_seem_to_hold(tmp_path: Path) -> None:
    """By their information 14 of 50 sweeps tell little of how far the scanner went, fewer than half; 32 slide."""
    found, exact, notes = follow_in("office", 102, 50, tmp_path, 120, first=360)
    found_m, exact_m = (
        np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() for poses in (found.world_from_scan, exact)
    )
    assert abs(found_m - exact_m) > 0.04 * exact_m
    assert [note.kind for note in notes if note.kind.endswith("loose")] == ["path loose"]

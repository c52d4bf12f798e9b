"""The sweeps of a spinning LiDAR on a car in the street: points with their times, one file a revolution."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.demo.street import CAR, Road, build_street
from hodge_pipeline.lean_open3d import o3d
from hodge_pipeline.stages import Advance
from hodge_pipeline.types import Floats, Floats32, Ints

REVOLUTION_S = 0.1
LOWEST_DEG, HIGHEST_DEG = -24.0, 6.0
"""Elevation of the lowest and the highest beam."""
NEAREST_M, FARTHEST_M = 2.0, 80.0
"""Range of the scanner."""
RANGE_NOISE_M, LOST_SHARE = 0.02, 0.03
"""Standard deviation of a range, and the share of points that is lost."""
TRUTH_FILE = "truth.tum"
MOVING_CARS, ONCOMING_M_S, LANE_M = 5, 7.0, 3.0
"""Oncoming cars, their speed, and the distance of their lane."""


@plain_dataclass(frozen=True)
class Sweep:
    """One revolution: `points (N, 3)` in the scanner's axes at their own times, `times_s (N,)` after it began."""

    points: Floats32
    times_s: Floats32


class SpinningScanner:
    """A scanner of `beams` and `columns` on a car that drives the road, in the street or another `mesh`.

    The mesh is vertices (V, 3) and triangles (T, 3); `noise` multiplies every error.
    """

    nearest_m = NEAREST_M

    def __init__(
        self, road: Road, seed: int, beams: int, columns: int, noise: float, mesh: tuple[Floats, Ints] | None = None
    ) -> None:
        self.road, self.seed, self.noise = road, seed, noise
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        vertices, triangles = build_street(seed) if mesh is None else mesh
        self._scene.add_triangles(
            o3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(triangles.astype(np.uint32)),
        )
        up = np.radians(np.linspace(LOWEST_DEG, HIGHEST_DEG, beams))
        azimuth = -2 * np.pi * np.arange(columns) / columns
        self._directions = np.stack(
            [
                np.cos(up) * np.cos(azimuth)[:, None],
                np.cos(up) * np.sin(azimuth)[:, None],
                np.broadcast_to(np.sin(up), (columns, beams)),
            ],
            axis=2,
        )
        self._column_s = REVOLUTION_S * np.arange(columns) / columns

    def sweep(self, number: int) -> Sweep:
        """The revolution that begins `number` revolutions after the first."""
        rng = np.random.default_rng([self.seed, 8, number])
        begin_s = number * REVOLUTION_S
        poses = self.road.world_from_car(begin_s + self._column_s)
        towards = np.einsum("cij,cbj->cbi", poses[:, :3, :3], self._directions)
        rays = np.concatenate([np.broadcast_to(poses[:, None, :3, 3], towards.shape), towards], axis=2)
        hit = self._scene.cast_rays(o3d.core.Tensor.from_numpy(rays.astype(np.float32)), nthreads=1)
        ranges = np.minimum(hit["t_hit"].numpy().astype(float), self._to_cars(rays, begin_s))
        ranges += self.noise * RANGE_NOISE_M * rng.standard_normal(ranges.shape)
        seen = (ranges > self.nearest_m) & (ranges < FARTHEST_M) & (rng.random(ranges.shape) >= LOST_SHARE * self.noise)
        points = self._directions * np.where(seen, ranges, 0.0)[:, :, None]
        times = np.broadcast_to(self._column_s[:, None], seen.shape)
        return Sweep(points[seen].astype(np.float32), times[seen].astype(np.float32))

    def _to_cars(self, rays: Floats, time_s: float) -> Floats:
        """The range (columns, beams) at which each ray hits a moving car, infinite where it hits none."""
        nearest = np.full(rays.shape[:2], np.inf)
        for number in range(MOVING_CARS):
            way = 37.0 + self.road.length_m * number / MOVING_CARS - ONCOMING_M_S * time_s
            x, y, heading = map(float, self.road.place(np.array(way)))
            lane = se3.from_parts(se3.so3_exp(np.array([0, 0, heading])), np.array([x, y, 0.2]))
            car_from_world = se3.inverse(lane @ se3.from_parts(np.eye(3), np.array([0.0, LANE_M, 0.0])))
            origins, turned = se3.transform(car_from_world, rays[..., :3]), rays[..., 3:] @ car_from_world[:3, :3].T
            nearest = np.minimum(nearest, _to_box(origins, turned, np.array(CAR)))
        return nearest


def _to_box(origins: Floats, directions: Floats, size: Floats) -> Floats:
    """The range (…) at which rays (…, 3) hit a box of this size that stands on the origin, by the slab test."""
    low, high = np.array([-size[0] / 2, -size[1] / 2, 0.0]), np.array([size[0] / 2, size[1] / 2, size[2]])
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origins) / directions, (high - origins) / directions
    enter, leave = np.fmin(a, b).max(axis=-1), np.fmax(a, b).min(axis=-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class StreetOptions:
    """What is scanned: 500 m round at 7 m/s, ten revolutions a second, and 46 m more."""

    frames: int = Field(default=780, ge=2, description="revolutions, 0.7 m apart")
    beams: int = Field(default=16, ge=4, le=128, description="of the scanner, over 30 degrees")
    columns: int = Field(default=720, ge=36, description="directions a beam is fired in during a revolution")
    seed: int = Field(default=0, ge=0, description="of the houses and of the noise")
    noise: float = Field(default=1.0, ge=0, description="scale of every error of the scanner; 0 gives exact points")
    speed_m_s: float = Field(default=7.0, gt=0, description="of the car")

    def write(self, draft: Path, advance: Advance) -> None:
        """One PCD a revolution (x, y, z, t: seconds after its first point) and `truth.tum`, poses by its number."""
        road = Road(self.speed_m_s)
        scanner = SpinningScanner(road, self.seed, self.beams, self.columns, self.noise)
        poses = road.world_from_car(np.asarray(np.arange(self.frames) * REVOLUTION_S, float))
        rows = np.concatenate([poses[:, :3, 3], se3.to_quat_xyzw(poses)], axis=1)
        lines = [f"{number} " + " ".join(f"{value:.7f}" for value in row) for number, row in enumerate(rows)]
        (draft / TRUTH_FILE).write_text("\n".join(["# number tx ty tz qx qy qz qw", *lines]) + "\n")
        for number in range(self.frames):
            _write_pcd(draft / f"{number:06d}.pcd", scanner.sweep(number))
            advance(1)


def _write_pcd(path: Path, sweep: Sweep) -> None:
    columns = np.concatenate([sweep.points, sweep.times_s[:, None]], axis=1).astype("<f4")
    header = (
        "VERSION 0.7\nFIELDS x y z t\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        f"WIDTH {len(columns)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(columns)}\nDATA binary\n"
    )
    path.write_bytes(header.encode() + columns.tobytes())

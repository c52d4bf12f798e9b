"""Worlds for a spinning scanner beside the demo's street: forest, hill, office floor, fields, tunnel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from hodge_pipeline import se3
from hodge_pipeline.demo.parts import motion
from hodge_pipeline.demo.shapes import Mesh, ball, box, cylinder
from hodge_pipeline.demo.street import Road, joined
from hodge_pipeline.demo.sweeps import SpinningScanner
from hodge_pipeline.types import Floats

TURN_RAD_S = np.pi / 2
OFFICE_STARTS_M = (28.0, 10.0, 20.0)
"""In the middle of a long corridor, before a corner, after one."""


@dataclass(frozen=True)
class Ground:
    """Heights of the ground: hills of `hill_m` and roughness of `rough_m`, sums of waves."""

    hill_m: float
    rough_m: float
    seed: int

    def __call__(self, x: Floats, y: Floats) -> Floats:
        """Heights, metres."""
        rng = np.random.default_rng([self.seed, 3])
        height = self.hill_m * np.exp(-(np.square(x - 12) + np.square(y + 6)) / (2 * 35.0**2))
        for length_m in (1.7, 2.9, 5.3, 9.1, 17.0):
            turn, phase = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
            wave = 2 * np.pi / length_m * (np.cos(turn) * x + np.sin(turn) * y) + phase
            height = height + self.rough_m * min(length_m / 5, 1) * np.sin(wave)
        return np.asarray(height)

    def mesh(self, half_m: float, cell_m: float) -> Mesh:
        """A square of it."""
        line = np.arange(-half_m, half_m + cell_m, cell_m)
        x, y = np.meshgrid(line, line, indexing="ij")
        vertices = np.stack([x, y, self(x, y)], axis=2).reshape(-1, 3)
        corner = (np.arange(len(line) - 1)[:, None] * len(line) + np.arange(len(line) - 1)).ravel()
        a = np.stack([corner, corner + len(line), corner + 1], axis=1)
        b = np.stack([corner + 1, corner + len(line), corner + len(line) + 1], axis=1)
        return Mesh(vertices, np.tile([0, 0, 1.0], (len(vertices), 1)), np.concatenate([a, b]).astype(np.int64))


class CarFree:
    """A way on which no cars drive."""

    def place(self, way_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Where the next car is: far away."""
        far = np.full(np.shape(way_m), 1e6)
        return far, far, 0 * far


@dataclass(frozen=True)
class Stop(CarFree):
    """A scanner that stands on the demo's street, where a car of 7 m/s is after a time."""

    after_s: float
    speed_m_s: float = 7.0
    length_m: float = 1e9

    def world_from_car(self, times_s: Floats) -> Floats:
        """Poses (N, 4, 4), all the same."""
        return Road(self.speed_m_s).world_from_car(np.full(len(times_s), self.after_s))


class Walk(CarFree):
    """A closed way through `corners (K, 2)` over the ground, the scanner `height_m` above it, pitched as the slope."""

    def __init__(self, corners: Floats, ground: Ground, speed_m_s: float, height_m: float, seed: int) -> None:
        closed = np.concatenate([corners, corners[:1]])
        chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
        spline = CubicSpline(chord, closed, bc_type="periodic")
        fine = np.linspace(0, chord[-1], 4000)
        xy = spline(fine)
        z = ground(xy[:, 0], xy[:, 1])
        way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(np.column_stack([xy, z]), axis=0), axis=1))])
        z = _smooth(z, way, 2.0) + height_m
        self.length_m, self.speed_m_s = float(way[-1]), speed_m_s
        self._path = CubicSpline(way, np.column_stack([xy, z]))
        self._phase = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi, 4)

    def world_from_car(self, times_s: Floats) -> Floats:
        """Poses (N, 4, 4): x ahead, y left, z up from the slope."""
        times_s = np.asarray(times_s, float)
        waves = np.sin(2 * np.pi * times_s[:, None] * np.array([0.9, 1.3, 0.7, 1.1]) + self._phase)
        twist = np.zeros((len(times_s), 6))
        twist[:, :2] = np.radians(1.0) * waves[:, :2]
        twist[:, 4:] = 0.02 * waves[:, 2:]
        return np.asarray(self._level(times_s) @ se3.exp(twist))

    def _level(self, times_s: Floats) -> Floats:
        way = np.mod(times_s * self.speed_m_s, self.length_m)
        ahead = self._path(way, 1)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        left = np.cross([0, 0, 1.0], ahead)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        turned = np.stack([ahead, left, np.cross(ahead, left)], axis=2)
        return se3.from_parts(turned, self._path(way))


class Rounds(Walk):
    """A closed way along straight lines on flat ground from `start_m` on; at its `corners (K, 2)` it turns in place."""

    def __init__(self, corners: Floats, speed_m_s: float, height_m: float, start_m: float, seed: int) -> None:
        legs = np.roll(corners, -1, axis=0) - corners
        heading = np.unwrap(np.arctan2(*legs.T[::-1]))
        heading = np.append(heading, heading[0] + 2 * np.pi)
        turns_s = np.abs(np.diff(heading)) / TURN_RAD_S
        self._times_s = np.append(0, np.cumsum(np.stack([np.linalg.norm(legs, axis=1) / speed_m_s, turns_s], axis=1)))
        xy = np.append(np.repeat(np.roll(corners, -1, axis=0), 2, axis=0), corners[:1], axis=0)
        xy = np.concatenate([corners[:1], xy[:-1]])
        yaw = np.append(np.repeat(heading[:-1], 2), heading[-1])
        self._stops = np.column_stack([xy, np.full(len(xy), height_m), yaw])
        self.length_m, self.speed_m_s, self._start_s = 1e9, speed_m_s, start_m / speed_m_s
        self._phase = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi, 4)

    def _level(self, times_s: Floats) -> Floats:
        now = np.mod(times_s + self._start_s, self._times_s[-1])
        x, y, z, yaw = (np.interp(now, self._times_s, column) for column in self._stops.T)
        return se3.from_parts(se3.so3_exp(np.stack([0 * yaw, 0 * yaw, yaw], axis=1)), np.stack([x, y, z], axis=1))


def _smooth(z: Floats, way: Floats, sigma_m: float) -> Floats:
    return np.asarray(gaussian_filter1d(z, sigma_m / (way[-1] / len(way)), mode="wrap"))


def _ring(radius_x: float, radius_y: float, wave: float, rng: np.random.Generator) -> Floats:
    """Corners (16, 2) of a way round."""
    angle = np.arange(16) / 16 * 2 * np.pi
    scale = 1 + wave * rng.uniform(-1, 1, 16)
    return np.column_stack([radius_x * np.cos(angle) * scale, radius_y * np.sin(angle) * scale])


def _away(walk: Walk) -> Floats:
    return walk.world_from_car(np.linspace(0, walk.length_m / walk.speed_m_s, 600))[:, :2, 3]


def _scattered(
    rng: np.random.Generator, ground: Ground, count: int, half_m: float, way: Floats, apart_m: float, depth_m: float
) -> Iterator[tuple[float, float, float]]:
    """Spots at random, but for those near the way, `depth_m` in the ground."""
    for at in rng.uniform(-half_m, half_m, (count, 2)):
        if np.linalg.norm(way - at, axis=1).min() > apart_m:
            yield at[0], at[1], float(ground(*at)) - depth_m


def forest(seed: int) -> tuple[Walk, list[Mesh]]:
    """Trunks and bushes on rough ground, a walk of some 130 m at 3 m/s."""
    rng, ground = np.random.default_rng([seed, 11]), Ground(4.0, 0.12, seed)
    walk = Walk(_ring(24, 16, 0.15, rng), ground, 3.0, 1.4, seed)
    way, meshes = _away(walk), [ground.mesh(70, 0.7)]
    for x, y, z in _scattered(rng, ground, 1100, 65, way, 1.0, 0.3):
        meshes.append(cylinder(rng.uniform(0.08, 0.35), rng.uniform(6, 14), 8).moved(motion(x, y, z)))
    for x, y, z in _scattered(rng, ground, 300, 65, way, 2.2, 0.3):
        meshes.append(ball(rng.uniform(0.4, 1.3), 8).moved(motion(x, y, z)))
    return walk, meshes


def hill(seed: int) -> tuple[Walk, list[Mesh]]:
    """A hill of 18 m with few trees and houses; 250 m at 6 m/s over its flank and round."""
    rng, ground = np.random.default_rng([seed, 12]), Ground(18.0, 0.04, seed)
    walk = Walk(_ring(45, 30, 0.12, rng), ground, 6.0, 1.9, seed)
    way, meshes = _away(walk), [ground.mesh(120, 1.0)]
    for x, y, z in _scattered(rng, ground, 90, 100, way, 3.0, 0.5):
        meshes.append(cylinder(rng.uniform(0.15, 0.3), 4, 8).moved(motion(x, y, z)))
        meshes.append(ball(rng.uniform(1, 1.8), 10).moved(motion(x, y, z + 3)))
    for x, y, z in _scattered(rng, ground, 14, 90, way, 9.0, 2):
        meshes.append(box(*rng.uniform(5, 11, 2), 8).moved(motion(x, y, z, rng.uniform(0, 90))))
    return walk, meshes


def office(seed: int) -> tuple[Walk, list[Mesh]]:
    """Corridors of 2 m round a block of 30 x 14 m, door frames, the outer wall half of glass (no return)."""
    rng = np.random.default_rng([seed, 13])
    x, y = 16.0, 8.0
    corners = np.array([(x, -y), (x, y), (-x, y), (-x, -y)])
    walk = Rounds(corners, 1.4, 0.6, OFFICE_STARTS_M[seed % len(OFFICE_STARTS_M)], seed)
    meshes = [box(60, 60, 0.2).moved(motion(0, 0, -0.2)), box(60, 60, 0.2).moved(motion(0, 0, 2.7))]
    meshes.append(box(2 * x - 2, 2 * y - 2, 2.7))  # the block
    for half, away, turn in ((x, y, 0), (y, x, 90), (x, y, 180), (y, x, 270)):
        for at in np.arange(-half + 1, half - 0.4, 1.0):
            spot = motion(0, 0, yaw_deg=turn)
            if rng.random() < 0.2:  # a frame that stands out of the inner wall
                meshes.append(box(0.2, 0.12 * 2, 2.2).moved(spot @ motion(at, -away + 1.0)))
            if rng.random() < 0.5:
                meshes.append(box(1.0, 0.1, 2.7).moved(spot @ motion(at, -away - 1.0)))
            else:
                meshes.append(box(1.0, 0.1, 0.3).moved(spot @ motion(at, -away - 1.0)))
                meshes.append(box(0.08, 0.12, 2.7).moved(spot @ motion(at + 0.5, -away - 1.0)))
    return walk, meshes


def field(seed: int) -> tuple[Walk, list[Mesh]]:
    """Flat rough ground and one house; 220 m round it at 8 m/s."""
    rng, ground = np.random.default_rng([seed, 14]), Ground(0.0, 0.03, seed)
    walk = Walk(_ring(38, 30, 0.1, rng), ground, 8.0, 1.9, seed)
    house = [box(14, 9, 6), box(3, 11, 3), box(5, 5, 9).moved(motion(3, -2, 0)), box(1, 1, 8).moved(motion(-5, 3, 0))]
    return walk, [ground.mesh(200, 1.3), *[part.moved(motion(1, 2, -0.5, 20)) for part in house]]


def bare(seed: int) -> tuple[Walk, list[Mesh]]:
    """That field without its house."""
    walk, meshes = field(seed)
    return walk, meshes[:1]


def tunnel(seed: int) -> tuple[Walk, list[Mesh]]:
    """From among houses at 15 m/s into a straight tunnel of 220 m that is bare but for a niche every 50 m."""
    rng = np.random.default_rng([seed, 15])
    corners = np.array([(-140.0, 0), (140, 0), (140, 60), (-140, 60)])
    meshes = [box(1000, 1000, 0.2).moved(motion(0, 0, -0.2)), box(220, 11, 0.3).moved(motion(0, 0, 5))]
    for side in (-1, 1):
        meshes.append(box(220, 0.5, 5).moved(motion(0, side * 5.25)))
        for _ in range(14):
            at = side * (115 + rng.uniform(5, 70)), rng.choice([-1, 1]) * rng.uniform(9, 25)
            meshes.append(box(*rng.uniform(3, 9, 2), rng.uniform(3, 9)).moved(motion(*at)))
    for x in np.arange(-90, 110, 50.0):
        meshes.append(box(2, 1, 2.2).moved(motion(x + rng.uniform(-8, 8), rng.choice([-4.9, 4.9]))))
    return Rounds(corners, 15.0, 1.9, 0.0, seed), meshes


WORLDS: dict[str, Callable[[int], tuple[Walk, list[Mesh]]]] = {
    "forest": forest,
    "hill": hill,
    "office": office,
    "field": field,
    "bare": bare,
    "tunnel": tunnel,
}


def scanner_in(name: str, seed: int, beams: int = 16, columns: int = 360) -> SpinningScanner:
    """A scanner on its way through one of the worlds; its `road` knows the poses."""
    walk, meshes = WORLDS[name](seed)
    scanner = SpinningScanner(cast(Road, walk), seed, beams, columns, 1.0, joined(meshes))
    scanner.nearest_m = 0.4 if name == "office" else scanner.nearest_m
    return scanner

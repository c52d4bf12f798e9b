"""Paths of a hand-held camera: round the middle of a room, and through a building and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from hodge_pipeline import se3
from hodge_pipeline.demo.room import room_origin
from hodge_pipeline.types import Floats

TREMOR_HZ = (0.6, 3.0)
"""Frequencies of the hand's shaking."""
TREMOR_TERMS = 6
"""Sines that each of its six components adds up."""
LAST_ROOM = 7
"""Waypoints in the last room of a walk; in the other rooms there are four on the way there and four back."""


@dataclass(frozen=True)
class HandHeldLoop:
    """A smooth closed path with tremor; camera axes are x right, y down, z forward, the world's z is up.

    - `duration_s` for `turns` rounds: after one round the camera is back where it started but for the tremor. Less than
      one round is gone there and back.
    - `radius_m` of the round, `height_m` of the camera over the floor.
    - `tremor_m`, `tremor_deg`: standard deviation of the hand's shaking along and about each axis.
    """

    seed: int
    duration_s: float
    turns: float
    radius_m: float = 1.0
    height_m: float = 1.45
    tremor_m: float = 0.006
    tremor_deg: float = 0.5

    def world_from_cam(self, times_s: Floats) -> Floats:
        """Poses (N, 4, 4) at the times (N,), from 0 to `duration_s`."""
        times_s = np.asarray(times_s, float)
        share = times_s / self.duration_s
        done = share if self.turns >= 1 else (1 - np.cos(2 * np.pi * share)) / 2
        steady = self._steady(2 * np.pi * self.turns * done)
        return np.asarray(steady @ se3.exp(_tremor(self.seed, times_s, self.tremor_m, self.tremor_deg)))

    def _steady(self, angle: Floats) -> Floats:
        """Poses (N, 4, 4) without tremor: the camera looks across the middle, so that it sees the room's width."""
        radius = self.radius_m * (1 + 0.12 * np.cos(2 * angle))
        height = self.height_m + 0.1 * np.sin(2 * angle + 0.7)
        position = np.stack([-radius * np.cos(angle), -radius * np.sin(angle), height], axis=-1)
        yaw = angle + 0.15 * np.sin(2 * angle)
        pitch = np.radians(-14 + 6 * np.sin(3 * angle))
        return _looking(position, yaw, pitch)


@dataclass(frozen=True)
class Walk:
    """A walk through the rooms of a building to the last one and back to where it began.

    The camera looks ahead, and in each room once all round, both ways: on the way back it sees what it has seen before.
    """

    seed: int
    rooms: int
    speed_m_s: float = 0.8

    @property
    def duration_s(self) -> float:
        """Seconds that the walk takes."""
        return float(self._way.x[-1]) / self.speed_m_s

    @cached_property
    def _way(self) -> CubicSpline:
        """The place (2,) on the floor by the way walked, metres."""
        places = np.array(_waypoints(self.rooms))
        lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
        return CubicSpline(np.concatenate([[0.0], np.cumsum(lengths)]), places)

    def world_from_cam(self, times_s: Floats) -> Floats:
        """Poses (N, 4, 4) at the times (N,); before and after the walk the camera stands still."""
        times_s = np.asarray(times_s, float)
        way = np.clip(times_s, 0, self.duration_s) * self.speed_m_s
        place, height = self._way(way), 1.45 + 0.08 * np.sin(way / 1.7)
        yaw = self._heading(way) + 0.35 * np.sin(way / 0.9)
        pitch = np.radians(-12 + 8 * np.sin(way / 1.3))
        steady = _looking(np.column_stack([place, height]), yaw, pitch)
        return np.asarray(steady @ se3.exp(_tremor(self.seed, times_s, 0.004, 0.3)))

    def _heading(self, way: Floats) -> Floats:
        """The camera's heading (N,), radians, after a way (N,): ahead, and once all round in each room."""
        return np.asarray(np.interp(way, *self._headings))

    @cached_property
    def _headings(self) -> tuple[Floats, Floats]:
        """The way (W,) and the heading there (W,), smoothed over about a metre so that nobody turns on the spot."""
        grid = np.linspace(0, float(self._way.x[-1]), max(2, int(20 * self._way.x[-1])))
        ahead = self._way(grid, 1)
        angle = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])) + np.interp(grid, self._way.x, self._rounds)
        return grid, gaussian_filter1d(angle, 10, mode="nearest")

    @property
    def _rounds(self) -> Floats:
        """How far (W,) the camera has turned at each waypoint beyond the turns of the way, radians."""
        passed = 4 * (self.rooms - 1)
        turned = np.zeros(2 * passed + LAST_ROOM)
        for first in (*range(1, passed, 4), *range(passed + LAST_ROOM, 2 * passed + LAST_ROOM, 4)):
            turned[first + 1] += np.pi
            turned[first + 2] += np.pi
        return np.cumsum(turned)


def _waypoints(rooms: int) -> list[Floats]:
    """Places (2,) on the floor: through each room on its west side, round the last, and back on the east side."""
    west = [(-0.2, -1.9), (-1.2, -0.7), (-0.9, 0.8), (0.5, 1.7)]
    east = [(1.1, 1.7), (1.7, 0.6), (1.0, -1.0), (0.0, -1.9)]
    turn = [(-0.2, -1.9), (-1.2, -0.7), (-0.8, 0.8), (0.3, 1.2), (1.3, 0.5), (1.0, -1.0), (0.0, -1.9)]
    last = rooms - 1
    there = [room_origin(number)[:2] + place for number in range(last) for place in west]
    back = [room_origin(number)[:2] + place for number in reversed(range(last)) for place in east]
    return [*there, *(room_origin(last)[:2] + place for place in turn), *back]


def _looking(position: Floats, yaw: Floats, pitch: Floats) -> Floats:
    """Poses (N, 4, 4) at positions (N, 3) of a camera without roll that looks along yaw and pitch (N,), radians."""
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    return se3.from_parts(np.stack([right, np.cross(forward, right), forward], axis=-1), position)


def _tremor(seed: int, times_s: Floats, tremor_m: float, tremor_deg: float) -> Floats:
    """Twists (N, 6) of the hand: sums of slow sines, so that 100 Hz samples interpolate to well below 1 mm."""
    rng = np.random.default_rng([seed, 1])
    hertz = rng.uniform(*TREMOR_HZ, (TREMOR_TERMS, 6))
    phase = rng.uniform(0, 2 * np.pi, (TREMOR_TERMS, 6))
    waves = np.sin(2 * np.pi * hertz * times_s[:, None, None] + phase).sum(axis=1) * np.sqrt(2 / TREMOR_TERMS)
    return np.asarray(waves * np.array([np.radians(tremor_deg)] * 3 + [tremor_m] * 3))

"""The path of a camera carried by hand round the middle of the room, looking across it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats

TREMOR_HZ = (0.6, 3.0)
TREMOR_TERMS = 6


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
        return np.asarray(steady @ se3.exp(self._tremor(times_s)))

    def _steady(self, angle: Floats) -> Floats:
        """The path without tremor: the camera opposite to where it looks, so that it sees the room's width."""
        radius = self.radius_m * (1 + 0.12 * np.cos(2 * angle))
        height = self.height_m + 0.1 * np.sin(2 * angle + 0.7)
        position = np.stack([-radius * np.cos(angle), -radius * np.sin(angle), height], axis=-1)
        yaw = angle + 0.15 * np.sin(2 * angle)
        pitch = np.radians(-14 + 6 * np.sin(3 * angle))
        forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1)
        right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=-1)
        return se3.from_parts(np.stack([right, np.cross(forward, right), forward], axis=-1), position)

    def _tremor(self, times_s: Floats) -> Floats:
        """Twists (N, 6) of the hand: a sum of slow sines, so that 100 Hz samples interpolate to well below 1 mm."""
        rng = np.random.default_rng([self.seed, 1])
        hertz = rng.uniform(*TREMOR_HZ, (TREMOR_TERMS, 6))
        phase = rng.uniform(0, 2 * np.pi, (TREMOR_TERMS, 6))
        waves = np.sin(2 * np.pi * hertz * times_s[:, None, None] + phase).sum(axis=1) * np.sqrt(2 / TREMOR_TERMS)
        return np.asarray(waves * np.array([np.radians(self.tremor_deg)] * 3 + [self.tremor_m] * 3))

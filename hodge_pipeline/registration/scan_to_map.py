"""Scan-to-map tracking of the sweeps of one LiDAR, filtered with a constant-velocity model."""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import NamedTuple

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.sweep_map import (
    AS_USUAL,
    LEVELS,
    LOOK_M,
    SAMPLE_M,
    USUAL_OF,
    Latest,
    SweepMap,
    usual_share,
)
from hodge_pipeline.registration.sweeps import deskewed
from hodge_pipeline.types import Floats, PointCloud

LOOSE = 0.002
"""Share of the information on translation that its weakest direction has, below which little tells how far the scanner
went: 0 in a bare tunnel, 0.0013 on a bare field at 16 beams, 0.01 to 0.1 in offices, forests and streets.
"""
WEAKEST = 0.05
"""Share of the information on translation that its weakest direction has, below which the alignment is tried from a
voxel to either side along it. Where it ends at two places the sweep slides, though its information may seem to hold: of
20 sweeps in a row, in offices and tunnels, the path is 5 % too long or short in 1 of 25 where fewer than a fifth slide,
in 2 of 3 where four fifths do.
"""
STRANGE = 0.5
"""A sweep is strange that has half of the usual share of its points on the map. On a street with a tunnel it is 0.83 of
that and more; of a mirrored sweep 0.42, of another city's 0.19, of one in feet 0.01.
"""
ACCELERATION_M_S2, FASTEST_M_S = 5.0, 30.0
"""Sigmas of the motion model: of acceleration, as of a car that brakes hard, and of an unknown velocity."""
HELD_OF, UNUSUAL_M_S = 100, 1.0
"""Sweeps, of those whose alignment told more of the way than the motion so far in every direction, that tell how fast
the scanner goes. Along what the last one told less of, a velocity beyond theirs is expected to be so by their largest
speed, at one sigma, and by a slow walk of those at rest: an alignment in a corridor of like panels agrees with any.
"""
UNKNOWN: Floats = FASTEST_M_S**2 * np.eye(3)
"""Covariance (3, 3) of an unknown velocity, (m/s)²."""
MOST_DESKEWS, FARTHER = 10, 0.9
"""A sweep is deskewed again while its new velocity moves its farther points, at this quantile, by half a voxel, and by
less each time. The rounds are a limit on time: most sweeps take one, and few more than three.
"""


class Step(NamedTuple):
    """A sweep placed in the map, not yet part of it: `pose` at its middle, `time_s` at which it began, its velocity
    (6,) with the covariance (3, 3) of the translation; the share of its points on the map, NaN where it could not be
    aligned; `weak` (3, 3) projects on the directions of which the alignment told less than the motion so far, `weakest`
    (3,) is the one of which it told least, 0 where it told enough; see `ScanToMap` for the others.
    """

    pose: Floats
    time_s: float
    velocity: Floats
    spread: Floats
    turn_s: float
    is_loose: bool
    on_map: float
    weak: Floats
    weakest: Floats


class ScanToMap:
    """Scan to map on one sequence: `pose` is that at the middle of the last sweep, which took `turn_s` (0: unknown);
    `is_loose`: the last alignment hardly constrained translation in some direction, or failed. `slides`: it held as
    well elsewhere, which is tried where `tells_slides`.

    Sweeps are deskewed to their middle, about which the error of a wrong velocity is symmetric: deskewed to their first
    points, it would move the next pose the other way by half, and the velocity would oscillate.

    A Kalman filter of the velocity combines each alignment with the motion so far, which matters along a corridor.
    """

    def __init__(
        self,
        voxel_m: float,
        velocity: Floats,
        spread: Floats = UNKNOWN,
        levels: tuple[int, ...] = LEVELS,
        sample_m: float = SAMPLE_M,
        tells_slides: bool = False,
    ) -> None:
        self._voxel_m, self._coarsest_m = voxel_m, LOOK_M * voxel_m * levels[0]
        self._map = SweepMap(voxel_m, levels, sample_m)
        self.velocity, self.pose, self.turn_s, self.is_loose = velocity, np.eye(4), 0.0, False
        self.spread = spread  # covariance of the velocity, (m/s)^2
        self._time_s: float | None = None
        self._usual = deque[float](maxlen=USUAL_OF)
        self._tells_slides, self.slides = tells_slides, False
        self._held, self._weak = deque[Floats](maxlen=HELD_OF), np.zeros((3, 3))

    def follow(self, cloud: PointCloud, time_s: float) -> None:
        """Find the pose of a sweep that began at `time_s`, which is earlier than the last one's on the way back."""
        self.accept(self.place(cloud, time_s))

    def is_strange(self, step: Step) -> bool:
        """Whether a sweep fits the map far worse than those before it did."""
        return step.on_map < STRANGE * usual_share(self._usual)

    def accept(self, step: Step) -> None:
        """The sweep placed last joins the map, and its motion the filter."""
        self.slides = self._tells_slides and bool(step.weakest.any()) and self._map.slides(step.pose, step.weakest)
        self._map.insert(step.pose)
        self.pose, self.velocity, self.spread, self._time_s = step.pose, step.velocity, step.spread, step.time_s
        self.turn_s, self.is_loose = step.turn_s, step.is_loose
        if np.isfinite(step.on_map):
            self._usual.append(step.on_map)
            self._weak = step.weak
            if not step.weak.any():
                self._held.append(step.velocity[3:])

    def place(self, cloud: PointCloud, time_s: float) -> Step:
        """The sweep that began at `time_s` in the map of those before.

        Where fewer of its points lie on the map than usual, a turn may have ended: deskewed by it, 9 degrees on the
        spot, sweeps find a place to which the turn goes on. Then it is placed as if the scanner turned no more, too.
        """
        step = self._placed(cloud, time_s, self.velocity)
        if not step.turn_s or not step.on_map < AS_USUAL * usual_share(self._usual):
            return step
        turning = self._map.latest
        straight = self._placed(cloud, time_s, np.concatenate([np.zeros(3), self.velocity[3:]]))
        if straight.on_map > step.on_map:
            return straight
        self._map.latest = turning
        return step

    def _placed(self, cloud: PointCloud, time_s: float, velocity: Floats) -> Step:
        """The sweep placed, expected to move with this velocity (6,).

        It is deskewed by the velocity found until that settles. Where a fast turn sets in, two velocities may lead to
        each other without end: where the changes no longer shrink, the round with most points on the map stands.
        """
        turn_s = 0.0 if cloud.times_s is None else float(cloud.times_s.max())
        duration = 0.0 if self._time_s is None else time_s - self._time_s
        velocity, spread = self._expected(velocity, self.spread + (ACCELERATION_M_S2 * duration) ** 2 * np.eye(3))
        before, moved_spread, shift_m = self.pose, spread, np.inf
        weak, weakest = np.eye(3), np.zeros(3)  # of the velocity two sweeps of one stamp tell nothing
        predicted = before @ se3.exp(velocity * duration)
        squares = np.einsum("ni,ni->n", cloud.points_in_cam, cloud.points_in_cam)
        far_m, rounds = float(np.sqrt(np.quantile(squares, FARTHER))), list[tuple[Step, Latest]]()
        for _ in range(MOST_DESKEWS):
            points = deskewed(cloud, velocity, turn_s / 2).points_in_cam.astype(np.float64)
            guesses = [before @ se3.exp(velocity * duration)]
            if _shift_m(velocity, far_m, abs(duration)) > self._coarsest_m:
                guesses.append(before)  # after a gap the scanner may be where it was
            moves_m2 = spread * duration**2
            pose, information = self._map.align(points, guesses, partial(_surprise, predicted, moves_m2))
            is_loose = information is None and self._time_s is not None
            if information is None or not duration:
                on_map = np.nan if information is None else self._map.share_at(pose)
                return Step(pose, time_s, velocity, moved_spread, turn_s, is_loose, on_map, weak, weakest)
            known, axes = np.linalg.eigh(information[3:, 3:])
            weak = axes * (known * (ACCELERATION_M_S2 * duration**2) ** 2 < 1) @ axes.T
            weakest = axes[:, 0] * (known[0] < WEAKEST * known.sum())
            is_loose = bool(known[0] < LOOSE * known.sum())
            pose, moved = _kalman_update(predicted, moves_m2, pose, information)
            moved_spread = moved / duration**2
            rate, velocity = velocity, se3.log(se3.inverse(before) @ pose) / duration
            on_map = self._map.share_at(pose)
            step = Step(pose, time_s, velocity, moved_spread, turn_s, is_loose, on_map, weak, weakest)
            rounds.append((step, self._map.latest))
            last_m, shift_m = shift_m, _shift_m(velocity - rate, far_m, turn_s / 2)
            if shift_m < self._voxel_m / 2:
                return step
            if shift_m >= last_m:
                break
        step, self._map.latest = max(rounds, key=lambda one: one[0].on_map)
        return step

    def _expected(self, velocity: Floats, spread: Floats) -> tuple[Floats, Floats]:
        """A velocity (6,) and the covariance (3, 3) of its translation, along weak directions drawn back to the
        range of those of sweeps that held.
        """
        if len(self._held) < USUAL_OF:
            return velocity, spread
        held = np.array(self._held)
        beyond = np.clip(velocity[3:], held.min(axis=0), held.max(axis=0)) - velocity[3:]
        known = self._weak / (UNUSUAL_M_S**2 + np.square(held).sum(axis=1).max())
        if not (known @ beyond).any():
            return velocity, spread
        spread = np.linalg.inv(np.linalg.inv(spread) + known)
        return np.concatenate([velocity[:3], velocity[3:] + spread @ known @ beyond]), spread


def _shift_m(rates: Floats, far_m: float, seconds: float) -> float:
    """Metres by which a velocity moves points so far away in this time."""
    return float((np.linalg.norm(rates[:3]) * far_m + np.linalg.norm(rates[3:])) * seconds)


def _prior(spread_m2: Floats) -> Floats:
    """The covariance (6, 6) of a predicted pose, by that (3, 3) of its translation; of rotation a sigma of 1 radian."""
    covariance = np.eye(6)
    covariance[3:, 3:] = spread_m2
    return covariance


def _surprise(predicted: Floats, spread_m2: Floats, aligned: Floats, information: Floats) -> float:
    """Minus the log-likelihood of an aligned pose under the prediction, its own uncertainty counted in."""
    off = se3.log(se3.inverse(predicted) @ aligned)
    return float(off @ np.linalg.solve(_prior(spread_m2) + np.linalg.inv(information), off)) / 2


def _kalman_update(predicted: Floats, spread_m2: Floats, aligned: Floats, information: Floats) -> tuple[Floats, Floats]:
    """The mean, by information, of the predicted and the aligned pose, and the covariance (3, 3) of its translation."""
    known = np.eye(6)  # information of the prediction
    known[3:, 3:] = np.linalg.inv(spread_m2)
    both = information + known
    moved = np.asarray(np.linalg.solve(both, information @ se3.log(se3.inverse(predicted) @ aligned)))
    return predicted @ se3.exp(moved), np.asarray(np.linalg.inv(both)[3:, 3:])

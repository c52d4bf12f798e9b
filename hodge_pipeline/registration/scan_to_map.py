"""Scan-to-map tracking of the sweeps of one LiDAR: voxelised GICP, filtered with a constant-velocity model."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import small_gicp

from hodge_pipeline import se3
from hodge_pipeline.registration.assessment import MIN_POINTS
from hodge_pipeline.registration.sweeps import deskewed
from hodge_pipeline.types import Floats, Floats32, Ints, PointCloud

START_LEVELS, LEVELS = (9, 3, 1), (3, 1)
"""Sizes of the map's voxels, in finest voxels, coarse to fine: the coarsest catch an unknown velocity of 30 m/s."""
LOOK_M, START_SAMPLE_M, SAMPLE_M = 3.0, 1.4, 0.7
"""Correspondence distance at a level, in its voxels; voxel that a sweep is down-sampled to, in finest voxels, for the
first velocity (in twenty worlds as right with half to two thirds of the points) and for poses.
"""
NEIGHBOURS, MOST_ITERATIONS, SWEEPS_KEPT = 10, 30, 100
"""As small_gicp has them: points in a covariance; steps at a level; sweeps until a voxel that no sweep touches goes."""
FLATTEST = 0.05
"""Ratio of the second to the first variance of a point's neighbours below which they lie on a line, such as one ring
on the ground: their covariance is a plane of arbitrary direction, which would pull the ring to where it was.
"""
LOOSE = 0.002
"""Share of the information on translation that its weakest direction has, below which little tells how far the scanner
went: 0 in a bare tunnel, 0.0013 on a bare field at 16 beams, 0.01 to 0.1 in offices, forests and streets.
"""
WEAKEST, AS_WELL, APART = 0.05, 0.95, 0.5
"""Share of the information on translation that its weakest direction has, below which the alignment is tried from a
voxel to either side along it; share of the more inliers with which both places found fit alike; finest voxels by which
they are two. Then the sweep slides, though its information may seem to hold: of 20 sweeps in a row, in offices and
tunnels, the path is 5 % too long or short in 1 of 25 where fewer than a fifth slide, in 2 of 3 where four fifths do.
"""
LEAST = 1e-6
"""Share of the information on translation that every direction keeps, so that the matrix stays positive."""
UNMATCHED = 9.0
"""Cost of a point without a correspondence, in usual errors of points with one: as of one three times as far off."""
STRANGE, USUAL_OF, FEWEST_USUAL = 0.5, 10, 3
"""A sweep is strange that has half of the usual share of its points on the map: of the median of up to `USUAL_OF`
sweeps before, at least `FEWEST_USUAL`. On a street with a tunnel it is 0.83 of that and more; of a mirrored sweep 0.42,
of another city's 0.19, of one in feet 0.01.
"""
AS_USUAL = 0.9
"""An alignment from the predicted pose with this share of the usual inliers needs none from the coarser levels: on
streets, in forests, offices and fields that is nearly every sweep, and errors are the same with them and without.
Likewise one with this share of the usual points on the map needs no other deskewing.
"""
ON_MAP = 0.5
"""Finest voxels from a Gaussian of the map within which a point lies on it."""
ACCELERATION_M_S2, FASTEST_M_S = 5.0, 30.0
"""Sigmas of the motion model: of acceleration, as of a car that brakes hard, and of an unknown velocity."""
HELD_OF, UNUSUAL_M_S = 100, 1.0
"""Sweeps, of those whose alignment told more of the way than the motion so far in every direction, that tell how fast
the scanner goes. Along what the last one told less of, a velocity beyond theirs is expected to be so by their largest
speed, at one sigma, and by a slow walk of those at rest: an alignment in a corridor of like panels agrees with any.
"""
UNKNOWN: Floats = FASTEST_M_S**2 * np.eye(3)
"""Covariance (3, 3) of an unknown velocity, (m/s)²."""
SHARED_ERRORS = 30.0
"""Factor on the sigma of a pose that independent points would give: points of a ring or wall share their errors. In a
simulated corridor steps of 16 beams scattered by 0.1 m and claimed 3 mm.
"""
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
        self._map = _Map(voxel_m, levels, sample_m)
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
        return step.on_map < STRANGE * _usual(self._usual)

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
        if not step.turn_s or not step.on_map < AS_USUAL * _usual(self._usual):
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
        far_m, rounds = _far_m(cloud.points_in_cam), list[tuple[Step, _Latest]]()
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


def _far_m(points: Floats32) -> float:
    """The distance of the farther points (N, 3), at quantile `FARTHER`."""
    return float(np.sqrt(np.quantile(np.einsum("ni,ni->n", points, points), FARTHER)))


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


def _usual(shares: deque[float]) -> float:
    """The median share of the sweeps before; NaN where there are too few."""
    return float(np.median(shares)) if len(shares) >= FEWEST_USUAL else np.nan


class _Latest(NamedTuple):
    """The sweep aligned last, thinned, if any; its share of inliers, and their mean error; (3, 3) what noise of its
    normals feigns of the information on translation.
    """

    sweep: Any = None
    share: float = np.nan
    error: float = np.nan
    spurious: Floats = np.zeros((3, 3))


class _Map:
    """Voxels of Gaussians (Koide et al., ICRA 2021) of the sweeps so far, at several sizes, coarse to fine."""

    def __init__(self, voxel_m: float, levels: tuple[int, ...], sample_m: float) -> None:
        self._sample_m, self._is_empty, self.latest = sample_m * voxel_m, True, _Latest()
        self._shares, self._errors = deque[float](maxlen=USUAL_OF), deque[float](maxlen=USUAL_OF)  # of those before
        self._levels = [(size * voxel_m, small_gicp.GaussianVoxelMap(size * voxel_m)) for size in levels]
        for _, voxels in self._levels:
            voxels.set_lru(horizon=SWEEPS_KEPT)

    def align(
        self, points: Floats, guesses: list[Floats], surprise: Callable[[Floats, Floats], float]
    ) -> tuple[Floats, Floats | None]:
        """The pose of a sweep by points (N, 3) and its information (6, 6), rotation first, in its own axes; the first
        guess and None where it could not be aligned. `surprise` is minus the log-likelihood of a pose, with its
        information, by what is known of the motion; it counts where there are several guesses.
        """
        self.latest = self._thinned(points) if len(points) >= MIN_POINTS else _Latest(spurious=self.latest.spurious)
        if self.latest.sweep is None or self.latest.sweep.size() < MIN_POINTS or self._is_empty:
            return guesses[0], None
        count = self.latest.sweep.size()
        found = [self._aligned(self._levels[-1], guess) for guess in guesses]
        if len(found) > 1 or not found[0].num_inliers >= AS_USUAL * count * _usual(self._shares):
            found += [self._aligned(self._levels[-1], self._coarse(guess)) for guess in guesses]
        held = [one for one in found if one.num_inliers >= MIN_POINTS and se3.is_motion(one.T_target_source)]
        if not held:
            return guesses[0], None
        least = max(min(one.error / one.num_inliers for one in held), 1e-12)
        is_after_hole = len(guesses) > 1
        usual = _usual(self._errors) if is_after_hole and len(self._errors) >= FEWEST_USUAL else least

        def cost(one: Any) -> float:
            by_points = (one.error / usual + (count - one.num_inliers) * UNMATCHED) / SHARED_ERRORS**2
            if not is_after_hole:
                return float(by_points)
            return float(by_points + surprise(one.T_target_source, self._information(one, max(least, usual))))

        best = min(held, key=cost)
        self.latest = self.latest._replace(share=best.num_inliers / count, error=best.error / best.num_inliers)
        return np.asarray(best.T_target_source), self._information(best, least)

    def _information(self, aligned: Any, error: float) -> Floats:
        """The information (6, 6) of an alignment whose points have this mean error."""
        return _without_spurious(np.asarray(aligned.H) / (SHARED_ERRORS**2 * error), self.latest.spurious)

    def slides(self, pose: Floats, along: Floats) -> bool:
        """Whether the sweep aligned last, from a voxel to either side of a pose along a direction (3,) in its axes, is
        aligned at two places that fit alike.
        """
        size_m, step = self._levels[-1][0], pose[:3, :3] @ along
        sides = np.tile(pose, (2, 1, 1))
        sides[:, :3, 3] += np.outer((-size_m, size_m), step)
        found = [self._aligned(self._levels[-1], side) for side in sides]
        one, other = (step @ np.asarray(side.T_target_source)[:3, 3] for side in found)
        fewer, more = sorted(side.num_inliers for side in found)
        return bool(abs(one - other) > APART * size_m and fewer > AS_WELL * more)

    def share_at(self, pose: Floats) -> float:
        """The share of the points of the sweep aligned last that lie on the map, from this pose."""
        assert self.latest.sweep is not None
        size_m, voxels = self._levels[-1]
        found = small_gicp.align(
            voxels, self.latest.sweep, pose, max_correspondence_distance=ON_MAP * size_m, max_iterations=1
        )
        return float(found.num_inliers / self.latest.sweep.size())

    def _coarse(self, guess: Floats) -> Floats:
        for level in self._levels[:-1]:
            found = np.asarray(self._aligned(level, guess).T_target_source)
            guess = found if se3.is_motion(found) else guess
        return guess

    def _aligned(self, level: tuple[float, Any], guess: Floats) -> Any:
        size_m, voxels = level
        return small_gicp.align(
            voxels,
            self.latest.sweep,
            guess,
            max_correspondence_distance=LOOK_M * size_m,
            max_iterations=MOST_ITERATIONS,
        )

    def insert(self, pose: Floats) -> None:
        """The sweep aligned last joins the map."""
        if self.latest.sweep is None:
            return
        if np.isfinite(self.latest.share):
            self._shares.append(self.latest.share)
            self._errors.append(self.latest.error)
        for _, voxels in self._levels:
            voxels.insert(self.latest.sweep, pose)
        self._is_empty = False

    def _thinned(self, points: Floats) -> _Latest:
        """One point per voxel with its covariance, without those whose neighbours lie on a line."""
        spurious = self.latest.spurious
        sweep = small_gicp.voxelgrid_sampling(points, self._sample_m)
        sampled = np.asarray(sweep.points())[:, :3]
        if len(sampled) > NEIGHBOURS:
            rows, _ = small_gicp.KdTree(sweep).batch_knn_search(sampled, NEIGHBOURS)
            scatter = _scatter(sampled, np.asarray(rows, np.int64))
            least, second, most = _variances(scatter)
            is_flat = second > FLATTEST * most
            if is_flat.sum() > NEIGHBOURS:
                sweep = small_gicp.PointCloud(sampled[is_flat])
                spurious = _noise_of_normals(scatter[is_flat], least[is_flat], second[is_flat], most[is_flat])
        small_gicp.estimate_covariances(sweep, None, NEIGHBOURS)
        return _Latest(sweep, spurious=spurious)


def _without_spurious(information: Floats, spurious: Floats) -> Floats:
    """The information (6, 6), less what is spurious of that on translation, (3, 3) of a total of 1, in its axes."""
    values, vectors = np.linalg.eigh(information[3:, 3:])
    total = values.sum()
    real = values - total * np.einsum("ji,jk,ki->i", vectors, spurious, vectors)
    held = np.maximum(real, LEAST * total) / np.maximum(values, LEAST * total)
    scale = np.eye(6)
    scale[3:, 3:] = vectors * np.sqrt(held) @ vectors.T
    return np.asarray(scale @ information @ scale)


def _scatter(points: Floats, rows: Ints) -> Floats:
    """The covariances (N, 3, 3) of groups of points (P, 3) by rows (N, K), times K."""
    around = [column[rows.T] for column in np.ascontiguousarray(points.T)]
    centred = [column - column.mean(axis=0) for column in around]
    scatter = np.empty((len(rows), 3, 3))
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        scatter[:, i, j] = scatter[:, j, i] = np.einsum("kn,kn->n", centred[i], centred[j])
    return scatter


def _variances(scatter: Floats) -> tuple[Floats, Floats, Floats]:
    """The eigenvalues (N,) of symmetric matrices (N, 3, 3), least first: in closed form (Smith, CACM 1961), in a tenth
    of LAPACK's time on as many small matrices.
    """
    xx, yy, zz, xy, xz, yz = (scatter[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    mean = (xx + yy + zz) / 3
    a, b, c = xx - mean, yy - mean, zz - mean
    spread = np.sqrt((a * a + b * b + c * c + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    angle = np.arccos(np.clip(determinant / np.maximum(2 * spread**3, 1e-300), -1, 1)) / 3
    most = mean + 2 * spread * np.cos(angle)
    least = np.maximum(mean + 2 * spread * np.cos(angle + 2 * np.pi / 3), 0.0)
    return least, 3 * mean - most - least, most


def _noise_of_normals(scatter: Floats, least: Floats, second: Floats, most: Floats) -> Floats:
    """The covariance (3, 3) of normals from `NEIGHBOURS` points, the mean over their scatters (N, 3, 3) with these
    eigenvalues (N,): the share of the information on translation that is spurious.

    A normal has a variance of λ3 / (λi k) along each axis i of its plane. Along the narrow one it is 0.4 % in a tunnel
    at 16 beams, where alignment would stop the scanner; along the wide one, in which a scanner that looks ahead sees
    walls, less: with the narrow one's, sweeps that told how far it went in a corridor were taken to tell nothing.
    """
    least, second, most = (values[:, None, None] for values in (least, second, most))
    eye = np.eye(3)
    apart = np.maximum((most - least) * (second - least), 1e-6 * most**2)  # a ball has no normal
    across = (scatter - most * eye) @ (scatter - second * eye) / apart  # the normal times itself
    inverse = ((most + second) * (eye - across) - scatter + least * across) / (most * second)  # in the plane
    return np.asarray(np.mean(least * inverse, axis=0) / NEIGHBOURS)

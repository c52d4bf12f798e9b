"""The map that sweeps of one LiDAR are aligned with: voxelised GICP at several sizes of voxels."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import small_gicp

from hodge_pipeline import se3
from hodge_pipeline.registration.assessment import MIN_POINTS
from hodge_pipeline.types import Floats, Ints

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
AS_WELL, APART = 0.95, 0.5
"""Share of the more inliers with which both places found from either side fit alike; finest voxels by which they are
two.
"""
LEAST = 1e-6
"""Share of the information on translation that every direction keeps, so that the matrix stays positive."""
UNMATCHED = 9.0
"""Cost of a point without a correspondence, in usual errors of points with one: as of one three times as far off."""
ON_MAP = 0.5
"""Finest voxels from a Gaussian of the map within which a point lies on it."""
USUAL_OF, FEWEST_USUAL = 10, 3
"""Sweeps before, at most and at least, whose median is what is usual."""
AS_USUAL = 0.9
"""An alignment from the predicted pose with this share of the usual inliers needs none from the coarser levels: on
streets, in forests, offices and fields that is nearly every sweep, and errors are the same with them and without.
Likewise one with this share of the usual points on the map needs no other deskewing.
"""
SHARED_ERRORS = 30.0
"""Factor on the sigma of a pose that independent points would give: points of a ring or wall share their errors. In a
simulated corridor steps of 16 beams scattered by 0.1 m and claimed 3 mm.
"""


def usual_share(shares: deque[float]) -> float:
    """The median share of the sweeps before; NaN where there are too few."""
    return float(np.median(shares)) if len(shares) >= FEWEST_USUAL else np.nan


class Latest(NamedTuple):
    """The sweep aligned last, thinned, if any; its share of inliers, and their mean error; (3, 3) what noise of its
    normals feigns of the information on translation.
    """

    sweep: Any = None
    share: float = np.nan
    error: float = np.nan
    spurious: Floats = np.zeros((3, 3))


class SweepMap:
    """Voxels of Gaussians (Koide et al., ICRA 2021) of the sweeps so far, at several sizes, coarse to fine."""

    def __init__(self, voxel_m: float, levels: tuple[int, ...], sample_m: float) -> None:
        self._sample_m, self._is_empty, self.latest = sample_m * voxel_m, True, Latest()
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
        self.latest = self._thinned(points) if len(points) >= MIN_POINTS else Latest(spurious=self.latest.spurious)
        if self.latest.sweep is None or self.latest.sweep.size() < MIN_POINTS or self._is_empty:
            return guesses[0], None
        count = self.latest.sweep.size()
        found = [self._aligned(self._levels[-1], guess) for guess in guesses]
        if len(found) > 1 or not found[0].num_inliers >= AS_USUAL * count * usual_share(self._shares):
            found += [self._aligned(self._levels[-1], self._coarse(guess)) for guess in guesses]
        held = [one for one in found if one.num_inliers >= MIN_POINTS and se3.is_motion(one.T_target_source)]
        if not held:
            return guesses[0], None
        least = max(min(one.error / one.num_inliers for one in held), 1e-12)
        is_after_hole = len(guesses) > 1
        usual = usual_share(self._errors) if is_after_hole and len(self._errors) >= FEWEST_USUAL else least

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

    def _thinned(self, points: Floats) -> Latest:
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
        return Latest(sweep, spurious=spurious)


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

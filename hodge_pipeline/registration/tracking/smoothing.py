"""A camera's path made as smooth as its own measurements say that it is: a hand has mass, noise has none.

The poses are smoothed under white noise on acceleration, of rotation and of translation, as a Gaussian process prior on
a trajectory (Barfoot, Tong, Särkkä 2014) at the frames themselves. How strong it is beside the errors of the frames,
and how large these are, is what makes the path likeliest (restricted maximum likelihood): nothing is set.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import tail_weight
from hodge_pipeline.one_blas_thread import one_blas_thread
from hodge_pipeline.types import Floats

VIDEO_STEP_S = 0.2
"""Longest step between frames of a video. Of 2 mm of noise on true paths of hands and of a drone smoothing leaves half
at 30 Hz and adds none down to 5 Hz; at 3 Hz it takes turning to and fro for noise. Tracking agrees: fr1/rpy's every
third frame, 0.1 s, is tracked well; key frames 0.7 s apart are not.
"""
FEWEST = 10
"""Frames of a run: fewer hardly tell acceleration from errors."""
ROUNDS = 3
"""Of reweighting frames by their residuals: a blurred one errs by much more than its covariance."""
COARSE, FINE = np.arange(-12.0, 13.0, 4.0), (2.0, 1.0, 0.5)
"""Logarithms of the weights of rotation and of translation: a grid, since the likelihood may have several optima, and
the step sizes of a pattern search from its best node.
"""
LEAST_COST = 1e-12
"""Floor of the cost: a camera at rest needs no move at all."""
ORDER = 2
"""Order of the derivative that is white noise: the acceleration."""
BAND = 6 * ORDER
"""Bands above the diagonal of the normal equations, with six unknowns a frame."""


@one_blas_thread
def smoothed(world_from_cam: Floats, information: Floats, times_s: Floats) -> Floats:
    """The poses (n, 4, 4) of one unbroken run of frames, smoothed; as they are with fewer than `FEWEST` frames.

    `information (n, 6, 6)` of each is over `world_from_cam exp(ξ)`, up to a common factor; `times_s (n,)` ascend.
    """
    if len(world_from_cam) < FEWEST:
        return world_from_cam
    path = _Path.of(world_from_cam, information, times_s)
    weight, logs = np.ones(len(world_from_cam)), None
    for _ in range(ROUNDS):
        logs = path.likeliest(weight, logs)
        found = path.solve(weight, logs)
        chi2 = np.einsum("ni,nij,nj->n", found.moves, path.information, found.moves) / found.variance
        weight = tail_weight(chi2, 6)
    out = world_from_cam.copy()
    out[:, :3, :3] = se3.so3_exp(found.moves[:, :3]) @ out[:, :3, :3]
    out[:, :3, 3] += found.moves[:, 3:]
    return out


@dataclass(frozen=True)
class _Solved:
    """Moves (n, 6) in axes parallel to the world's, the factor on the covariances, and −2 log-likelihood up to a
    constant.
    """

    moves: Floats
    variance: float
    unlikeliness: float


@dataclass(frozen=True)
class _Path:
    """A run of frames: `information (n, 6, 6)` in axes parallel to the world's, `differences (n - 2, 3)` the finite
    differences of `_differences`, `bent (n - 2, 6)` the acceleration of the given poses, `unit (2,)` that of the
    weights on rotation and on translation.
    """

    information: Floats
    differences: Floats
    bent: Floats
    unit: Floats

    @classmethod
    def of(cls, world_from_cam: Floats, information: Floats, times_s: Floats) -> _Path:
        rotation, times = world_from_cam[:, :3, :3], times_s - times_s[0]
        turned = np.zeros((len(rotation), 6, 6))
        turned[:, :3, :3] = turned[:, 3:, 3:] = rotation
        steps = se3.so3_log(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2))
        turns = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        numbers = np.concatenate([turns, world_from_cam[:, :3, 3]], axis=1)
        information = turned @ information @ np.swapaxes(turned, 1, 2)
        diagonal = np.einsum("nii->ni", information)
        usual = np.median([diagonal[:, :3].mean(axis=1), diagonal[:, 3:].mean(axis=1)], axis=1)
        differences = _differences(times / np.median(np.diff(times)))
        return cls(information, differences, _applied(differences, numbers), np.asarray(usual))

    @cached_property
    def _smoothing(self) -> Floats:
        """Bands (3, n) of one unknown's normal equations for a weight of one: its diagonal and the two beside it."""
        bands, inner, each = np.zeros((ORDER + 1, len(self.information))), len(self.differences), self.differences.T
        for first in range(ORDER + 1):
            for later in range(first, ORDER + 1):
                bands[later - first, first : first + inner] += each[first] * each[later]
        return bands

    def _bands(self, weight: Floats, smooth: Floats) -> Floats:
        count = len(weight)
        bands = np.zeros((BAND + 1, count, 6))
        for i in range(6):
            for j in range(i, 6):
                bands[BAND + i - j, :, j] = weight * self.information[:, i, j]
        for later, each in enumerate(self._smoothing):
            bands[BAND - 6 * later, later:] += each[: count - later, None] * smooth
        return bands.reshape(BAND + 1, -1)

    def solve(self, weight: Floats, logs: Floats) -> _Solved:
        """The smoothed path by weights (n,) of frames and the logarithms (2,) of those on acceleration, in `unit`."""
        smooth = np.repeat(np.exp(logs) * self.unit, 3)
        factor = cholesky_banded(self._bands(weight, smooth))
        pull = np.zeros((len(weight), 6))
        for place in range(ORDER + 1):
            pull[place : place + len(self.bent)] -= self.differences[:, place, None] * self.bent * smooth
        moves = cho_solve_banded((factor, False), pull.ravel()).reshape(-1, 6)
        left = _applied(self.differences, moves) + self.bent
        cost = float(np.einsum("n,ni,nij,nj->", weight, moves, self.information, moves) + (smooth * left**2).sum())
        numbers = 6 * len(self.bent)
        log_det = 2 * float(np.log(factor[BAND]).sum()) - len(self.bent) * float(np.log(smooth).sum())
        cost = max(cost, LEAST_COST)
        return _Solved(moves, cost / numbers, numbers * float(np.log(cost)) + log_det)

    def likeliest(self, weight: Floats, logs: Floats | None) -> Floats:
        """The likeliest logarithms (2,) of the weights on acceleration; a local search where `logs` is given."""

        def unlikeliness(logs: Floats) -> float:
            return self.solve(weight, np.clip(logs, COARSE[0], COARSE[-1])).unlikeliness

        if logs is None:
            logs = min(np.array(list(product(COARSE, COARSE))), key=unlikeliness)
        for width in FINE:
            tried = logs + width * np.array([(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)])
            logs = min(tried, key=unlikeliness)
        return np.asarray(np.clip(logs, COARSE[0], COARSE[-1]))


def _differences(times: Floats) -> Floats:
    """Finite-difference coefficients (n - ORDER, ORDER + 1) of the derivative, over its standard deviation as noise."""
    near = np.lib.stride_tricks.sliding_window_view(times, ORDER + 1)
    apart = near[:, :, None] - near[:, None, :] + np.eye(ORDER + 1)
    return np.asarray(np.sqrt((near[:, -1:] - near[:, :1]) / ORDER) / apart.prod(axis=2))


def _applied(differences: Floats, numbers: Floats) -> Floats:
    count = len(differences)
    return np.asarray(sum(differences[:, place, None] * numbers[place : place + count] for place in range(ORDER + 1)))

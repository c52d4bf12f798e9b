"""A turn that all steps of an odometry have too much, as the bias of a gyroscope makes: estimated from loops.

It bends a path by the square of its length, which independent errors of steps do not. Each loop tells it by the
rotation that its cycle lacks; loops are right or wrong, wrong ones of any rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE, log_student
from hodge_pipeline.solvers.backbone.loop_places import corridors, one_of_each_place
from hodge_pipeline.solvers.backbone.scales import Scales
from hodge_pipeline.types import Floats, Ints

MOST_CYCLES = 400
"""Cycles that a bias is estimated from: their errors are correlated, in a dense matrix. Each proposes a bias: over few
steps one tells it roughly, over many up to whole turns.
"""
UNSEEN = 0.1
"""Share of its steps below which a cycle does not tell the bias about an axis: others have turned it away."""
LARGE = 4.0
"""Prior standard deviation of a bias in those of a step: cycles over like many steps are closed by whole turns more."""
FACTORS = 2.0 ** np.arange(2, -5, -1)
"""On the errors of steps: learned without a bias, they are so large that they explain it."""
MOST_TURNED = 4
"""Times that a path is turned: what cycles lack is linear in a bias that turns few of them by much. With 3 or 15,
of 108 biased graphs one of whose loops 75 are right has none confirmed.
"""


def without_bias(chain: Chain, scales: Scales) -> Chain | None:
    """The chain without the bias of its steps, by errors of these scales; None where loops do not tell it surely."""
    scaled = scales.applied(chain)
    rows = np.flatnonzero(~chain.apart)
    if not len(rows):
        return None
    rows = rows[one_of_each_place(scaled.places[rows])]
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), MOST_CYCLES)).astype(np.int64)]
    scaled = scaled.with_loops(rows, chain.ends[rows])
    for _ in range(MOST_TURNED):
        bias = _Cycles.of(scaled).surely()
        if not bias.any():
            break
        scaled, chain = scaled.turned(-bias), chain.turned(-bias)
    return chain if chain.bias.any() else None


@dataclass(frozen=True)
class _Cycles:
    """Rotations (K, r) that the cycles of loops lack, in the world's axes, and how a bias (r,) makes them.

    - `turned (K, r, r)`: the rotation that a unit bias makes; `steps (K,)`: how many it is of.
    - `shared (K, K)`: the variance of each axis by the steps that two cycles share; `own (K,)`: by the loop itself;
      `corridor (K,)`: that it is of; `usual_rad`: standard deviation of a step.
    """

    rotation: Floats
    turned: Floats
    steps: Ints
    shared: Floats
    own: Floats
    corridor: Ints
    usual_rad: float

    @classmethod
    def of(cls, chain: Chain) -> _Cycles:
        """The cycles of a chain's loops, each on one path."""
        size, poses, (low, high) = chain.rotation_axes, chain.poses, chain.ends.T
        frame = poses[:, :size, :size] if size == 3 else np.ones((chain.size, 1, 1))
        along = np.cumsum(np.where(chain.measured[:, None, None], frame, 0.0), axis=0)
        count = np.cumsum(chain.measured)
        of_step, of_loop = (
            np.einsum("nii->ni", each)[:, :size].mean(axis=1) for each in (chain.step_covariance, chain.covariance)
        )
        variance = np.cumsum(np.where(chain.measured, of_step, 0.0))
        shared = variance[np.minimum(high[:, None], high)] - variance[np.maximum(low[:, None], low)]
        lacks = chain.log(chain.between(chain.motion, chain.between(poses[low], poses[high])))[:, :size]
        return cls(
            np.einsum("kij,kj->ki", frame[high], lacks),
            along[high] - along[low],
            count[high] - count[low],
            np.maximum(shared, 0.0),
            of_loop,
            corridors(chain.places),
            float(np.sqrt(np.median(of_step[chain.measured]))),
        )

    def surely(self) -> Floats:
        """The bias (r,) of cycles that agree with the likeliest proposal, where errors of one of `FACTORS` make them
        likelier with it by more than chance; else zeros.
        """
        proposed = self._proposed()
        factor = self._factor(proposed)
        prior = -0.5 * ((proposed / (LARGE * self.usual_rad)) ** 2).sum(axis=1)
        gains = np.logaddexp(factor, 0.0)
        near = int(np.argmax(prior + gains.sum(axis=1)))
        agree, surely = np.flatnonzero(factor[near] > 0), BY_CHANCE + np.log(len(proposed))
        by_corridor = np.zeros(self.corridor.max() + 1)
        np.maximum.at(by_corridor, self.corridor, gains[near])
        if by_corridor.sum() - by_corridor.max() < surely:  # a mistaken corridor agrees with its own proposal
            return np.zeros(self.rotation.shape[1])
        found = [self._likely(agree, proposed[near], times) for times in FACTORS]
        _, likeliest, bias = max(found, key=lambda each: each[1])
        return bias if likeliest > max(none for none, *_ in found) + surely else np.zeros(len(bias))

    def _likely(self, rows: Ints, near: Floats, times: float) -> tuple[float, float, Floats]:
        """Log-evidence of no bias, and of one near (r,), by cycles (rows) whose steps err `times` as much; and it."""
        covariance = times**2 * self.shared[np.ix_(rows, rows)] + np.diag(self.own[rows])
        factor = cho_factor(covariance, lower=True)
        turned, given = self.turned[rows], self.rotation[rows]
        left = self._left(near[None])[0, rows] + (turned @ near[:, None])[..., 0]  # with the whole turns that it makes
        weighed = cho_solve(factor, turned.reshape(len(rows), -1)).reshape(turned.shape)
        values, axes = np.linalg.eigh(np.einsum("kij,kil->jl", turned, weighed))
        pull = axes.T @ np.einsum("kij,ki->j", weighed, left)
        spread = (LARGE * self.usual_rad) ** 2
        gain = 0.5 * pull**2 * spread / (1 + spread * values) - 0.5 * np.log1p(spread * values)
        none, both = (-0.5 * (each * cho_solve(factor, each)).sum() for each in (given, left))
        half_log_det = given.shape[1] * np.log(np.diag(factor[0])).sum()
        bias = axes @ (pull * spread / (1 + spread * values))
        return float(none - half_log_det), float(both - half_log_det + gain.sum()), np.asarray(bias)

    def _proposed(self) -> Floats:
        """Biases (P, r), zero and those of one cycle each."""
        back, size = np.swapaxes(self.turned, 1, 2), self.rotation.shape[1]
        damped = back @ self.turned + (UNSEEN * self.steps[:, None, None]) ** 2 * np.eye(size)
        pull = back @ self.rotation[..., None]
        return np.concatenate([np.zeros((1, size)), np.linalg.solve(damped, pull)[..., 0]])

    def _left(self, bias: Floats) -> Floats:
        """What is left of the rotations (P, K, r) with each bias (P, r), none of more than half a turn."""
        left = self.rotation - np.einsum("kij,pj->pki", self.turned, bias)
        angle = np.linalg.norm(left, axis=-1, keepdims=True)
        return np.asarray(left * (1 - 2 * np.pi * np.rint(angle / (2 * np.pi)) / np.maximum(angle, np.pi)))

    def _factor(self, bias: Floats) -> Floats:
        """Log Bayes factors (P, K) of the loops with each bias (P, r), against a rotation drawn at random."""
        size, variance = bias.shape[1], np.diag(self.shared) + self.own
        chi2 = (self._left(bias) ** 2).sum(axis=-1) / variance
        at_random = np.log(2 * np.pi) if size == 1 else np.log(4 / 3 * np.pi**4)
        return np.asarray(log_student(chi2, size) - 0.5 * size * np.log(variance) + at_random)

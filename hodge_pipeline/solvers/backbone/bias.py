"""A turn that all steps of an odometry have too much, as the bias of a gyroscope makes: estimated from loops.

It bends a path by the square of its length, which no independent errors of steps explain. Each loop tells it by the
rotation that its cycle lacks; loops are right or wrong, wrong ones of any rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.complex.chi2 import tail_weight
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE, LARGEST, log_student
from hodge_pipeline.solvers.backbone.loop_places import one_of_each_place
from hodge_pipeline.solvers.backbone.scales import Scales
from hodge_pipeline.types import Floats, Ints

FINER = 0.5 ** np.arange(4)
"""Factors on the learned errors of steps, the likeliest of which counts: without it a bias passes for large errors."""
LARGE = 4.0
"""Prior standard deviation of a bias in those of a step: cycles over like many steps are closed by whole turns more."""
PROPOSED = 100
"""Most loops that each propose a bias: over few steps one tells it roughly, over many up to whole turns."""
MOST_TURNED = 4
"""Times that a path is turned: what loops tell is linear in a bias that turns few of them by much."""
ROUNDS, LEAST_GAIN = 10, 1e-3
"""Reweighting rounds at most, and the nats that one must gain."""
UNSEEN = 0.1
"""Share of its steps below which a loop does not tell the bias about an axis: others have turned it away."""


def without_bias(chain: Chain, scales: Scales) -> Chain | None:
    """The chain without the bias of its steps, by errors of these scales; None where loops do not tell it surely."""
    rows = np.flatnonzero(chain.path[chain.ends[:, 0]] == chain.path[chain.ends[:, 1]])
    if not len(rows):
        return None
    rows = rows[one_of_each_place(scales.applied(chain).places[rows])]
    some, size = chain.with_loops(rows, chain.ends[rows]), chain.rotation_axes
    of_steps = scales.applied(chain).step_covariance[chain.inner & ~chain.bridged]
    turn_rad = float(np.sqrt(np.median(np.einsum("nii->ni", of_steps)[:, :size].mean(axis=1))))
    surely, unbiased = BY_CHANCE + np.log(min(len(rows), PROPOSED)), chain
    for _ in range(MOST_TURNED):
        finer = (replace(scales, step_turn=scales.step_turn * each).applied(some) for each in FINER)
        found = [_Cycles.of(each, LARGE * turn_rad) for each in finer]
        bias, likelihood = max((each.likeliest() for each in found), key=lambda each: each[1])
        if likelihood - max(each.log_likelihood(0 * bias[None])[0] for each in found) < surely:
            break
        some, unbiased = some.turned(-bias), unbiased.turned(-bias)
    return unbiased if unbiased.bias.any() else None


@dataclass(frozen=True)
class _Cycles:
    """Rotations (K, r) that the cycles of loops lack, linear in the bias (r,).

    - `turned (K, r, r)`: the rotation that a unit bias makes; `steps (K,)`: how many; `variance (K,)` of each axis;
      `prior`: standard deviation of the bias, radians.
    """

    rotation: Floats
    turned: Floats
    steps: Ints
    variance: Floats
    prior: float

    @classmethod
    def of(cls, chain: Chain, prior: float) -> _Cycles:
        """The cycles of a chain's loops, each on one path."""
        size, poses, (low, high) = chain.rotation_axes, chain.poses, chain.ends.T
        measured = chain.inner & ~chain.bridged
        frame = poses[:, :size, :size] if size == 3 else np.ones((chain.size, 1, 1))
        along = np.cumsum(np.where(measured[:, None, None], frame, 0.0), axis=0)
        count = np.cumsum(measured)
        of_step, of_loop = (np.einsum("nii->ni", each)[:, :size] for each in (chain.step_covariance, chain.covariance))
        variance = np.cumsum(np.where(measured, of_step.mean(axis=1), 0.0))
        lacks = chain.log(chain.between(chain.motion, chain.between(poses[low], poses[high])))
        return cls(
            lacks[:, :size],
            np.swapaxes(frame[high], 1, 2) @ (along[high] - along[low]),
            count[high] - count[low],
            variance[high] - variance[low] + of_loop.mean(axis=1),
            prior,
        )

    def left(self, bias: Floats) -> Floats:
        """What is left of the rotations (P, K, r) with each bias (P, r), none of more than half a turn."""
        left = self.rotation - np.einsum("kij,pj->pki", self.turned, bias)
        angle = np.linalg.norm(left, axis=-1, keepdims=True)
        return np.asarray(left * (1 - 2 * np.pi * np.rint(angle / (2 * np.pi)) / np.maximum(angle, np.pi)))

    def factor(self, bias: Floats) -> Floats:
        """Log Bayes factors (P, K) of the loops with each bias (P, r), against a rotation drawn at random."""
        size = bias.shape[1]
        chi2 = (self.left(bias) ** 2).sum(axis=-1) / self.variance
        at_random = np.log(2 * np.pi) if size == 1 else np.log(4 / 3 * np.pi**4)
        found = log_student(chi2, size) - 0.5 * size * np.log(self.variance) + at_random
        return np.asarray(np.minimum(found, LARGEST))

    def log_likelihood(self, bias: Floats) -> Floats:
        """Of each bias (P, r) and its prior, where every loop is as likely right as wrong."""
        prior = -0.5 * (bias**2).sum(axis=1) / self.prior**2
        return np.asarray(prior + np.logaddexp(self.factor(bias), 0.0).sum(axis=1))

    def likeliest(self) -> tuple[Floats, float]:
        """The bias (r,) and its log-likelihood: the best of those that one loop each proposes, refined by all."""
        size = self.rotation.shape[1]
        some = np.argsort(self.steps, kind="stable")
        some = some[np.linspace(0, len(some) - 1, min(PROPOSED, len(some))).astype(np.int64)]
        turned, damping = self.turned[some], (UNSEEN * self.steps[some, None, None]) ** 2 * np.eye(size)
        normal = np.swapaxes(turned, 1, 2) @ turned + damping
        pull = np.swapaxes(turned, 1, 2) @ self.rotation[some, :, None]
        proposed = np.asarray(np.linalg.solve(normal, pull)[..., 0], float)
        likelihood = self.log_likelihood(proposed)
        best, top = proposed[np.argmax(likelihood)], float(likelihood.max())
        for _ in range(ROUNDS):
            left, factor = self.left(best[None])[0], self.factor(best[None])[0]
            weight = tail_weight((left**2).sum(axis=1) / self.variance, size) / (1 + np.exp(-factor)) / self.variance
            normal = np.einsum("k,kij,kil->jl", weight, self.turned, self.turned) + np.eye(size) / self.prior**2
            pull = np.einsum("k,kij,ki->j", weight, self.turned, left) - best / self.prior**2
            tried = best + np.asarray(np.linalg.solve(normal, pull), float)
            if (gained := float(self.log_likelihood(tried[None])[0])) < top + LEAST_GAIN:
                break
            best, top = tried, gained
        return best, top

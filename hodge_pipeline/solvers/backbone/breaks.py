"""Candidate broken steps: an odometry edge that is off by far, where loops over it agree on another motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import STUDENT_99, tail_weight
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import mahalanobis, student_log_density
from hodge_pipeline.solvers.backbone.fit import Fit
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS, MOST_TRIED, NEARLY_ALL, SINGULAR
from hodge_pipeline.solvers.backbone.linear import linearise, turned
from hodge_pipeline.solvers.backbone.pairwise import PairwiseConsistency
from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class StepModel:
    """The distribution of the motions of a chain's steps.

    - `centre (4, 4)`: of the usual step; `covariance (p, p)`.
    - `unusual (n,)`: by how many nats each step is rarer than the rarest of as many should be.
    """

    centre: Floats
    covariance: Floats
    unusual: Floats

    @classmethod
    def of(cls, chain: Chain) -> StepModel:
        """Fitted to the steps with Student's t, which single steps hardly change, and to the tail of their χ².

        Each step counts with its mirror image, since turns to the right are as usual as those to the left.
        """
        rows = np.flatnonzero(chain.measured)
        twist = chain.log(chain.step[rows])
        twist = np.concatenate([twist, twist @ _mirrored(chain, twist)])
        centre = np.median(twist, axis=0)
        covariance, chi2 = _student_covariance(twist - centre)
        unusual = np.full(chain.size, -np.inf)
        unusual[rows] = _rarity(chi2[: len(rows)]) - np.log(len(rows))
        return cls(chain.exp(centre), covariance, unusual)

    def off(self, pairwise: PairwiseConsistency, loop: Ints, at: Ints) -> tuple[Floats, Floats]:
        """Twists (K, p) from the centre to the steps to positions `at (K,)` that loops `loop (K,)` ask for, and the
        covariances (K, p, p) of these steps.
        """
        end, covariance = pairwise.predicted(loop, at - 1, at)
        chain, asked = pairwise.chain, pairwise.chain.between(pairwise.linear.poses[at - 1], end)
        return chain.log(chain.between(self.centre, asked)), covariance


def _student_covariance(left: Floats) -> tuple[Floats, Floats]:
    """The covariance (p, p) of residuals (M, p), with weights by Student's t, and their χ² (M,)."""
    weight = np.ones(len(left))
    for _ in range(MOST_ROUNDS):
        covariance = (left * weight[:, None]).T @ left / len(left)
        covariance += np.diag(SINGULAR * np.diag(covariance) + np.finfo(float).tiny ** 0.5)
        chi2 = mahalanobis(left, np.broadcast_to(covariance, (len(left), *covariance.shape)))[0]
        weight = tail_weight(chi2, left.shape[1])
    return covariance, chi2


def _rarity(chi2: Floats) -> Floats:
    """Minus the log-probability (M,) of a larger χ², by an exponential tail of the logarithms of these (Hill 1975), all
    but `NEARLY_ALL` of them.
    """
    size = np.log(np.maximum(chi2, np.finfo(float).tiny)) / 2
    floor = np.quantile(size, NEARLY_ALL)
    mean = float(np.mean(size[size > floor] - floor)) if (size > floor).any() else np.inf
    return np.asarray(np.maximum((size - floor) / mean - np.log(1 - NEARLY_ALL), 0.0))


def _mirrored(chain: Chain, twist: Floats) -> Floats:
    """The rotation (p, p) of twists (M, p) by 180° about their median direction of travel."""
    ahead = np.zeros(6)
    ahead[chain.axes] = np.median(twist, axis=0)
    half = 2 * np.outer(ahead[3:], ahead[3:]) / max(float(ahead[3:] @ ahead[3:]), np.finfo(float).tiny) - np.eye(3)
    return np.asarray(np.kron(np.eye(2), half)[np.ix_(chain.axes, chain.axes)], float)


@dataclass(frozen=True)
class Break:
    """A step, at position `at`, that may be broken.

    - `motion (4, 4)` and `covariance (p, p)`: of the bridge in its place; `usual`: whether it is as steps usually are.
    - `log_evidence`: in nats, for the break.
    """

    at: int
    motion: Floats
    covariance: Floats
    log_evidence: float
    usual: bool = True


def agreed_breaks(pairwise: PairwiseConsistency, usual: StepModel) -> list[Break]:
    """The likeliest break by each seed of loops that agree, one with a usual step and one without; likeliest first."""
    chain = pairwise.chain
    rows = np.flatnonzero(~chain.apart)
    out = []
    for seed, factor in pairwise.seeds(rows):
        low, high = chain.ends[seed]
        at = np.arange(low + 1, high + 1)
        gain = pairwise.gains(seed, rows, factor)
        fits = _log_with_usual_step(pairwise, usual, np.full(len(at), seed), at) - pairwise.log_wrong[seed]
        score = chain.over(chain.ends[rows], gain)[at] + np.maximum(fits, 0.0)
        score += usual.unusual[at] - pairwise.by_chain[seed]
        may = ~_shifted_aside(pairwise, usual, seed, at)
        fit, far = may & (fits > 0), may & (fits <= 0)
        if fit.any():
            out.append(_break(pairwise, usual, seed, at[fit], score[fit]))
        if far.any():
            # bridged as far as the loop asks for: the robot was carried on, or its odometry stood still
            row = np.flatnonzero(far)[np.argmax(score[far])]
            one = int(at[row])
            out.append(Break(one, *pairwise.bridge(seed, one - 1, one), float(score[row]), usual=False))
    return sorted(out, key=lambda each: -each.log_evidence)


def _log_with_usual_step(pairwise: PairwiseConsistency, usual: StepModel, loop: Ints, at: Ints) -> Floats:
    """Log-density (K,) of `loop (K,)` if it is right and the step to position `at (K,)` is a usual one."""
    off, covariance = usual.off(pairwise, loop, at)
    return student_log_density(off, covariance + usual.covariance)[0]


def _break(pairwise: PairwiseConsistency, usual: StepModel, loop: int, at: Ints, score: Floats) -> Break:
    """The break at the position `at (K,)` of the highest score (K,), bridged by a usual step, with heavy tails, moved
    towards what the loop asks for.
    """
    row = int(np.argmax(score))
    one = at[row : row + 1]
    off, covariance = usual.off(pairwise, np.array([loop]), one)
    chi2 = mahalanobis(off, covariance + usual.covariance)[0][0]
    wide = usual.covariance * max(1.0, 1 / float(tail_weight(chi2, off.shape[1])))
    towards = wide @ np.linalg.solve(wide + covariance[0], off[0])
    return Break(int(one[0]), usual.centre @ pairwise.chain.exp(towards), wide, float(score[row]))


def _shifted_aside(pairwise: PairwiseConsistency, usual: StepModel, loop: int, at: Ints) -> Bools:
    """Whether a bridge to positions `at (K,)`, as far as the loop asks for, leads aside of the step by far, and turned
    as it is. So do loops between floors, or rows, that look alike; a robot that is carried off is turned, and odometry
    that stands still lags behind.
    """
    chain, split = pairwise.chain, pairwise.chain.rotation_axes
    turn, shift = slice(0, split), slice(split, None)
    end, covariance = pairwise.predicted(np.full(len(at), loop), at - 1, at)
    off = chain.log(chain.between(pairwise.linear.poses[at], end))
    ahead = chain.log(usual.centre)[shift]
    across = np.linalg.svd(ahead[:, None])[0][:, 1:].T
    as_it_is = mahalanobis(off[:, turn], covariance[:, turn, turn])[0] < STUDENT_99[split]
    aside = mahalanobis(off[:, shift] @ across.T, across @ covariance[:, shift, shift] @ across.T)[0]
    return np.asarray(as_it_is & (aside > STUDENT_99[len(across)]))


def unusual_breaks(usual: StepModel) -> list[Break]:
    """Breaks at the most unusual steps, the most unusual first, whatever the loops say; `log_evidence` is `unusual`."""
    rows = np.argsort(-usual.unusual)
    return [Break(int(at), usual.centre, usual.covariance, float(usual.unusual[at])) for at in rows[:MOST_TRIED]]


@dataclass(frozen=True)
class Runs:
    """Runs of steps between the ends of used loops, each tested against the solution without it.

    `pairwise`: of a chain whose loops are the motions of the runs at poses solved without each, in ascending order.
    """

    pairwise: PairwiseConsistency
    usual: StepModel

    @classmethod
    def of(cls, fit: Fit, poses: Floats, usual: StepModel) -> Runs:
        """The runs of a fit, at least one, with covariances scaled up to their median χ²; `poses (n, 4, 4)`: the bare
        chain's.
        """
        chain, used, linear = fit.linear.chain, fit.reduced, fit.linear
        low, high = used.ends[used.runs].T
        residual, total = fit.left_out(used.of_runs)
        usual_chi2 = float(np.median(mahalanobis(residual, total)[0]))
        tense = max(1.0, usual_chi2 / residual.shape[1])  # as if the steps' scale were too small by the usual run
        by_chain = student_log_density(residual, tense * total)[0]
        back = se3.inverse(turned(linear.poses[high]))
        ahead = chain.exp((chain.adjoint(back) @ residual[..., None])[..., 0])
        others = replace(
            chain,
            loop_edge=np.full(len(low), -1),
            ends=used.ends[used.runs],
            motion=chain.between(poses[low], poses[high]) @ ahead,
            covariance=chain.carried(back, tense * (total - fit.runs)),
        )
        none = np.zeros(len(low))
        return cls(PairwiseConsistency(linearise(others, poses), by_chain, none, none > 0), usual)

    def score(self, at: Ints) -> Floats:
        """Nats (K,) by which a usual step to these positions is likelier than the measured one; ∞ outside all runs."""
        ends = self.pairwise.chain.ends
        run = np.minimum(np.searchsorted(ends[:, 1], at), len(ends) - 1)
        low, high = ends[run].T
        inside, out = (low < at) & (at <= high), np.full(len(at), np.inf)
        at, run = at[inside], run[inside]
        gain = _log_with_usual_step(self.pairwise, self.usual, run, at) - self.pairwise.by_chain[run]
        out[inside] = gain + self.usual.unusual[at]
        return out

    def likeliest_break(self) -> Break:
        """The likeliest broken step: many loops on either side hide it from each other, not from the run between."""
        at = np.concatenate([np.arange(low + 1, high + 1) for low, high in self.pairwise.chain.ends.tolist()])
        score = self.score(at)
        run = int(np.searchsorted(self.pairwise.chain.ends[:, 1], at[np.argmax(score)]))
        return _break(self.pairwise, self.usual, run, at, score)

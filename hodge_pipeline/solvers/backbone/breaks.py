"""Candidate broken steps: an odometry edge that is off by far, where loops over it agree on another motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import FREEDOM, tail_weight
from hodge_pipeline.solvers.backbone.chain import Chain, loops_at_place
from hodge_pipeline.solvers.backbone.evidence import mahalanobis, student_log_density
from hodge_pipeline.solvers.backbone.fit import Fit
from hodge_pipeline.solvers.backbone.linear import Linear, cholesky, linearise, shifted, turned
from hodge_pipeline.types import Bools, Floats, Ints

NEIGHBOURS, SEEDS = 8, 16
"""Nearest loops that each loop is compared with, and seeds that are then compared with all: limits on cost."""
PLATEAU = 12.0
"""Nats below the best step at which a step is no candidate for the break."""
TAIL = 0.1
"""Share of the most unusual steps, to which the tail of the sizes is fitted (Hill 1975)."""
MOST_UNUSUAL = 3
"""Steps that are tried by their own size alone: a limit on cost."""
ROUNDS, LEAST = 10, 1e-6
"""Reweighting rounds of `StepModel`, and the share of each variance that is added to it."""


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


@dataclass(frozen=True)
class PairwiseConsistency:
    """Loops of a chain compared pair by pair, as pairwise consistency maximisation does (Mangelson et al. 2018).

    - `linear`: the bare chain, in which the paths between the loops' ends have their covariance.
    - `by_chain (M,)`: the log Bayes factor of each loop by the chain as it stands; `log_wrong (M,)`: the log-density of
      each residual if the loop is wrong; `used (M,)`: loops that agree with the chain.
    """

    linear: Linear
    by_chain: Floats
    log_wrong: Floats
    used: Bools

    @classmethod
    def of(cls, linear: Linear, log_wrong: Floats) -> PairwiseConsistency:
        """Loops none of which the chain explains, and none of which is used."""
        none = np.zeros(len(log_wrong))
        return cls(linear, none, log_wrong, none > 0)

    @property
    def chain(self) -> Chain:
        """The chain of the loops."""
        return self.linear.chain

    def factor(self, first: Ints, second: Ints) -> Floats:
        """Log Bayes factor (K,) of the loops `second` given that the loops `first` are right: by the paths between
        their lower ends and between their upper ends, whatever lies between lower and upper.
        """
        return np.asarray(student_log_density(*self.residuals(first, second))[0] - self.log_wrong[second])

    def residuals(self, first: Ints, second: Ints) -> tuple[Floats, Floats]:
        """Residuals (K, p) of loops `second`, and covariances (K, p, p), given that loops `first` are right."""
        chain, (c, d) = self.chain, self.chain.ends[second].T
        poses, covariance = self.predicted(first, c, d)
        residual = chain.log(chain.between(chain.motion[second], chain.between(self.linear.poses[c], poses)))
        return residual, covariance + chain.covariance[second]

    def predicted(self, loop: Ints, low: Ints, high: Ints) -> tuple[Floats, Floats]:
        """Poses (K, 4, 4) of positions `high`, reached from positions `low` through the loops, not along the chain; and
        the covariance (K, p, p) of the motion from `low`, in the axes of `high`.
        """
        chain, poses, total = self.chain, self.linear.poses, self.linear.covariance
        a, b = chain.ends[loop].T
        from_end = chain.between(poses[b], poses[high])
        end = chain.compose(chain.compose(poses[a], chain.motion[loop]), from_end)

        def local(frame: Floats, covariance: Floats) -> Floats:
            return chain.carried(se3.inverse(turned(frame)), shifted(covariance, chain.lever(frame[:, :3, 3])))

        before = local(end, total[np.maximum(a, low)] - total[np.minimum(a, low)])
        after = local(poses[high], total[np.maximum(b, high)] - total[np.minimum(b, high)])
        return end, before + after + chain.carried(se3.inverse(from_end), chain.covariance[loop])

    def seeds(self, among: Ints) -> Iterator[tuple[int, Floats]]:
        """Unused loops that contradict each other, those first with which most others near them agree, all of one place
        counting as one; and the log Bayes factor (K,) of each loop of `among (K,)` given that one.
        """
        left = ~self.used[among]
        support = np.full(len(among), -1.0)
        support[left] = self._support(among[left])
        for _ in range(SEEDS):
            if not left.any():
                return
            row = int(np.argmax(np.where(left, support, -1.0)))
            factor = self.factor(np.full(len(among), among[row]), among)
            left &= factor <= 0
            left[row] = False
            yield int(among[row]), factor

    def _support(self, rows: Ints) -> Floats:
        """Nats (K,) that the nearest loops of each of `rows (K,)` gain if it is right, of its own place as one."""
        if not len(rows):
            return np.zeros(0)
        near = cKDTree(self.chain.places[rows]).query(self.chain.places[rows], k=min(4 * NEIGHBOURS, len(rows)))[1]
        near = near.reshape(len(rows), -1)
        apart = np.abs(self.chain.places[rows[near]] - self.chain.places[rows][:, None]).max(axis=2) >= 1.0
        same = ~apart & (near != np.arange(len(rows))[:, None])
        support = np.zeros(len(rows))
        for kind in (apart, same):
            first, nth = np.nonzero(kind & (np.cumsum(kind, axis=1) <= NEIGHBOURS))
            second = rows[near[first, nth]]
            gain = np.maximum(np.logaddexp(self.factor(rows[first], second), 0.0) - self.by_chain[second], 0.0)
            share = 1.0 if kind is apart else 1 / np.bincount(first, minlength=len(rows))[first]
            support += np.bincount(first, share * gain, minlength=len(rows))
        return support

    def gains(self, seed: int, rows: Ints, factor: Floats) -> Floats:
        """Nats (K,) that the loops `rows (K,)` gain if `seed` is right, given their log Bayes factors (K,): each place
        counts once, the seed's own not at all. Used loops, which the chain explains, may only lose.
        """
        agrees = factor > 0
        share = (agrees.sum() + 0.5) / (len(rows) + 1)
        gain = np.logaddexp(np.log(share) + factor, np.log1p(-share)) - self.by_chain[rows]
        for alike in (agrees, ~agrees):
            if alike.any():
                gain[alike] /= loops_at_place(self.chain.places[rows[alike]])
        gain[np.abs(self.chain.places[rows] - self.chain.places[seed]).max(axis=1) < 1.0] = 0.0
        return np.asarray(np.where(self.used[rows], np.minimum(gain, 0.0), gain))


@dataclass(frozen=True)
class StepModel:
    """A mixture of the motions of a chain's steps.

    - `centres (K, 4, 4)`: of the kinds of steps, such as straight on and round a corner, the most frequent first;
      `shares (K,)` of the steps; one `covariance (p, p)`; `kind (n,)`: which steps are of any of them.
    - `unusual (n,)`: by how many nats each step is rarer, beside its nearest kind, than the rarest of as many should
      be.
    """

    centres: Floats
    shares: Floats
    covariance: Floats
    kind: Bools
    unusual: Floats

    @classmethod
    def of(cls, chain: Chain) -> StepModel:
        """Fitted to the steps with Student's t, which single steps hardly change, and to the tail of their χ².

        Each step counts with its mirror image, since turns to the right are as usual as those to the left.
        """
        rows = np.flatnonzero((chain.step_edge >= 0) & ~chain.bridged)
        twist = chain.log(chain.step[rows])
        twist = np.concatenate([twist, twist @ _mirrored(chain, twist)])
        centre = np.median(twist, axis=0)
        left = twist - centre
        covariance = _student_covariance(left)
        whiten = np.linalg.inv(cholesky(covariance[None])[0]).T
        centres, shares, of_one = _kinds(left, left @ whiten)
        chi2 = cKDTree(centres @ whiten).query(left @ whiten)[0] ** 2
        unusual = np.full(chain.size, -np.inf)
        unusual[rows] = _rarity(chi2[: len(rows)]) - np.log(len(rows))
        kind = np.zeros(chain.size, bool)
        kind[rows] = of_one[: len(rows)]
        return cls(chain.exp(centre + centres), shares, covariance, kind, unusual)

    def off(self, chain: Chain, motion: Floats) -> Floats:
        """Twists (K, M, p) from each kind's centre to motions (M, 4, 4)."""
        return chain.log(chain.between(self.centres[:, None], motion))


def _student_covariance(left: Floats) -> Floats:
    """The covariance (p, p) of residuals (M, p), with weights by Student's t."""
    weight = np.ones(len(left))
    for _ in range(ROUNDS):
        covariance = (left * weight[:, None]).T @ left / len(left)
        covariance += np.diag(LEAST * np.diag(covariance) + np.finfo(float).tiny ** 0.5)
        chi2 = mahalanobis(left, np.broadcast_to(covariance, (len(left), *covariance.shape)))[0]
        weight = tail_weight(chi2, left.shape[1])
    return covariance


def _rarity(chi2: Floats) -> Floats:
    """Minus the log-probability (M,) of a larger χ², by an exponential tail of the logarithms of these (Hill 1975)."""
    size = np.log(np.maximum(chi2, np.finfo(float).tiny)) / 2
    floor = np.quantile(size, 1 - TAIL)
    mean = float(np.mean(size[size > floor] - floor)) if (size > floor).any() else np.inf
    return np.asarray(np.maximum((size - floor) / mean + np.log(1 / TAIL), 0.0))


def _mirrored(chain: Chain, twist: Floats) -> Floats:
    """The rotation (p, p) of twists (M, p) by 180° about their median direction of travel."""
    ahead = np.zeros(6)
    ahead[chain.axes] = np.median(twist, axis=0)
    half = 2 * np.outer(ahead[3:], ahead[3:]) / max(float(ahead[3:] @ ahead[3:]), np.finfo(float).tiny) - np.eye(3)
    return np.asarray(np.kron(np.eye(2), half)[np.ix_(chain.axes, chain.axes)], float)


def _kinds(left: Floats, white: Floats) -> tuple[Floats, Floats, Bools]:
    """The centres (K, p) of kinds of steps, the share (K,) of each, and which steps (M,) are of one; `left (M, p)`:
    twists about their median, `white (M, p)`: the same whitened.
    """
    size, gate = left.shape[1], OF_ONE_KIND * left.shape[1]
    other = (white**2).sum(axis=1) > gate
    centres, counts = [np.zeros(size)], [max(float((~other).sum()), 1.0)]
    while other.sum() >= FEWEST_OF_KIND and len(centres) < MOST_KINDS:
        rows = np.flatnonzero(other)
        some = white[rows[:: -(-len(rows) // MOST_COMPARED)]]
        near = cKDTree(some).query_ball_point(some, np.sqrt(gate), return_length=True)
        alike = rows[((white[rows] - some[np.argmax(near)]) ** 2).sum(axis=1) <= gate]
        if len(alike) < FEWEST_OF_KIND:
            break
        centres.append(np.median(left[alike], axis=0))
        counts.append(float(len(alike)))
        other[alike] = False
    return np.stack(centres), np.array(counts) / len(left), ~other


OF_ONE_KIND, FEWEST_OF_KIND = 3.0, 3
"""Largest χ² per axis of a step of a kind, and fewest steps of a kind."""
MOST_KINDS, MOST_COMPARED = 8, 2000
"""Kinds, and steps compared with all others to find one: limits on cost."""


def agreed_breaks(pairwise: PairwiseConsistency, usual: StepModel) -> list[Break]:
    """The likeliest break by each seed of loops that agree, one with a usual step and one without; likeliest first."""
    chain = pairwise.chain
    rows = np.flatnonzero(chain.path[chain.ends[:, 0]] == chain.path[chain.ends[:, 1]])
    out = []
    for seed, factor in pairwise.seeds(rows):
        low, high = chain.ends[seed]
        at = np.arange(low + 1, high + 1)
        gain = pairwise.gains(seed, rows, factor)
        score = chain.over(chain.ends[rows], gain)[at]
        at, score = at[score > score.max() - PLATEAU], score[score > score.max() - PLATEAU]
        fits = _log_with_usual_step(pairwise, usual, np.full(len(at), seed), at) - pairwise.log_wrong[seed]
        score = score + np.maximum(fits, 0.0) - pairwise.by_chain[seed] + usual.unusual[at]
        fit = fits > 0
        if fit.any():
            out.append(_break(pairwise, usual, seed, at[fit], score[fit]))
        if not fit.all():
            far = _far_break(pairwise, seed, at[~fit], score[~fit])
            if chain.corridors_over(far.at, rows[(factor > 0) & (gain > 0)]) > 1:  # else no trial will show as many
                out.append(far)
    return sorted(out, key=lambda each: -each.log_evidence)


def _log_with_usual_step(pairwise: PairwiseConsistency, usual: StepModel, loop: Ints, at: Ints) -> Floats:
    """Log-density (K,) of `loop (K,)` if it is right and the step to position `at (K,)` is a usual one.

    Where the measured step is of some kind, only the most frequent kind may replace it: nothing says that the robot
    turned a corner there.
    """
    end, covariance = pairwise.predicted(loop, at - 1, at)
    off = usual.off(pairwise.chain, pairwise.chain.between(pairwise.linear.poses[at - 1], end))
    each = np.stack([student_log_density(one, covariance + usual.covariance)[0] for one in off])
    each[1:, usual.kind[at]] = -np.inf
    return np.asarray(np.logaddexp.reduce(np.log(usual.shares)[:, None] + each, axis=0))


def _break(pairwise: PairwiseConsistency, usual: StepModel, loop: int, at: Ints, score: Floats) -> Break:
    """The break at the position `at (K,)` of the highest score (K,), bridged by a usual step, with heavy tails, moved
    towards what the loop asks for.
    """
    row = int(np.argmax(score))
    one = at[row : row + 1]
    end, covariance = pairwise.predicted(np.array([loop]), one - 1, one)
    off = usual.off(pairwise.chain, pairwise.chain.between(pairwise.linear.poses[one - 1], end))[:, 0]
    whole = np.broadcast_to(covariance[0] + usual.covariance, (len(off), *covariance.shape[1:]))
    kind = int(np.argmax(np.log(usual.shares) + student_log_density(off, whole)[0]))
    chi2 = mahalanobis(off, whole)[0][kind]
    wide = usual.covariance * max(1.0, 1 / float(tail_weight(chi2, off.shape[1])))
    towards = wide @ np.linalg.solve(wide + covariance[0], off[kind])
    return Break(int(one[0]), usual.centres[kind] @ pairwise.chain.exp(towards), wide, float(score[row]))


def _far_break(pairwise: PairwiseConsistency, loop: int, at: Ints, score: Floats) -> Break:
    """The break at the position `at (K,)` of the highest score (K,), bridged as far as the loop asks for: the robot was
    carried on, or its odometry stood still.
    """
    row = int(np.argmax(score))
    one = at[row : row + 1]
    end, covariance = pairwise.predicted(np.array([loop]), one - 1, one)
    motion = se3.inverse(pairwise.linear.poses[one[0] - 1]) @ end[0]
    motion[:3, :3] = se3.project_to_so3(motion[:3, :3])
    return Break(int(one[0]), motion, LOOSE**2 * covariance[0], float(score[row]), usual=False)


LOOSE = 2.0
"""Factor from the standard deviations of the one loop that a bridge follows from to those of the bridge."""


def unusual_breaks(usual: StepModel) -> list[Break]:
    """Breaks at the most unusual steps, the most unusual first, whatever the loops say; `log_evidence` is `unusual`."""
    rows = np.argsort(-usual.unusual)
    return [Break(int(at), usual.centres[0], usual.covariance, float(usual.unusual[at])) for at in rows[:MOST_UNUSUAL]]


@dataclass(frozen=True)
class Runs:
    """Runs of steps between the ends of used loops, each tested against the solution without it.

    - `pairwise`: of a chain whose loops are the motions of the runs at poses solved without each.
    - `high (S,)`: later ends, ascending; `cost (S,)`: nats that the residual of each run costs.
    """

    pairwise: PairwiseConsistency
    usual: StepModel
    high: Ints
    cost: Floats

    @classmethod
    def of(cls, fit: Fit, poses: Floats, usual: StepModel) -> Runs:
        """The runs of a fit, at least one, with covariances scaled up to their median χ²; `poses (n, 4, 4)`: the bare
        chain's.
        """
        chain, used, linear = fit.linear.chain, fit.reduced, fit.linear
        low, high = used.ends[used.runs].T
        residual, total = fit.left_out(used.of_runs)
        chi2, size = student_log_density(residual, total)[1], residual.shape[1]
        tense = max(1.0, float(np.median(chi2)) / size)  # as if the steps' scale were too small by the usual run
        log_density, chi2 = student_log_density(residual, tense * total)
        back = se3.inverse(turned(linear.poses[high]))
        ahead = chain.exp((chain.adjoint(back) @ residual[..., None])[..., 0])
        others = replace(
            chain,
            loop_edge=np.full(len(low), -1),
            ends=used.ends[used.runs],
            motion=chain.compose(chain.between(poses[low], poses[high]), ahead),
            covariance=chain.carried(back, tense * (total - fit.runs)),
        )
        none = np.zeros(len(low))
        pairwise = PairwiseConsistency(linearise(others, poses), log_density, none, none > 0)
        return cls(pairwise, usual, high, 0.5 * (FREEDOM + size) * np.log1p(chi2 / FREEDOM))

    def score(self, at: Ints) -> Floats:
        """Nats (K,) by which a usual step to these positions is likelier than the measured one; ∞ outside all runs."""
        run = np.minimum(np.searchsorted(self.high, at), len(self.high) - 1)
        low, high = self.pairwise.chain.ends[run].T
        inside, out = (low < at) & (at <= high), np.full(len(at), np.inf)
        at, run = at[inside], run[inside]
        gain = _log_with_usual_step(self.pairwise, self.usual, run, at) - self.pairwise.by_chain[run]
        out[inside] = gain + self.usual.unusual[at]
        return out

    def likeliest_break(self) -> Break | None:
        """The likeliest broken step of runs whose residual costs more than `LEAST_COST`; None without such a run.

        Many loops on either side hide a break from each other, not from the run between them.
        """
        costly = np.flatnonzero(self.cost > LEAST_COST)
        if not len(costly):
            return None
        at = np.concatenate([np.arange(low + 1, high + 1) for low, high in self.pairwise.chain.ends[costly].tolist()])
        score = self.score(at)
        run = int(np.searchsorted(self.high, at[np.argmax(score)]))
        return _break(self.pairwise, self.usual, run, at, score)


LEAST_COST = 4.0
"""Nats that the residual of a run must cost before its steps are tested: a limit on time."""

"""Where a chain may be broken: one step is off, and the loops over it agree on where it should have led."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.complex.judging import FREEDOM, tail_weight
from hodge_pipeline.solvers.backbone.chain import Chain, loops_at_place
from hodge_pipeline.solvers.backbone.evidence import squares, student
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, linearise, root, shifted
from hodge_pipeline.types import Bools, Floats, Ints

NEIGHBOURS, SEEDS = 8, 16
"""Loops that each is compared with first, and those that are then compared with all: a limit on cost."""
PLATEAU = 12.0
"""Nats: a step at which the loops' evidence is lower by more is not where the chain is broken."""
TAIL = 0.1
"""Share of the most unusual steps, whose sizes tell how often one is larger still (Hill 1975)."""
MOST_UNUSUAL = 3
"""Steps that are tried by their own size alone: a limit on cost."""
ROUNDS, LEAST = 10, 1e-6
"""Of the fit of usual steps; and the share of a variance that is added to it."""


@dataclass(frozen=True)
class Break:
    """The position `at` of a step that may be broken, its motion (4, 4) and covariance (p, p) in its place, and the
    log-evidence of loops from several places; `usual`: whether the motion is as steps usually are.
    """

    at: int
    motion: Floats
    covariance: Floats
    log_evidence: float
    usual: bool = True


@dataclass(frozen=True)
class Testimony:
    """Loops of a chain held against each other: `explained (M,)`, the log-density of each as the chain is, and `away
    (M,)` if it is wrong, of which the first is a factor; those `used (M,)` agree with the chain.
    """

    chain: Chain
    linear: Linear
    explained: Floats
    away: Floats
    used: Bools

    @classmethod
    def of(cls, linear: Linear, away: Floats) -> Testimony:
        """Of loops that nothing explains and none of which is used."""
        none = np.zeros(len(away))
        return cls(linear.chain, linear, none, away, none > 0)

    def factor(self, first: Ints, second: Ints) -> Floats:
        """Log Bayes factor (K,) of the loops `second` if the loops `first` are right: by the paths between their lower
        ends and between their upper ends, whatever lies between lower and upper.
        """
        return np.asarray(student(*self.against(first, second))[0] - self.away[second])

    def against(self, first: Ints, second: Ints) -> tuple[Floats, Floats]:
        """The residuals (K, p), and their covariances (K, p, p), of loops `second` where loops `first` are right."""
        chain, (c, d) = self.chain, self.chain.ends[second].T
        away, covariance = self.beyond(first, c, d)
        residual = chain.log(chain.between(chain.motion[second], chain.between(self.linear.poses[c], away)))
        return residual, covariance + chain.covariance[second]

    def beyond(self, loop: Ints, low: Ints, high: Ints) -> tuple[Floats, Floats]:
        """Where these loops take the poses (K, 4, 4) of positions `high`, and the covariance (K, p, p), in the axes
        there, of the motion to them from positions `low`.
        """
        chain, poses, total = self.chain, self.linear.poses, self.linear.covariance
        a, b = chain.ends[loop].T
        from_end = chain.between(poses[b], poses[high])
        end = chain.compose(chain.compose(poses[a], chain.motion[loop]), from_end)

        def local(frame: Floats, covariance: Floats) -> Floats:
            turned = se3.from_parts(frame[:, :3, :3], np.zeros(3))
            return chain.carried(se3.inverse(turned), shifted(covariance, chain.lever(frame[:, :3, 3])))

        before = local(end, total[np.maximum(a, low)] - total[np.minimum(a, low)])
        after = local(poses[high], total[np.maximum(b, high)] - total[np.minimum(b, high)])
        return end, before + after + chain.carried(se3.inverse(from_end), chain.covariance[loop])

    def seeds(self, among: Ints) -> Iterator[tuple[int, Floats]]:
        """Unused loops with which others near them agree most, those of their own place together as one: each differs
        from the others; and the factor (K,) with each of all `among` which they are.
        """
        left = ~self.used[among]
        rows = among[left]
        if not len(rows):
            return
        near = cKDTree(self.chain.places[rows]).query(self.chain.places[rows], k=min(4 * NEIGHBOURS, len(rows)))[1]
        near = near.reshape(len(rows), -1)
        apart = np.abs(self.chain.places[rows[near]] - self.chain.places[rows][:, None]).max(axis=2) >= 1.0
        same = ~apart & (near != np.arange(len(rows))[:, None])
        potential = np.zeros(len(rows))
        for kind in (apart, same):
            first, nth = np.nonzero(kind & (np.cumsum(kind, axis=1) <= NEIGHBOURS))
            second = rows[near[first, nth]]
            gain = np.maximum(np.logaddexp(self.factor(rows[first], second), 0.0) - self.explained[second], 0.0)
            share = 1.0 if kind is apart else 1 / np.bincount(first, minlength=len(rows))[first]
            potential += np.bincount(first, share * gain, minlength=len(rows))
        of_all = np.full(len(among), -1.0)
        of_all[left] = potential
        for _ in range(SEEDS):
            if not left.any():
                return
            row = int(np.argmax(np.where(left, of_all, -1.0)))
            factor = self.factor(np.full(len(among), among[row]), among)
            left &= factor <= 0
            left[row] = False
            yield int(among[row]), factor

    def gains(self, seed: int, rows: Ints, factor: Floats) -> Floats:
        """What each of these loops (K,), with this `factor`, gains if `seed` is right: a place counts once, and that of
        the seed not. Used loops, which the chain explains, may only lose.
        """
        agrees = factor > 0
        share = (agrees.sum() + 0.5) / (len(rows) + 1)
        gain = np.logaddexp(np.log(share) + factor, np.log1p(-share)) - self.explained[rows]
        for alike in (agrees, ~agrees):
            if alike.any():
                gain[alike] /= loops_at_place(self.chain.places[rows[alike]])
        gain[np.abs(self.chain.places[rows] - self.chain.places[seed]).max(axis=1) < 1.0] = 0.0
        return np.asarray(np.where(self.used[rows], np.minimum(gain, 0.0), gain))


@dataclass(frozen=True)
class Usual:
    """How a chain's steps usually are: the `centres (K, 4, 4)` of their kinds, as ahead and round a corner, the most
    frequent first, with their `shares (K,)` and one `covariance (p, p)`, which steps are of a `kind (n,)`, and how many
    nats more `unusual (n,)` each is, beside its nearest kind, than the most unusual of as many should be.
    """

    centres: Floats
    shares: Floats
    covariance: Floats
    kind: Bools
    unusual: Floats

    @classmethod
    def of(cls, chain: Chain) -> Usual:
        """By Student's distribution, which single steps hardly change, and the tail of the steps' own sizes: each step
        stands for its mirror image too, since a turn to the right is no stranger than those to the left.
        """
        rows = np.flatnonzero((chain.step_edge >= 0) & ~chain.bridged)
        twist = chain.log(chain.step[rows])
        twist = np.concatenate([twist, twist @ _mirrored(chain, twist)])
        centre = np.median(twist, axis=0)
        left, weight = twist - centre, np.ones(len(twist))
        for _ in range(ROUNDS):
            covariance = (left * weight[:, None]).T @ left / len(left)
            covariance += np.diag(LEAST * np.diag(covariance) + np.finfo(float).tiny ** 0.5)
            chi2 = squares(left, np.broadcast_to(covariance, (len(left), *covariance.shape)))[0]
            weight = tail_weight(chi2, left.shape[1])
        whiten = np.linalg.inv(root(covariance[None])[0]).T
        centres, shares, of_one = _kinds(left, left @ whiten)
        chi2 = cKDTree(centres @ whiten).query(left @ whiten)[0] ** 2
        size = np.log(np.maximum(chi2[: len(rows)], np.finfo(float).tiny)) / 2
        floor = np.quantile(size, 1 - TAIL)
        mean = float(np.mean(size[size > floor] - floor)) if (size > floor).any() else np.inf
        unusual = np.full(chain.size, -np.inf)
        unusual[rows] = np.maximum((size - floor) / mean + np.log(1 / TAIL), 0.0) - np.log(len(rows))
        kind = np.zeros(chain.size, bool)
        kind[rows] = of_one[: len(rows)]
        return cls(chain.exp(centre + centres), shares, covariance, kind, unusual)

    def off(self, chain: Chain, motion: Floats) -> Floats:
        """How far motions (M, 4, 4) are from each kind (K, M, p)."""
        return chain.log(chain.between(self.centres[:, None], motion))


def _mirrored(chain: Chain, twist: Floats) -> Floats:
    """The symmetric (p, p) that turns twists (M, p) by 180° about the direction in which most of them move."""
    ahead = np.zeros(6)
    ahead[chain.axes] = np.median(twist, axis=0)
    half = 2 * np.outer(ahead[3:], ahead[3:]) / max(float(ahead[3:] @ ahead[3:]), np.finfo(float).tiny) - np.eye(3)
    return np.asarray(np.kron(np.eye(2), half)[np.ix_(chain.axes, chain.axes)], float)


def _kinds(left: Floats, white: Floats) -> tuple[Floats, Floats, Bools]:
    """The centres (K, p) of kinds of steps, the share of the steps that are of each, and which steps are of one."""
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
"""χ² to an axis up to which steps are of one kind, and steps that a kind has at the least."""
MOST_KINDS, MOST_COMPARED = 8, 2000
"""Limits on cost."""


def agreed_breaks(told: Testimony, usual: Usual) -> list[Break]:
    """The likeliest breaks that each of the loops that others agree with asks for, where a usual step explains it and
    where none does, the likeliest first.
    """
    chain = told.chain
    rows = np.flatnonzero(chain.path[chain.ends[:, 0]] == chain.path[chain.ends[:, 1]])
    out = []
    for seed, factor in told.seeds(rows):
        low, high = chain.ends[seed]
        at = np.arange(low + 1, high + 1)
        gain = told.gains(seed, rows, factor)
        score = chain.over(chain.ends[rows], gain)[at]
        at, score = at[score > score.max() - PLATEAU], score[score > score.max() - PLATEAU]
        fits = _fits(told, usual, np.full(len(at), seed), at) - told.away[seed]
        score = score + np.maximum(fits, 0.0) - told.explained[seed] + usual.unusual[at]
        fit = fits > 0
        if fit.any():
            out.append(_break(told, usual, seed, at[fit], score[fit]))
        if not fit.all():
            far = _far_break(told, seed, at[~fit], score[~fit])
            if chain.corridors_over(far.at, rows[(factor > 0) & (gain > 0)]) > 1:  # else no trial will show as many
                out.append(far)
    return sorted(out, key=lambda each: -each.log_evidence)


def _fits(told: Testimony, usual: Usual, loop: Ints, at: Ints) -> Floats:
    """Log-density (K,) of these loops if they are right and the step at a position a usual one; of the most frequent
    kind where what is measured is of a kind itself: nothing says that it turned a corner there.
    """
    end, covariance = told.beyond(loop, at - 1, at)
    off = usual.off(told.chain, told.chain.between(told.linear.poses[at - 1], end))
    each = np.stack([student(one, covariance + usual.covariance)[0] for one in off])
    each[1:, usual.kind[at]] = -np.inf
    return np.asarray(np.logaddexp.reduce(np.log(usual.shares)[:, None] + each, axis=0))


def _break(told: Testimony, usual: Usual, loop: int, at: Ints, score: Floats) -> Break:
    """The break at the position of the highest score (K,): a step as usual steps are, with heavy tails, moved towards
    what the loop asks for.
    """
    row = int(np.argmax(score))
    one = at[row : row + 1]
    end, covariance = told.beyond(np.array([loop]), one - 1, one)
    off = usual.off(told.chain, told.chain.between(told.linear.poses[one - 1], end))[:, 0]
    whole = np.broadcast_to(covariance[0] + usual.covariance, (len(off), *covariance.shape[1:]))
    kind = int(np.argmax(np.log(usual.shares) + student(off, whole)[0]))
    chi2 = squares(off, whole)[0][kind]
    wide = usual.covariance * max(1.0, 1 / float(tail_weight(chi2, off.shape[1])))
    towards = wide @ np.linalg.solve(wide + covariance[0], off[kind])
    return Break(int(one[0]), usual.centres[kind] @ told.chain.exp(towards), wide, float(score[row]))


def _far_break(told: Testimony, loop: int, at: Ints, score: Floats) -> Break:
    """The break at the position of the highest score (K,): a motion as far as the loop asks for, as of a robot that was
    carried, or that took itself to stand still.
    """
    row = int(np.argmax(score))
    one = at[row : row + 1]
    end, covariance = told.beyond(np.array([loop]), one - 1, one)
    motion = se3.inverse(told.linear.poses[one[0] - 1]) @ end[0]
    motion[:3, :3] = se3.project_to_so3(motion[:3, :3])
    return Break(int(one[0]), motion, LOOSE**2 * covariance[0], float(score[row]), usual=False)


LOOSE = 2.0
"""Of the standard deviations of the one loop that says how a bridge leads, those of the bridge."""


def unusual_breaks(usual: Usual) -> list[Break]:
    """Breaks at steps, the most unusual first, as if nothing but how steps are were known of them; `log_evidence` is by
    how many nats one is.
    """
    rows = np.argsort(-usual.unusual)
    return [Break(int(at), usual.centres[0], usual.covariance, float(usual.unusual[at])) for at in rows[:MOST_UNUSUAL]]


@dataclass(frozen=True)
class Runs:
    """The runs between used loops, each held against all else: `told` has the motion of each at poses solved without
    it, in place of loops; `high (S,)` are their later ends, ascending, `strain (S,)` nats that the error of each costs.
    """

    told: Testimony
    usual: Usual
    high: Ints
    strain: Floats

    @classmethod
    def of(cls, fit: Fit, poses: Floats, usual: Usual) -> Runs:
        """Those of a fit, one at least, with errors as large as the usual run has; `poses (n, 4, 4)`: the bare ones."""
        chain, used, linear = fit.linear.chain, fit.reduced, fit.linear
        low, high = used.ends[used.runs].T
        residual, total = fit.left_out(used.of_runs)
        chi2, size = student(residual, total)[1], residual.shape[1]
        tense = max(1.0, float(np.median(chi2)) / size)  # as if the steps' scale were too small by the usual run
        log_density, chi2 = student(residual, tense * total)
        turned = se3.from_parts(linear.poses[high, :3, :3], np.zeros(3))
        ahead = chain.exp((chain.adjoint(se3.inverse(turned)) @ residual[..., None])[..., 0])
        others = replace(
            chain,
            loop_edge=np.full(len(low), -1),
            ends=used.ends[used.runs],
            motion=chain.compose(chain.between(poses[low], poses[high]), ahead),
            covariance=chain.carried(se3.inverse(turned), tense * (total - fit.runs)),
        )
        told = Testimony(others, linearise(others, poses), log_density, np.zeros(len(low)), np.zeros(len(low), bool))
        return cls(told, usual, high, 0.5 * (FREEDOM + size) * np.log1p(chi2 / FREEDOM))

    def score(self, at: Ints) -> Floats:
        """The nats (K,) by which a usual step at these positions is likelier than the step that is there; infinite
        where no run leads over one, so that nothing speaks for it.
        """
        run = np.minimum(np.searchsorted(self.high, at), len(self.high) - 1)
        low, high = self.told.chain.ends[run].T
        inside, out = (low < at) & (at <= high), np.full(len(at), np.inf)
        at, run = at[inside], run[inside]
        out[inside] = _fits(self.told, self.usual, run, at) - self.told.explained[run] + self.usual.unusual[at]
        return out

    def strained_break(self) -> Break | None:
        """The likeliest broken step, None where no run is strained. Loops hide a break where they are many: each agrees
        with those beside it, and the run gives way.
        """
        strained = np.flatnonzero(self.strain > STRAIN)
        if not len(strained):
            return None
        at = np.concatenate([np.arange(low + 1, high + 1) for low, high in self.told.chain.ends[strained].tolist()])
        score = self.score(at)
        run = int(np.searchsorted(self.high, at[np.argmax(score)]))
        return _break(self.told, self.usual, run, at, score)


STRAIN = 4.0
"""Nats that the error of a run must have cost, for its steps to be held against it: a limit on cost."""

"""Which loops of a trusted chain are right: Bayes factors at the poses that the other loops lead to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.solvers.backbone.chain import Chain, loops_at_place, one_of_each_place
from hodge_pipeline.solvers.backbone.evidence import EVEN, Wrong, mixture
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, Reduced, from_rotations, linearise, settled, thinned
from hodge_pipeline.solvers.backbone.judge import Judged, judge
from hodge_pipeline.solvers.backbone.places import MOST_STEPS, MOST_TRIED, Places
from hodge_pipeline.solvers.backbone.polish import polished
from hodge_pipeline.solvers.backbone.scales import Scales, learn_scales
from hodge_pipeline.types import Bools, Floats

ROUNDS = 6
"""In which loops are found that agree with the poses they lead to: a limit on cost."""


@dataclass(frozen=True)
class Inferred:
    """The result: loops that are `used (M,)`, how all were judged, and the scales of errors that were learned.

    - `start`: the bare chain with those scales; `linear`: at the poses under which the loops were judged; `reduced`:
      the network of the used loops, or of as many as `thinned` leaves.
    - `log_evidence`: of the loops as judged, against all being wrong. `confirmed`: whether they say more than chance;
      if not, none should be used: see `refused`.
    """

    used: Bools
    judged: Judged
    scales: Scales
    start: Linear
    linear: Linear
    reduced: Reduced
    log_evidence: float
    confirmed: bool

    @cached_property
    def polished(self) -> tuple[Linear, Floats]:
        """The chain at the poses of the used loops, and factors (M,) on the loops' standard deviations for the last
        solve.
        """
        return polished(self.reduced, self.linear)


def infer(chain: Chain, wrong: Wrong, always: Bools, thin: bool, scales: Scales | None = None) -> Inferred | None:
    """Judge the loops of a chain; those of `always (M,)` count whatever they say. Where they would leave more than
    `MOST_UNKNOWNS`, all are judged at the poses of some of the right ones, or None comes back without `thin`.

    `scales`: of the errors; learned from the loops where none are given.
    """
    poses = chain.poses
    scales, shares = learn_scales(chain, wrong) if scales is None else (scales, EVEN)
    chain = scales.applied(chain)
    start = linearise(chain, poses)
    trial = _Trial(start, judge(start, None, shares, wrong), shares, wrong, always, thin, scales)
    try:
        return trial.inferred()
    except np.linalg.LinAlgError:  # loops tear paths so far apart that rounding hides what is known of their ends
        reduced = thinned(chain, np.flatnonzero(always))
        return Inferred(always, trial.alone, scales, start, start, reduced, 0.0, confirmed=False)


@dataclass(frozen=True)
class _Trial:
    """The loops of a chain, each judged `alone` at its bare poses with the shares of right and wrong ones; for the rest
    see `infer`.
    """

    start: Linear
    alone: Judged
    shares: Floats
    wrong: Wrong
    always: Bools
    thin: bool
    scales: Scales

    def inferred(self) -> Inferred | None:
        """The loops judged at the poses that the right ones among them lead to; None without `thin` where these are too
        many.
        """
        grown = self.grown()
        if grown is None:
            return None
        used, shares, linear = grown
        start, chain, always = self.start, self.start.chain, self.always
        fold = int(chain.broken.sum()) * float(np.log(chain.size))  # any other step might have been the one
        enough = MISTAKEN + (self.scales.surprise() if chain.stated else 0.0) + fold
        for _ in range(REARRANGED):
            found = self.agreed(used | always, shares, linear)
            if found is None:
                return None
            agreed, judged, linear = found
            before, used, confirmed = used, agreed, False
            if not agreed.any() or (judged.factor[agreed] - np.log(agreed.sum())).sum() <= by_chance(int(agreed.sum())):
                break
            places = Places.of(start, self.alone, agreed, self.wrong)
            best, confirmed = places.best(linear, enough)
            confirmed = confirmed and places.chance(best.right) + fold < -BY_CHANCE
            used = np.append(best.right, False)[places.members]
            if (used == before).all() or not confirmed:
                break
            linear = best.fit.linear
        used |= always
        reduced = thinned(chain, np.flatnonzero(used))
        # wrong loops may have led into a valley that the right ones do not leave
        fit = min((settled(Fit(reduced, begun), MOST_STEPS) for begun in (linear, start)), key=lambda each: each.cost)
        judged = judge(fit.linear, fit, shares, self.wrong)
        shares, top = mixture(judged.factor)
        used &= (judged.log_odds > 0) | always
        if np.log(shares[0] / shares[1]) < MISTAKEN:
            used &= ~_lone(chain, used) | always
        linear, reduced = fit.linear if used.any() else start, thinned(chain, np.flatnonzero(used))
        return Inferred(used, judged, self.scales, start, linear, reduced, top, confirmed)

    @cached_property
    def testimony(self) -> Floats:
        """The share (M,) that each loop has in what its place says."""
        return 1 / loops_at_place(self.start.chain.places)

    def grown(self) -> tuple[Bools, Floats, Linear] | None:
        """The loops (M,) that say much by themselves and those that they speak for, the strongest first; the shares of
        right and wrong ones; and poses. Where no more loops stand out, that place of a few is added with which all are
        likeliest, while this makes them likelier.

        Loops that little speaks for may be wrong in one way together, and bend the poses until right ones do not fit.
        """
        always, ends = self.always, self.start.chain.places
        limit = 0.5 * np.log(max(len(always), 1))
        used = (self.alone.factor > 2 * limit) | always
        found = self.tried(used, self.start, self.shares)
        for number in range(MOST_GROWN):
            if found is None:
                return None
            likelihood, speaks, shares, linear = found
            before, used = used, (speaks > limit) | (used & (speaks > 0)) | always
            if not number or used.sum() > before.sum():
                found = self.tried(used, linear, shares)
                continue
            open_ = np.where(used, 0.0, speaks)
            open_[cKDTree(ends[used]).query(ends, p=np.inf)[0] <= 1.0] = 0.0
            more = list[Bools]()
            while len(more) < MOST_TRIED and open_.max(initial=0.0) > 0:
                place = np.abs(ends - ends[np.argmax(open_)]).max(axis=1) < 1.0
                more.append(used | (place & (open_ > 0)))
                open_[place] = 0.0
            each = [(one, other) for one in more if (other := self.tried(one, linear, shares)) is not None]
            best = max(each, key=lambda pair: pair[1][0], default=(used, found))
            if best[1][0] <= likelihood:
                break
            used, found = best
        return used, shares, linear

    def tried(self, used: Bools, linear: Linear, shares: Floats) -> tuple[float, Floats, Floats, Linear] | None:
        """How likely all loops are at the poses that one of each place of those `used (M,)` leads to, as a place is one
        testimony; what speaks for each (M,), the less of its odds and its factor; the shares of right and wrong ones;
        and these poses.
        """
        rows, ends = np.flatnonzero(used), self.start.chain.places
        rows = rows[one_of_each_place(ends[rows])] if len(rows) else rows
        reduced = thinned(self.start.chain, rows)
        if not self.thin and len(reduced.active) < len(rows):
            return None
        fit = settled(Fit(reduced, linear), MOST_STEPS)
        judged = judge(fit.linear, fit, shares, self.wrong)
        shares, _ = mixture(judged.factor)
        each = np.logaddexp(np.log(shares[0]) + judged.factor, np.log(shares[1]))
        return float(self.testimony @ each), np.minimum(judged.factor, judged.log_odds), shares, fit.linear

    def agreed(self, used: Bools, shares: Floats, linear: Linear) -> tuple[Bools, Judged, Linear] | None:
        """The loops (M,) that agree with the poses that they lead to, from those that are `used (M,)` on; how all were
        judged there; and these.
        """
        start, chain = self.start, self.start.chain
        best, top, seen = (self.alone, start), -np.inf, b""
        for number in range(ROUNDS):
            rows = np.flatnonzero(used)
            reduced = thinned(chain, rows)
            if not self.thin and len(reduced.active) < len(rows):
                return None
            fit = settled(Fit(reduced, linear), MOST_STEPS)
            if not number and fit.cost > len(reduced.active) * len(chain.axes):
                # more than right loops should leave: the descent may have ended in a valley beside
                other = settled(Fit(reduced, from_rotations(Fit(reduced, start), MOST_STEPS)), MOST_STEPS)
                fit = min(fit, other, key=lambda each: each.cost)
            linear = fit.linear
            judged = judge(linear, fit, shares, self.wrong)
            shares, likelihood = mixture(judged.factor)
            if likelihood > top:
                best, top = (judged, linear), likelihood
            used = (judged.log_odds > 0) & (judged.factor > 0) | self.always
            if np.packbits(used).tobytes() == seen:
                break
            seen = np.packbits(used).tobytes()
        judged, linear = best
        return (judged.factor > _limit(judged)) & (judged.log_odds > 0), judged, linear


def _lone(chain: Chain, used: Bools) -> Bools:
    """Which used loops (M,) are all that joins two paths: what they say of these nothing tests."""
    lone, part = np.zeros_like(used), np.cumsum(chain.step_edge < 0) - 1
    rows = np.flatnonzero(used & np.not_equal(*part[chain.ends].T))
    lone[rows] = series_classes(part[chain.ends[rows]], int(part[-1]) + 1) < 0
    return lone


REARRANGED = 3
"""Times that the loops are judged, at first and after places were left out or added: a limit on cost."""
MOST_GROWN = 30
"""Rounds in which loops are added: a limit on cost."""


def refused(found: Inferred, always: Bools) -> Inferred:
    """The result without the loops that nothing confirms: at the poses of the bare chain and of those of `always`."""
    reduced = thinned(found.start.chain, np.flatnonzero(always))
    return replace(found, used=always.copy(), linear=found.start, reduced=reduced)


BY_CHANCE, BY_CHANCE_EACH_FOLD = float(np.log(100.0)), 3.0
"""Log-evidence that chance reaches in one graph of a hundred, and what each e-fold of loops adds to it: measured with
random loops in simulated graphs and in those of Bicocca and RobotCar, whose best reach half of it.
"""


def _limit(judged: Judged) -> float:
    """The log Bayes factor that one wrong loop is expected to reach by chance, of as many as are likely to be wrong."""
    return float(np.log(max(expit(-judged.log_odds).sum(), 1)))


MISTAKEN = float(np.log(20.0))
"""The log-odds of right places against mistaken ones that are enough, where steps err as stated; where it takes larger
errors for places to be right, mistaken ones may have said so: see `Scales.surprise`.
"""


def by_chance(count: int) -> float:
    """The log-evidence that chance may reach among so many loops."""
    return BY_CHANCE + BY_CHANCE_EACH_FOLD * float(np.log(max(count, 1)))

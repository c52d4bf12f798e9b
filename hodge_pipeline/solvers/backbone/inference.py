"""Which loops of a trusted chain are right, by Bayes factors at the poses that the other loops lead to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import expit

from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE, EVEN, OutlierModel, mixture
from hodge_pipeline.solvers.backbone.fit import Fit, Reduced, from_rotations, optimised, thinned
from hodge_pipeline.solvers.backbone.judge import Judged, densities, judge
from hodge_pipeline.solvers.backbone.levels import MOST_TRIED
from hodge_pipeline.solvers.backbone.linear import Linear, linearise
from hodge_pipeline.solvers.backbone.loop_places import one_of_each_place
from hodge_pipeline.solvers.backbone.mistakes import Mistake, mistakes
from hodge_pipeline.solvers.backbone.pairwise import likely_together
from hodge_pipeline.solvers.backbone.places import MISTAKEN, Places, likeliest_place
from hodge_pipeline.solvers.backbone.polish import polished
from hodge_pipeline.solvers.backbone.scales import Scales, learned_scales
from hodge_pipeline.types import Bools, Floats, Ints

ROUNDS = 6
"""Rounds of `_Trial.agreed`: a limit on cost."""
REFUSED = 0.05
"""Share of the loops that stand out on the bare chain that may be refused in the end before other ways to add them are
tried: a limit on cost. Chance makes single wrong ones stand out, 9 of RobotCar's 262; of 72 walks with mistaken loops
the answer changes for the better where 8 % or more are refused.
"""


@dataclass(frozen=True)
class Inferred:
    """The loops of a chain that are `used (M,)`, how all were judged, and the learned scales of errors.

    - `start`: the bare chain with those scales; `linear`: at the poses at which the loops were judged; `reduced`: the
      graph of the used loops, or of those that `thinned` leaves.
    - `log_evidence`: of the loops, against all being wrong; `confirmed`: whether it exceeds that of chance. If not,
      none should be used: see `refused`. `of_places`: the log-odds that all places that were found right are, each of
      them counting once.
    """

    used: Bools
    judged: Judged
    scales: Scales
    start: Linear
    linear: Linear
    reduced: Reduced
    log_evidence: float
    confirmed: bool
    of_places: float

    @property
    def rank(self) -> tuple[bool, float]:
        """By which the best of several answers is chosen."""
        return self.confirmed, self.of_places

    def mistakes(self) -> Iterator[Mistake]:
        """Groups of unused loops that are mistaken in one way: see `mistakes`."""
        return mistakes(self.linear, self.judged.log_wrong, self.used)

    @cached_property
    def of_mistakes(self) -> float:
        """By how many nats unused loops are likelier for these mistakes."""
        return sum(each.nats for each in self.mistakes())

    @cached_property
    def polished(self) -> tuple[Linear, Floats]:
        """The chain at the final poses, and factors (M,) on the loops' standard deviations: see `polished`."""
        return polished(self.reduced, self.linear)


@dataclass(frozen=True)
class LoopJudge:
    """What judges the loops of a graph on one chain after another.

    - `outliers`: of the first chain, for all, which makes their evidence comparable; `trusted (M,)`: loops that are
      used in any case.
    - `may_thin`: where the right loops leave more than `MOST_UNKNOWNS`, all are judged at the poses of some of them;
      without it nothing is inferred then.
    """

    outliers: OutlierModel
    trusted: Bools
    may_thin: bool

    def select(self, rows: Ints) -> LoopJudge:
        """What judges the loops `rows (K,)` alone."""
        return replace(self, trusted=self.trusted[rows])

    def infer(self, chain: Chain, scales: Scales | None = None) -> Inferred | None:
        """The loops of a chain, judged; None where they may not be thinned and are too many.

        `scales`: of the errors; by default those learned from the loops by which their places are likelier, and learned
        anew at the poses that they lead to where the drift of a long path had hidden how loops err: where scales there
        differ much, other loops agree by them, and the places are likelier.
        """
        found = self.best(chain, learned_scales(chain, self.outliers) if scales is None else [(scales, EVEN)])
        if scales is None and found is not None and not found.confirmed:
            found = self._by_likeliest_place(chain, found)
        for _ in range(MOST_TRIED if scales is None else 0):
            if found is None or not found.confirmed:
                break
            here = found.scales.at_solution(Fit(found.reduced, found.linear))
            if not found.scales.differ_much(here) or not self._others_agree(found, here.applied(chain)):
                break
            other = _Trial.of(chain, self, here, EVEN).found()
            if other is None or other.rank <= found.rank:
                break
            found = other
        return found

    def _by_likeliest_place(self, chain: Chain, found: Inferred) -> Inferred:
        """The loops judged at the poses that those of one place lead to, or as `found` where that is likelier: each may
        say less than some of many wrong ones reach by chance, but wrong ones seldom agree.
        """
        trial = _Trial.of(chain, self, found.scales, EVEN)
        place = likeliest_place(trial.start, trial.alone)
        other = trial.found(place) if place.any() else None
        return found if other is None or other.rank <= found.rank else other

    def best(self, chain: Chain, learned: Iterable[tuple[Scales, Floats]]) -> Inferred | None:
        """The loops judged by the best of these scales, each with shares (2,) of right and wrong ones."""
        found: Inferred | None = None
        for given in learned:
            other = _Trial.of(chain, self, *given).found()
            if other is None:
                return None
            found = other if found is None or other.rank > found.rank else found
        return found

    def refused_alike(self, chain: Chain, scales: Scales) -> tuple[Linear, Mistake | None]:
        """The poses that the loops lead to which agree by errors of these scales, and a mistake that others share."""
        trial = _Trial.of(chain, self, scales, EVEN)
        used, rated = trial.grown(trial.standing_out, trial.start, EVEN)
        log_wrong = densities(rated.linear, np.arange(len(used)), self.outliers)[1]
        return rated.linear, next(mistakes(rated.linear, log_wrong, used), None)

    def without(self, found: Inferred, chain: Chain, out: Bools) -> Inferred:
        """The result without the loops `out (M,)`, whose motions are those of `chain`; trusted ones stay."""
        trial = _Trial.of(chain, self, found.scales, EVEN)
        linear = replace(found.linear, chain=trial.start.chain)
        return trial.final(found.used & ~out | self.trusted, EVEN, linear, found.confirmed, found.of_places)

    def refused(self, found: Inferred) -> Inferred:
        """The result without unconfirmed loops: at the poses of the bare chain, and of the trusted loops."""
        reduced = thinned(found.start.chain, np.flatnonzero(self.trusted))
        return replace(found, used=self.trusted.copy(), linear=found.start, reduced=reduced, confirmed=False)

    def _others_agree(self, found: Inferred, chain: Chain) -> bool:
        """Whether by other errors, those of `chain`, other loops than the used ones agree with the poses found."""
        linear = replace(found.linear, chain=chain)
        judged = judge(linear, Fit(found.reduced, linear), EVEN, self.outliers)
        return bool(((_agreeing(judged) | self.trusted) != found.used).any())


class _TooManyLoops(Exception):
    """The right loops leave more than `MOST_UNKNOWNS`."""


@dataclass(frozen=True)
class _Rated:
    """All loops at some poses: the `score (M,)` of each, the lesser of its log-odds and its log Bayes factor; the
    shares (2,) of right and wrong ones; and the chain there.
    """

    judged: Judged
    shares: Floats
    linear: Linear

    @property
    def score(self) -> Floats:
        return np.minimum(self.judged.factor, self.judged.log_odds)


@dataclass(frozen=True)
class _Trial:
    """The inputs of `infer`: the bare chain, its loops judged `alone`, prior shares (2,) of right and wrong ones, and
    what `by` judges them.
    """

    start: Linear
    alone: Judged
    shares: Floats
    by: LoopJudge
    scales: Scales

    @classmethod
    def of(cls, chain: Chain, by: LoopJudge, scales: Scales, shares: Floats) -> _Trial:
        """The trial of a chain whose errors have these scales."""
        chain = scales.applied(chain)
        start = linearise(chain, chain.poses)
        return cls(start, judge(start, None, shares, by.outliers), shares, by, scales)

    def found(self, place: Bools | None = None) -> Inferred | None:
        """What is `inferred`, or where the loops of one place (M,) lead to, or that nothing is used where nothing can
        be computed; None as in `infer`.
        """
        try:
            if place is None:
                return self.inferred()
            return self.settled(*self.grown(place | self.by.trusted, self.start, self.shares))
        except _TooManyLoops:
            return None
        except np.linalg.LinAlgError:  # loops tear paths so far apart that covariances are lost in rounding
            reduced = thinned(self.start.chain, np.flatnonzero(self.by.trusted))
            return Inferred(
                self.by.trusted, self.alone, self.scales, self.start, self.start, reduced, 0.0, False, -np.inf
            )

    def inferred(self) -> Inferred:
        """The loops judged at the poses of the right ones. Where many that stand out on the bare chain are not used in
        the end, these are grown by halves too, and the places decide that are likelier together: evidence of single
        loops counts a mistake as often as it is repeated.
        """
        out = self.standing_out
        at_once = self.grown(out, self.start, self.shares)
        found = self.settled(*at_once)
        if (out & ~found.used).sum() <= REFUSED * out.sum():
            return found
        by_halves = self.halves_grown(np.flatnonzero(out))
        if (by_halves[0] == at_once[0] & out).all():
            return found
        return max(found, self.settled(*self.grown(*by_halves)), key=lambda each: each.rank)

    @property
    def standing_out(self) -> Bools:
        """Loops (M,) that the bare chain alone makes likely, and the trusted ones."""
        return np.asarray(self.alone.factor > np.log(max(len(self.by.trusted), 1))) | self.by.trusted

    def halves_grown(self, rows: Ints) -> tuple[Bools, Linear, Floats]:
        """Which of the loops `rows (K,)` are used (M,) where in each round the stronger half of those that stand out is
        added; the poses and shares that these lead to.
        """
        chain = self.start.chain
        start = replace(self.start, chain=chain.with_loops(rows, chain.ends[rows]))
        some = replace(self, start=start, alone=self.alone.select(rows), by=self.by.select(rows))
        begin = _stronger_half(some.alone.factor, np.ones(len(rows), bool)) | some.by.trusted
        some_used, rated = some.grown(begin, some.start, self.shares, _stronger_half)
        used = np.zeros_like(self.by.trusted)
        used[rows] = some_used
        return used, replace(rated.linear, chain=chain), rated.shares

    def settled(self, used: Bools, rated: _Rated) -> Inferred:
        """The loops that agree from these on (M,), of places that are right together."""
        shares, linear = rated.shares, rated.linear
        start, chain, trusted = self.start, self.start.chain, self.by.trusted
        fold = int(chain.broken.sum()) * float(np.log(chain.size))  # for the choice of the broken steps among all
        for _ in range(MOST_TRIED):
            agreed, judged, linear = self.agreed(used | trusted, shares, linear)
            before, used, confirmed, of_places = used, agreed, False, -np.inf
            if not agreed.any() or (judged.factor[agreed] - np.log(agreed.sum())).sum() <= by_chance(int(agreed.sum())):
                break
            places = Places.of(start, self.alone, agreed, self.by.outliers)
            best = places.best(linear)
            of_places = best.of_all - fold
            confirmed = of_places > MISTAKEN and places.chance(best.right) + fold < -BY_CHANCE
            used = np.append(best.right, False)[places.members]
            if (used == before).all() or not confirmed:
                break
            linear = best.fit.linear
        return self.final(used | trusted, shares, linear, confirmed, of_places)

    def final(self, used: Bools, shares: Floats, linear: Linear, confirmed: bool, of_places: float) -> Inferred:
        """All loops judged at the poses of the used ones (M,), of which those that remain likely are used."""
        start, chain, trusted = self.start, self.start.chain, self.by.trusted
        reduced = thinned(chain, np.flatnonzero(used))
        fit = optimised(Fit(reduced, linear))
        judged = judge(fit.linear, fit, shares, self.by.outliers)
        shares, top = mixture(judged.factor)
        used = used & ((judged.log_odds > 0) | trusted)
        if np.log(shares[0] / shares[1]) < MISTAKEN:
            used &= ~_single_joins(chain, used) | trusted
        linear, reduced = fit.linear if used.any() else start, thinned(chain, np.flatnonzero(used))
        confirmed = confirmed and bool(used.any())
        return Inferred(used, judged, self.scales, start, linear, reduced, top, confirmed, of_places)

    def grown(
        self,
        used: Bools,
        linear: Linear,
        shares: Floats,
        chosen: Callable[[Floats, Bools], Bools] = lambda score, among: among,
    ) -> tuple[Bools, _Rated]:
        """Loops (M,), and all loops at their poses, from those `used (M,)` on: in rounds those are added that stand out
        at the new poses, or are `chosen` among these by their score (M,); where none is left, those `likely_together`.

        Weak loops may be wrong in one way together and, taken all at once, bend the poses until right ones do not fit:
        wrong ones over many steps stand out until strong ones have told where these lead. By halves, a mistaken place
        among the strongest may be followed, which the others would outvote.
        """
        limit = 0.5 * np.log(max(len(self.by.trusted), 1))
        rated, together = self.rated(used, linear, shares), np.zeros_like(used)
        for number in range(MOST_GROWN):
            before, kept = used, (used & (rated.score > 0)) | self.by.trusted
            used = kept | chosen(rated.score, (rated.score > limit) & ~kept)
            if number and used.sum() <= before.sum():
                together = likely_together(rated.linear, rated.judged, ~used & ~together)
                if not together.any():
                    break
                used = used | together
                far = from_rotations(Fit(self.reduced(np.flatnonzero(used)), self.start))
                rated = replace(rated, linear=far)
            rated = self.rated(used, rated.linear, rated.shares)
        return used, rated

    def rated(self, used: Bools, linear: Linear, shares: Floats) -> _Rated:
        """All loops at the poses of one used loop (M,) of each place, optimised from `linear`."""
        rows, ends = np.flatnonzero(used), self.start.chain.places
        rows = rows[one_of_each_place(ends[rows])] if len(rows) else rows
        fit = optimised(Fit(self.reduced(rows), linear))
        judged = judge(fit.linear, fit, shares, self.by.outliers)
        shares, _ = mixture(judged.factor)
        return _Rated(judged, shares, fit.linear)

    def reduced(self, rows: Ints) -> Reduced:
        """The graph of these loops, of all where it may not be thinned."""
        reduced = thinned(self.start.chain, rows)
        if not self.by.may_thin and len(reduced.active) < len(rows):
            raise _TooManyLoops
        return reduced

    def agreed(self, used: Bools, shares: Floats, linear: Linear) -> tuple[Bools, Judged, Linear]:
        """Loops (M,) that agree with the poses that they lead to, iterated from those `used (M,)` on; how all are
        judged at the likeliest poses on the way; and these.
        """
        start, chain = self.start, self.start.chain
        best, top, seen = (self.alone, start), -np.inf, b""
        for number in range(ROUNDS):
            reduced = self.reduced(np.flatnonzero(used))
            fit = optimised(Fit(reduced, linear))
            if not number and fit.cost > len(reduced.active) * len(chain.axes):
                # more than right loops should leave: the descent may have ended in a local minimum
                other = optimised(Fit(reduced, from_rotations(Fit(reduced, start))))
                fit = min(fit, other, key=lambda each: each.cost)
            linear = fit.linear
            judged = judge(linear, fit, shares, self.by.outliers)
            shares, likelihood = mixture(judged.factor)
            if likelihood < top - BY_CHANCE:  # wrong loops bend the poses, more in each round
                break
            if likelihood > top:
                best, top = (judged, linear), likelihood
            used = (judged.log_odds > 0) & (judged.factor > 0) | self.by.trusted
            if np.packbits(used).tobytes() == seen:
                break
            seen = np.packbits(used).tobytes()
        judged, linear = best
        return _agreeing(judged), judged, linear


def _stronger_half(score: Floats, among: Bools) -> Bools:
    """Of the loops `among (M,)` those whose score (M,) is at least their median."""
    return among & (score >= np.median(score[among])) if among.any() else among


def _single_joins(chain: Chain, used: Bools) -> Bools:
    """Which used loops (M,) alone join two paths, so that nothing tests them."""
    lone, path = np.zeros_like(used), np.cumsum(chain.step_edge < 0) - 1
    rows = np.flatnonzero(used & np.not_equal(*path[chain.ends].T))
    lone[rows] = series_classes(path[chain.ends[rows]], int(path[-1]) + 1) < 0
    return lone


MOST_GROWN = 30
"""Rounds in which loops are added: a limit on cost."""
BY_CHANCE_EACH_FOLD = 3.0
"""Increase of the log-evidence that chance reaches with each e-fold of loops, measured with random loops in simulated
graphs and in those of Bicocca and RobotCar, whose best reach half of it.
"""


def _agreeing(judged: Judged) -> Bools:
    """The loops (M,) that are likely right, by more than one of the wrong ones may reach."""
    return (judged.factor > _limit(judged)) & (judged.log_odds > 0)


def _limit(judged: Judged) -> float:
    """The log Bayes factor that one of the wrong loops is expected to reach by chance: log of their expected number."""
    return float(np.log(max(expit(-judged.log_odds).sum(), 1)))


def by_chance(count: int) -> float:
    """The log-evidence that chance may reach among so many loops."""
    return BY_CHANCE + BY_CHANCE_EACH_FOLD * float(np.log(max(count, 1)))

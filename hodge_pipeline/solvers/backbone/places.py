"""Which places of a chain are right, and which are mistaken for others (perceptual aliasing).

Loops of one place agree also where it is mistaken: they count once. Mistaken places bend the poses of all used loops
until they fit, so that places are judged together: by the probability density of one loop of each in one Gauss–Newton
solution, whose χ² counts how far the steps bend.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaln, pdtrc

from hodge_pipeline.solvers.backbone.evidence import EVEN, OutlierModel, log_student, student_log_density
from hodge_pipeline.solvers.backbone.fit import Fit, optimised, thinned
from hodge_pipeline.solvers.backbone.judge import Judged, by_path, judge
from hodge_pipeline.solvers.backbone.levels import MOST_TRIED, RANDOM
from hodge_pipeline.solvers.backbone.linear import Linear
from hodge_pipeline.solvers.backbone.loop_places import corridors, loops_at_place, one_of_each_place
from hodge_pipeline.solvers.backbone.pairwise import PairwiseConsistency
from hodge_pipeline.solvers.backbone.scales import decoys
from hodge_pipeline.types import Bools, Floats, Ints

ALIKE = 0.75
"""Share of a place's loops that another used place must have to be its rival; an unused one needs as many loops."""
MISTAKEN_PLACES = 0.2
"""Expected number of mistaken places to a right one, beside the rivals that are not used. With more, a path that closes
once would stay open: its loops can show little more than that the drift is as stated.
"""
MISTAKEN = float(np.log(20.0))
"""Log-odds of right places against mistaken ones that are enough, and that a change must gain."""
FEW_ALIKE = 0.1
"""Share of the loops that must be unused and agree in groups of more than `PAIRED`, so that places do look alike, for
the places of a corridor to count once; else each counts. Unused loops that agree with no other say nothing of
corridors: counted too, a few random loops kept 9 of 180 short rings at their odometry.
"""
PAIRED = 2
"""Loops of one place that agree by chance at the most: three among thousands are rare."""
MOST_PAIRS = 200_000
"""Pairs of loops that are compared: a limit on memory and time. All of 6000 at a few places took 2 GB and 22 CPU s."""


@dataclass(frozen=True)
class Arrangement:
    """Places assumed right (K,), the fit with one loop of each, and the log-odds of this assumption.

    - `of_all`: the log-odds that all are right, against as many mistaken ones. n of N places can be mistaken in about
      N^n / n! ways, of which `log_odds` count N^n, to compare changes of one place.
    """

    right: Bools
    fit: Fit
    log_odds: float
    of_all: float


@dataclass(frozen=True)
class Places:
    """Places that the loops of a chain join; adjacent ones are one, up to the length of a corridor.

    - `start`: the bare chain. `loop (K,)`: one loop of each place, ascending; `bare (K,)`: its log Bayes factor on the
      bare chain; `size (K,)`: how many loops agree there.
    - `members (M,)`: the place of each used loop; −1 elsewhere. `unused (G,)`: sizes of the groups of unused loops.
    """

    start: Linear
    outliers: OutlierModel
    loop: Ints
    bare: Floats
    size: Floats
    members: Ints
    unused: Ints

    @classmethod
    def of(cls, start: Linear, alone: Judged, used: Bools, outliers: OutlierModel) -> Places:
        """Places of the used loops (M,)."""
        ends, rows = start.chain.places, np.flatnonzero(used)
        place = rows[one_of_each_place(ends[rows])]
        distance, nearest = cKDTree(ends[place]).query(ends, p=np.inf)
        loops = loops_at_place(ends[rows])[np.searchsorted(rows, place)]
        groups = agreeing_groups(PairwiseConsistency.of(start, alone.log_wrong), np.flatnonzero(distance > 1.0))
        run = np.arange(len(place))
        if sum(len(group) for group in groups if len(group) > PAIRED) > FEW_ALIKE * len(used):
            run = corridors(ends[place])
        by_size = np.lexsort((-loops, run))
        first = by_size[np.unique(run[by_size], return_index=True)[1]]
        order = np.argsort(place[first])
        loop = place[first][order]
        return cls(
            start,
            outliers,
            loop=loop,
            bare=alone.factor[loop],
            size=loops[first][order],
            members=np.where(used, np.argsort(order)[run[nearest]], -1),
            unused=np.array([len(group) for group in groups], np.int64),
        )

    def rivals(self, right: Bools) -> Floats:
        """The logarithm (K,) of the expected number of mistaken places with as many loops as each has."""
        sizes = np.sort(np.concatenate([self.unused, self.size[~right] / ALIKE]))
        return np.asarray(np.log(len(sizes) - np.searchsorted(sizes, self.size) + MISTAKEN_PLACES))

    def chance(self, right: Bools) -> float:
        """The log-probability that places joined at random have Bayes factors as large as the `right (K,)` ones: of as
        many of the strongest as is least probable, times the number of these choices. −∞ where more than `PAIRED` loops
        agree at one place: mistakes of that kind are among the rivals.
        """
        if self.size[right].max() > PAIRED:
            return -np.inf
        others = factors_by_chance(self.start, self.outliers)
        strongest = np.flatnonzero(right)[np.argsort(-self.bare[right], kind="stable")]
        stronger = len(others) - np.searchsorted(np.sort(others), self.bare[strongest]) + 0.5
        sizes = np.sort(np.concatenate([self.size, self.unused]))
        as_large = len(sizes) - np.searchsorted(sizes, np.minimum.accumulate(self.size[strongest]))
        tail = pdtrc(np.arange(len(strongest)), as_large * stronger / len(others))  # Poisson
        return float(np.log(max(tail.min(), np.finfo(float).tiny)) + np.log(len(strongest)))

    def arranged(self, right: Bools, linear: Linear) -> Arrangement:
        """The arrangement of these places (K,), optimised from the poses of `linear`."""
        fit = optimised(Fit(thinned(self.start.chain, self.loop[right]), linear))
        active = np.searchsorted(self.loop, fit.reduced.active)
        # without rivals MISTAKEN_PLACES counts once, not for each place
        prior = max(len(active) - 1, 0) * float(np.log(MISTAKEN_PLACES)) - float(self.rivals(right)[active].sum())
        n = len(active) - np.searchsorted(np.sort(self.size[active]), self.size[active])  # that have as many loops
        log_odds = self._density(fit) + prior
        return Arrangement(right, fit, log_odds, log_odds + float((gammaln(n + 1) / n).sum()))

    def _density(self, fit: Fit) -> float:
        """The log-density of all active loops, against all being wrong: one Student's t for all, since all errors may
        be larger than assumed by a common factor.
        """
        count = fit.reduced.active.size * len(self.start.chain.axes)
        return float(log_student(fit.cost, count) - 0.5 * fit.log_det - self._log_wrong(fit).sum())

    def _log_wrong(self, fit: Fit) -> Floats:
        """The log-density (L,) of each active loop if it is wrong."""
        rows = fit.reduced.active
        return self.outliers.at(self.start.chain, rows, fit.loops[0]).log_density(by_path(self.start, rows))

    def best(self, linear: Linear) -> Arrangement:
        """The likeliest arrangement, from all places, whose poses are near `linear`, by leaving out single ones while
        the log-odds rise.
        """
        found = self.arranged(np.ones(len(self.loop), bool), linear)
        changes = self._changes(found)
        while changes:
            tried = self.arranged(changes.pop(0), found.fit.linear)
            if tried.log_odds > found.log_odds + MISTAKEN:
                found, changes = tried, self._changes(tried)
        return found

    def _changes(self, found: Arrangement) -> list[Bools]:
        """Arrangements (K,) that may be likelier: without one place that the others contradict, the largest χ² first.
        None where not all places are active, since others would be then.
        """
        if found.right.sum() < 2 or len(found.fit.reduced.active) < found.right.sum():
            return []
        active = np.searchsorted(self.loop, found.fit.reduced.active)
        residual, covariance = found.fit.left_out(found.fit.reduced.of_loops)
        log_density, chi2 = student_log_density(residual, covariance)
        log_odds = log_density - self._log_wrong(found.fit) - self.rivals(found.right)[active]
        bent = np.argsort(-chi2, kind="stable")
        doubtful = active[bent[(log_odds + np.log(MISTAKEN_PLACES))[bent] < 0][:MOST_TRIED]]
        return [found.right & (np.arange(len(self.loop)) != place) for place in doubtful]


def likeliest_place(start: Linear, alone: Judged) -> Bools:
    """The loops (M,) of one place, more than `PAIRED` that agree, which is likeliest by the bare chain where other
    groups of at least as many are its rivals.
    """
    groups = agreeing_groups(PairwiseConsistency.of(start, alone.log_wrong), np.arange(len(alone.factor)))
    sizes = np.sort([len(each) for each in groups])
    best, place = 0.0, np.zeros(0, np.int64)
    for each in groups:
        rivals = len(sizes) - np.searchsorted(sizes, len(each)) - 1 + MISTAKEN_PLACES
        log_odds = float(np.median(alone.factor[each]) - np.log(rivals))
        if len(each) > PAIRED and log_odds > best:
            best, place = log_odds, each
    return np.isin(np.arange(len(alone.factor)), place)


def factors_by_chance(linear: Linear, outliers: OutlierModel) -> Floats:
    """Log Bayes factors (K,) that the motions of loops have between random places of a chain, along its path."""
    chain = linear.chain
    loop, ends = decoys(chain, -(-RANDOM // len(chain.ends)))
    return judge(replace(linear, chain=chain.with_loops(loop, ends)), None, EVEN, outliers).factor


def agreeing_groups(pairwise: PairwiseConsistency, rows: Ints) -> list[Ints]:
    """Groups of loops `rows (K,)`, the largest first: of one place each, all of which agree with its first one.

    Where there are more than `MOST_PAIRS` to compare, all loops of a place are one group.
    """
    if not len(rows):
        return []
    ends = pairwise.chain.places[rows]
    tree = cKDTree(ends)
    if loops_at_place(ends).sum() > MOST_PAIRS:
        place = one_of_each_place(ends)
        return sorted((rows[tree.query_ball_point(ends[at], 1.0, p=np.inf)] for at in place), key=len, reverse=True)
    first, second = tree.query_pairs(1.0, p=np.inf, output_type="ndarray").T
    pairs = np.stack([first, second], axis=1)[pairwise.factor(rows[first], rows[second]) > 0]
    both = np.concatenate([np.repeat(np.arange(len(rows)), 2).reshape(-1, 2), pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    near = np.split(both[:, 1], np.cumsum(np.bincount(both[:, 0], minlength=len(rows)))[:-1])
    free, out = np.ones(len(rows), bool), []
    for row in np.argsort([-len(each) for each in near], kind="stable").tolist():
        if free[row]:
            out.append(rows[near[row]])
            free[near[row]] = False
    return out

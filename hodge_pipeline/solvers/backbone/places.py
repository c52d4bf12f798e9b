"""Which places of a chain are what their loops say, and which are mistaken for others.

Loops of one place agree also where it is mistaken: they are one testimony. Loops are judged by the poses that all used
ones lead to, and mistaken places bend these until they fit, so that places are judged together: by the probability
density of one loop of each in one Gauss–Newton solution, whose χ² counts how far the steps bend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import pdtrc

from hodge_pipeline.solvers.backbone.breaks import Testimony
from hodge_pipeline.solvers.backbone.chain import corridors, loops_at_place, one_of_each_place
from hodge_pipeline.solvers.backbone.evidence import EVEN, Wrong, log_student, student
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, linearise, settled, thinned
from hodge_pipeline.solvers.backbone.judge import Judged, by_path, judge
from hodge_pipeline.solvers.backbone.scales import decoys
from hodge_pipeline.types import Bools, Floats, Ints

MOST_STEPS = 15
"""Of Gauss–Newton: a limit on cost."""
ALIKE = 0.75
"""Of a place's loops: a used place of as many that contradicts it is its rival, as is an unused one of all as many."""
MISTAKEN_PLACES = 0.2
"""To each right one, of places that loops agree on, beside the rivals that are not used. With more
a path that closes once would stay open: its loops can say little more than that the drift is as stated.
"""
ROUNDS = 6
"""In which places that agree with the strongest are found: a limit on cost."""
MOST_TRIED = 3
"""Places that are left out, or added, on trial each time, and groups of loops that may be added: limits on cost."""
CLEARLY = float(np.log(20.0))
"""Log-odds that a change must win."""
FEW_UNUSED = 0.1
"""Of the loops: with fewer, mistaken corridors are not reckoned with, and each place counts. Looked at on a walk all of
whose loops are right, and on graphs of which four fifths or half are wrong, not between.
"""
PAIRED = 2
"""Loops that random ones agree with at one place: three among thousands are rare."""
CHANCES = 4000
"""Loops between other places, at least, that say how often chance favours one so much."""
MOST_PAIRS = 200_000
"""Of loops that are compared: a limit on memory and time. All of 6000 at a few places took 2 GB and 22 CPU s."""


@dataclass(frozen=True)
class Arrangement:
    """Places taken for right (K,), the fit of one loop of each, and the log-odds that they are."""

    right: Bools
    fit: Fit
    log_odds: float


@dataclass(frozen=True)
class Places:
    """Places that the loops of a chain join; those that follow each other are one, as long as a corridor may be.

    - `start`: the bare chain. `loop (K,)`: one loop of each place, ascending; `bare (K,)`: the log Bayes factor of each
      by itself; `size (K,)`: how many loops agree there; `used (K,)`: of used loops, not of unused ones that agree.
    - `members (M,)`: the place of each used loop, and of the others in those groups; −1 elsewhere.
    - `unused (G,)`: the sizes of all other groups of unused loops.
    """

    start: Linear
    wrong: Wrong
    loop: Ints
    bare: Floats
    size: Floats
    used: Bools
    members: Ints
    unused: Ints

    @classmethod
    def of(cls, start: Linear, alone: Judged, used: Bools, wrong: Wrong) -> Places:
        """Those of the used loops (M,), and of unused ones that agree the groups as large as is usual."""
        ends, rows = start.chain.places, np.flatnonzero(used)
        place = rows[one_of_each_place(ends[rows])]
        distance, nearest = cKDTree(ends[place]).query(ends, p=np.inf)
        loops = loops_at_place(ends[rows])[np.searchsorted(rows, place)]
        run = np.arange(len(place))
        if len(used) - len(rows) > FEW_UNUSED * len(used):
            run = corridors(ends[place])
        by_size = np.lexsort((-loops, run))
        first = by_size[np.unique(run[by_size], return_index=True)[1]]
        groups = agreeing_groups(Testimony.of(start, alone.wrong), np.flatnonzero(distance > 1.0))
        usual = np.median(loops[first])
        may_be_added = np.array([len(group) >= usual and alone.factor[group[0]] > 0 for group in groups], bool)
        may_be_added[MOST_TRIED:] = False
        added = [groups[each] for each in np.flatnonzero(may_be_added)]
        members = np.where(used, run[nearest], -1)
        for number, group in enumerate(added, start=len(first)):
            members[group] = number
        loop = np.concatenate([place[first], *[group[:1] for group in added]]).astype(np.int64)
        size = np.concatenate([loops[first], [len(group) for group in added]])
        order = np.argsort(loop)
        return cls(
            start,
            wrong,
            loop=loop[order],
            bare=alone.factor[loop[order]],
            size=size[order],
            used=order < len(first),
            members=np.append(np.argsort(order), -1)[members],
            unused=np.array([len(group) for group in groups], np.int64)[~may_be_added],
        )

    def rivals(self, right: Bools) -> Floats:
        """The logarithm (K,) of how many mistaken places of as many loops there are to each."""
        others = np.where(self.used, self.size / ALIKE, self.size)[~right]
        sizes = np.sort(np.concatenate([self.unused, others]))
        return np.asarray(np.log(len(sizes) - np.searchsorted(sizes, self.size) + MISTAKEN_PLACES))

    def chance(self, right: Bools) -> float:
        """The logarithm of how probable it is that of all places as large, joined at random, as many as these (K,) say
        as much by themselves: of the k of them that say most, for the k that is least probable. Impossible where more
        than `PAIRED` loops agree at one: what these are mistaken for is among the rivals.
        """
        if self.size[right].max() > PAIRED:
            return -np.inf
        chain = self.start.chain
        loop, ends = decoys(chain, -(-CHANCES // len(chain.ends)))
        others = judge(linearise(chain.with_loops(loop, ends), self.start.poses), None, EVEN, self.wrong).factor
        strongest = np.flatnonzero(right)[np.argsort(-self.bare[right], kind="stable")]
        stronger = len(others) - np.searchsorted(np.sort(others), self.bare[strongest]) + 0.5
        sizes = np.sort(np.concatenate([self.size, self.unused]))
        as_large = len(sizes) - np.searchsorted(sizes, np.minimum.accumulate(self.size[strongest]))
        tail = pdtrc(np.arange(len(strongest)), as_large * stronger / len(others))  # of Poisson's distribution
        return float(np.log(max(tail.min(), np.finfo(float).tiny)) + np.log(len(strongest)))

    def arranged(self, right: Bools, linear: Linear) -> Arrangement:
        """These places (K,) taken for right, at the poses that are reached from some others."""
        fit = settled(Fit(thinned(self.start.chain, self.loop[right]), linear), MOST_STEPS)
        active = np.searchsorted(self.loop, fit.reduced.active)
        # of what is expected beforehand, that of one counts
        prior = max(len(active) - 1, 0) * float(np.log(MISTAKEN_PLACES)) - float(self.rivals(right)[active].sum())
        return Arrangement(right, fit, self._density(fit) + prior)

    def _density(self, fit: Fit) -> float:
        """The log-density of the active loops together, against all of them being wrong: of all in one Student's
        distribution, since all errors may be larger than they are thought to be by one factor.
        """
        count = fit.reduced.active.size * len(self.start.chain.axes)
        return float(log_student(fit.cost, count) - 0.5 * fit.log_det - self._away(fit).sum())

    def _away(self, fit: Fit) -> Floats:
        """The log-density (L,) of each active loop if it is wrong."""
        rows = fit.reduced.active
        return self.wrong.at(self.start.chain, rows, fit.loops[0]).log_density(by_path(self.start, rows))

    def best(self, linear: Linear, enough: float) -> tuple[Arrangement, bool]:
        """The likeliest arrangement, from that of all used places on, whose poses are near `linear`, and whether its
        log-odds are `enough`; where they are not, that from the place on which says most by itself.
        """
        found = self._improved(self.arranged(self.used, linear))
        if found.log_odds <= enough:
            other = self._improved(self.arranged(self._agreeing_with_strongest(enough), self.start))
            found = max(found, other, key=lambda each: each.log_odds)
        return found, found.log_odds > enough

    def _agreeing_with_strongest(self, enough: float) -> Bools:
        """The place (K,) that says most by itself, and those that agree with it and each other."""
        by_itself = np.where(self.used, self.bare - self.rivals(self.used), -np.inf)
        right = strongest = np.arange(len(self.loop)) == np.argmax(by_itself)
        for _ in range(ROUNDS):
            fit = settled(Fit(thinned(self.start.chain, self.loop[right]), self.start), MOST_STEPS)
            factor = judge(fit.linear, fit, EVEN, self.wrong).factor[self.loop] - self.rivals(right)
            before, right = right, (self.used & (factor > enough)) | strongest
            if (before == right).all():
                break
        return np.asarray(right)

    def _improved(self, found: Arrangement) -> Arrangement:
        """The arrangement after places that bend it are left out and others added, while the log-odds rise."""
        changes = self._changes(found)
        while changes:
            tried = self.arranged(changes.pop(0), found.fit.linear)
            if tried.log_odds > found.log_odds + CLEARLY:
                found, changes = tried, self._changes(tried)
        return found

    def _changes(self, found: Arrangement) -> list[Bools]:
        """Arrangements (K,) that differ in one place and may be likelier: without one that is likelier mistaken by all
        others, those that bend most first; with one more. None where there are more places than are solved together,
        since other ones would be then.
        """
        each, out = np.arange(len(self.loop)), list[Bools]()
        if len(found.fit.reduced.active) < found.right.sum():
            return out
        if found.right.sum() > 1:
            active = np.searchsorted(self.loop, found.fit.reduced.active)
            residual, covariance = found.fit.left_out(found.fit.reduced.of_loops)
            log_density, chi2 = student(residual, covariance)
            worth = log_density - self._away(found.fit) - self.rivals(found.right)[active] + np.log(MISTAKEN_PLACES)
            bent = np.argsort(-chi2, kind="stable")
            out = [found.right & (each != place) for place in active[bent[worth[bent] < 0][:MOST_TRIED]]]
        return out + [found.right | (each == place) for place in np.flatnonzero(~self.used & ~found.right)]


def agreeing_groups(told: Testimony, rows: Ints) -> list[Ints]:
    """Groups of these loops (K,), the largest first: each of one place, that agree with its first one as the steps
    between their ends go. Where loops of a place contradict each other, few of them are one testimony. All those of a
    place where there are too many to compare.
    """
    if not len(rows):
        return []
    ends = told.chain.places[rows]
    tree = cKDTree(ends)
    if loops_at_place(ends).sum() > MOST_PAIRS:
        place = one_of_each_place(ends)
        return sorted((rows[tree.query_ball_point(ends[at], 1.0, p=np.inf)] for at in place), key=len, reverse=True)
    first, second = tree.query_pairs(1.0, p=np.inf, output_type="ndarray").T
    pairs = np.stack([first, second], axis=1)[told.factor(rows[first], rows[second]) > 0]
    both = np.concatenate([np.repeat(np.arange(len(rows)), 2).reshape(-1, 2), pairs, pairs[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    near = np.split(both[:, 1], np.cumsum(np.bincount(both[:, 0], minlength=len(rows)))[:-1])
    free, out = np.ones(len(rows), bool), []
    for row in np.argsort([-len(each) for each in near], kind="stable").tolist():
        if free[row]:
            out.append(rows[near[row]])
            free[near[row]] = False
    return out

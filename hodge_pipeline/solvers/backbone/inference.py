"""Which loops of a trusted chain are right: Bayes factors at the poses that the other loops lead to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hodge_pipeline.solvers.backbone.breaks import Testimony
from hodge_pipeline.solvers.backbone.chain import Chain, one_of_each_place
from hodge_pipeline.solvers.backbone.evidence import EVEN, Wrong, mixture
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, Reduced, from_rotations, linearise, settled, thinned
from hodge_pipeline.solvers.backbone.judge import Judged, judge
from hodge_pipeline.solvers.backbone.places import MOST_STEPS, Places, agreeing_groups
from hodge_pipeline.solvers.backbone.polish import polished
from hodge_pipeline.solvers.backbone.scales import Scales, learn_scales
from hodge_pipeline.solvers.resistance import Network, effective_resistance
from hodge_pipeline.types import Bools, Floats

ROUNDS = 6


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


def infer(
    chain: Chain, wrong: Wrong, always: Bools, thin: bool = True, scales: Scales | None = None, *, anew: bool = False
) -> Inferred | None:
    """Judge the loops of a chain; those of `always (M,)` count whatever they say. Where they would leave more than
    `MOST_UNKNOWNS`, all are judged at the poses of some of the right ones, or None comes back without `thin`.

    `scales`: of the errors; learned from the loops where none are given. `anew`: where nothing confirms them, judged
    again from the places of most loops on.
    """
    poses = chain.poses
    scales, shares = learn_scales(chain, wrong) if scales is None else (scales, EVEN)
    chain = scales.applied(chain)
    start = linearise(chain, poses)
    alone = judge(start, None, shares, wrong)

    def inferred(used: Bools) -> Inferred | None:
        try:
            return _inferred(start, alone, used, shares=shares, wrong=wrong, always=always, thin=thin, scales=scales)
        except np.linalg.LinAlgError:  # loops tear paths so far apart that rounding hides what is known of their ends
            rows = np.flatnonzero(always)
            return Inferred(always, alone, scales, start, start, thinned(chain, rows), 0.0, confirmed=False)

    found = inferred(alone.factor > np.log(max(len(always), 1)))
    if found is None or found.confirmed or not anew:
        return found
    # a lone wrong loop that chance favours may have refuted the others
    others = [inferred(place) for place in crowded(start, alone)]
    return max([found, *filter(None, others)], key=lambda each: (each.confirmed, each.log_evidence))


def crowded(start: Linear, alone: Judged) -> list[Bools]:
    """The loops (M,) of each of the `MOST_PLACES` largest groups, of two at least, that a factor > 0 speaks for."""
    rows = np.flatnonzero(alone.factor > 0)
    groups = [
        group
        for group in agreeing_groups(Testimony.of(start, alone.log_density[1]), rows)[:MOST_PLACES]
        if len(group) > 1
    ]
    return [np.isin(np.arange(len(alone.factor)), group) for group in groups]


MOST_PLACES = 3
"""That are tried, each for as long as the first judgement takes."""


def _inferred(
    start: Linear,
    alone: Judged,
    used: Bools,
    *,
    shares: Floats,
    wrong: Wrong,
    always: Bools,
    thin: bool,
    scales: Scales,
) -> Inferred | None:
    """The loops judged, at first at the poses that those which are `used (M,)` lead to."""
    chain, linear, number = start.chain, start, 0
    broken = int(chain.broken.sum())  # any other step might have been the one
    fold = broken * float(np.log(chain.size))
    enough = MISTAKEN + (scales.surprise() if chain.stated else 0.0) + fold
    for _ in range(REARRANGED):
        found = _agreed(start, linear, alone, used | always, shares, wrong, always, thin, number)
        if found is None:
            return None
        agreed, judged, linear, top = found
        used, confirmed = agreed, False
        if not agreed.any() or (judged.factor[agreed] - np.log(agreed.sum())).sum() <= by_chance(int(agreed.sum())):
            break
        places = Places.of(start, alone, agreed, wrong)
        best, confirmed = places.best(linear, enough)
        confirmed = confirmed and places.chance(best.right) + fold < -BY_CHANCE
        used = np.append(best.right, False)[places.members]
        if (used == agreed).all() or not confirmed:
            break
        linear, number = best.fit.linear, SETTLING
    used |= always
    reduced = thinned(chain, np.flatnonzero(used))
    # wrong loops may have led into a valley that the right ones do not leave
    fit = min((settled(Fit(reduced, begun), MOST_STEPS) for begun in (linear, start)), key=_cost)
    judged = judge(fit.linear, fit, shares, wrong)
    shares, likelihood = mixture(judged.log_density)
    top = likelihood - float(judged.log_density[1].sum())
    used &= (judged.log_odds > 0) | always
    if np.log(shares[0] / shares[1]) < MISTAKEN:
        used &= ~_lone(chain, used) | always
    linear, reduced = fit.linear if used.any() else start, thinned(chain, np.flatnonzero(used))
    return Inferred(used, judged, scales, start, linear, reduced, top, confirmed)


def _lone(chain: Chain, used: Bools) -> Bools:
    """Which used loops (M,) are all that joins two paths: what they say of these nothing tests."""
    lone, part = np.zeros_like(used), np.cumsum(chain.step_edge < 0) - 1
    rows = np.flatnonzero(used & np.not_equal(*part[chain.ends].T))
    if len(rows):
        edges = part[chain.ends[rows]]
        network = Network.of(edges, int(part[-1]) + 1)
        lone[rows] = np.isinf(effective_resistance(edges, np.ones(len(rows), bool), network))
    return lone


REARRANGED = 3
"""Times that the loops are judged, at first and after places were left out or added: a limit on cost."""


def _agreed(
    start: Linear,
    linear: Linear,
    alone: Judged,
    used: Bools,
    shares: Floats,
    wrong: Wrong,
    always: Bools,
    thin: bool,
    begun: int,
) -> tuple[Bools, Judged, Linear, float] | None:
    """The loops (M,) that agree with the poses that they lead to, how all were judged there, and the log-likelihood."""
    chain, limit = start.chain, np.log(max(len(always), 1)) if not begun else 0.0
    ends = chain.places
    best, top, seen = (alone, start), -np.inf, b""
    for number in range(begun, ROUNDS + begun):
        rows = np.flatnonzero(used)
        if number < SETTLING and len(rows):  # later: a group that is mistaken vouches for itself
            rows = rows[one_of_each_place(ends[rows])]
        reduced = thinned(chain, rows)
        if not thin and len(reduced.active) < len(rows):
            return None
        fit = settled(Fit(reduced, linear), MOST_STEPS)
        if number == SETTLING and fit.cost > len(reduced.active) * len(chain.axes):
            # more than right loops should leave: the descent may have ended in a valley beside
            other = settled(Fit(reduced, from_rotations(Fit(reduced, start), MOST_STEPS)), MOST_STEPS)
            fit = min(fit, other, key=_cost)
        linear = fit.linear
        judged = judge(linear, fit, shares, wrong)
        shares, likelihood = mixture(judged.log_density)
        likelihood -= float(judged.log_density[1].sum())
        if number >= SETTLING and likelihood > top:
            best, top = (judged, linear), likelihood
        limit = limit / 2 if number < SETTLING else 0.0
        used = (judged.log_odds > limit) & (judged.factor > limit) | always
        if number >= SETTLING and np.packbits(used).tobytes() == seen:
            break
        seen = np.packbits(used).tobytes()
    judged, linear = best
    return (judged.factor > _limit(judged)) & (judged.log_odds > 0), judged, linear, top


def _cost(fit: Fit) -> float:
    return fit.cost


def refused(found: Inferred, always: Bools) -> Inferred:
    """The result without the loops that nothing confirms: at the poses of the bare chain and of those of `always`."""
    reduced = thinned(found.start.chain, np.flatnonzero(always))
    return replace(found, used=always.copy(), linear=found.start, reduced=reduced)


SETTLING = 2
"""Rounds in which the limit falls and of each place one loop counts; a later one's judgement is taken, that under which
the loops are likeliest.
"""
BY_CHANCE, BY_CHANCE_EACH_FOLD = float(np.log(100.0)), 3.0
"""Log-evidence that chance reaches in one graph of a hundred, and what each e-fold of loops adds to it: measured with
random loops in simulated graphs and in those of Bicocca and RobotCar, whose best reach half of it.
"""


def _limit(judged: Judged) -> float:
    """The log Bayes factor that one wrong loop is expected to reach by chance, of as many as are likely to be wrong."""
    return float(np.log(max((1 / (1 + np.exp(np.clip(judged.log_odds, -500, 500)))).sum(), 1)))


MISTAKEN = float(np.log(20.0))
"""The log-odds of right places against mistaken ones that are enough, where steps err as stated; where it takes larger
errors for places to be right, mistaken ones may have said so: see `Scales.surprise`.
"""


def by_chance(count: int) -> float:
    """The log-evidence that chance may reach among so many loops."""
    return BY_CHANCE + BY_CHANCE_EACH_FOLD * float(np.log(max(count, 1)))

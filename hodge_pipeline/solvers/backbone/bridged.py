"""Loops judged on a chain that may be broken: a step is bridged where the loops then say much more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.breaks import (
    LOOSE,
    Break,
    Runs,
    Testimony,
    Usual,
    agreed_breaks,
    unusual_breaks,
)
from hodge_pipeline.solvers.backbone.chain import Chain, linked, loops_at_place
from hodge_pipeline.solvers.backbone.evidence import Wrong, mixture, student
from hodge_pipeline.solvers.backbone.fit import Fit, linearise, settled
from hodge_pipeline.solvers.backbone.inference import (
    BY_CHANCE,
    MISTAKEN,
    Inferred,
    by_chance,
    infer,
    refused,
)
from hodge_pipeline.solvers.backbone.judge import by_path
from hodge_pipeline.solvers.backbone.places import MISTAKEN_PLACES, MOST_STEPS, agreeing_groups
from hodge_pipeline.solvers.backbone.scales import Scales, learn_scales
from hodge_pipeline.types import Bools, Ints

MOST_BREAKS, TRIED_AT_ONCE = 10, 2
"""That are bridged one after the other, and that are tried each time."""


CONTRADICTED = 1 / 3
"""Of the loops at the places of used ones: where fewer agree, these are held against motions drawn at random, which
takes three times as long as all else. In parts of four graphs of the literature by chance .08 to .35 agree, but for one
of .5; of right ones .47 to .64 where 60 % of the motions are wrong, .21 to .35 where 90 % are; of RobotCar's .39, .48.
"""
DRAWN = 3
"""Times that all motions are drawn."""
QUANTILE, NORMAL_QUANTILE = 0.75, 1.1503
"""Of how far motions lie from their middle, which right ones, and a few far off, hardly change; and of a normal one."""


def infer_bridged(chain: Chain, always: Bools, thin: bool, most: int = MOST_BREAKS) -> tuple[Chain, Inferred] | None:
    """The chain with its paths joined and up to `most` broken steps bridged, and its loops judged; None as in `infer`.

    A step is tried where loops of several places agree that it is broken, or where it is unlike all others. It is
    broken where all loops are likelier with a bridge in its place: by more than chance would have them be.
    """
    chain = unbroken = joined(chain)
    wrong = Wrong.of(chain, chain.poses)  # one for all trials: evidence is against all loops being wrong
    judge = partial(infer, wrong=wrong, always=always, thin=thin)
    first = judge(chain)
    if first is None:
        return None
    found = first
    for _ in range(most):
        better = _better(chain, found, judge)
        if better is None:
            break
        chain, found = better
    # where nothing confirms the loops, nor is a break confirmed that they speak of
    for one, other in [(chain, found)] if found is first else [(chain, found), (unbroken, first)]:
        if other.confirmed and not (_contradicted(other) and _found_by_chance(one, other, always, judge)):
            return one, other
    return unbroken, refused(first, always)


def _contradicted(found: Inferred) -> bool:
    """Whether two thirds of the loops at the places of used ones contradict these: of so many some agree by chance."""
    places, used = found.start.chain.places, found.used
    return bool(loops_at_place(places[used]).sum() < CONTRADICTED * loops_at_place(places)[used].sum())


def _found_by_chance(chain: Chain, found: Inferred, always: Bools, judge: Callable[..., Inferred | None]) -> bool:
    """Whether loops between the same places say as much if all their motions, but those of `always (M,)`, are drawn at
    random, as those at hand are spread.
    """
    rng, twists = np.random.default_rng(4), chain.log(chain.motion)
    middle = np.median(twists, axis=0)
    spread = np.quantile(np.abs(twists - middle), QUANTILE, axis=0) / NORMAL_QUANTILE
    for _ in range(DRAWN):
        drawn = chain.exp(middle + spread * rng.standard_normal(twists.shape))
        motion = np.where(always[:, None, None], chain.motion, drawn)
        other = judge(replace(chain, motion=motion), scales=found.scales)
        if other is not None and other.log_evidence > found.log_evidence - BY_CHANCE:
            return True
    return False


def _better(chain: Chain, found: Inferred, judge: Callable[..., Inferred | None]) -> tuple[Chain, Inferred] | None:
    """The chain with one more step bridged, and its loops judged; None where it has none that is broken."""
    founds = [found]
    if found.scales != Scales() and (not found.confirmed or (chain.stated and found.scales.surprise() > 0)):
        # a break that all loops see looks like larger errors of all steps: with these as stated, the loops agree on it
        founds += [other for other in [judge(chain, scales=Scales())] if other is not None]
    for broken, least in [each for one in founds for each in _candidates(chain, one)]:
        tried = bridged(chain, broken)
        same = judge(tried, scales=found.scales)  # so that nothing but the step differs
        if same is None or same.log_evidence <= found.log_evidence + least:
            continue
        if broken.usual or same.start.chain.corridors_over(broken.at, np.flatnonzero(same.used)) > 1:
            return tried, judge(tried) or same
    return None


def _candidates(chain: Chain, found: Inferred) -> list[tuple[Break, float]]:
    """Breaks worth a trial, with what each must win beside what it has won."""
    linear, factor = found.start, found.judged.factor
    shares = np.log(mixture(factor)[0])
    told = Testimony(linear.chain, linear, np.logaddexp(shares[0] + factor, shares[1]), found.judged.wrong, found.used)
    usual, least = Usual.of(chain), by_chance(len(factor))
    fold = np.log(max((1 / loops_at_place(told.chain.places)).sum(), 1))  # of testimonies, one a place, for the best
    agreed = [each for each in agreed_breaks(told, usual) if each.log_evidence > BY_CHANCE + fold]
    far, agreed = [each for each in agreed if not each.usual], [each for each in agreed if each.usual]
    unlike = [each for each in unusual_breaks(usual) if each.log_evidence > BY_CHANCE]
    worth = [(each, least) for each in agreed[:TRIED_AT_ONCE] if each is agreed[0] or each.at != agreed[0].at]
    if len(found.reduced.runs):
        runs = Runs.of(settled(Fit(found.reduced, found.linear), MOST_STEPS), linear.poses, usual)
        strained, speaks = runs.strained_break(), runs.score(np.array([each.at for each in unlike], np.int64))
        unlike = [each for each, score in zip(unlike, speaks, strict=True) if score > BY_CHANCE]
        if strained is not None and strained.log_evidence > BY_CHANCE:
            worth.append((strained, BY_CHANCE - strained.log_evidence))
    worth += [(each, max(least - each.log_evidence, BY_CHANCE)) for each in unlike]
    return worth + [(each, least) for each in far[:1]]


def bridged(chain: Chain, broken: Break) -> Chain:
    """The chain with another motion in place of a step."""
    step, covariance, known = chain.step.copy(), chain.step_covariance.copy(), chain.bridged.copy()
    step[broken.at], covariance[broken.at], known[broken.at] = broken.motion, broken.covariance, True
    return replace(chain, step=step, step_covariance=covariance, bridged=known)


def joined(chain: Chain) -> Chain:
    """The chain with bridges between paths, as of several robots, where loops of several places agree how they lie, or
    more of one place than are mistaken elsewhere, or one says it where hardly any are wrong.

    What the loops between two paths say is kept while neither is joined, and asked anew before none is joined any more.
    """
    learned, said = None, dict[tuple[int, int], Said]()
    while (chain.path[chain.ends[:, 0]] != chain.path[chain.ends[:, 1]]).any():
        poses = chain.poses
        wrong = Wrong.of(chain, poses)
        scales, shares = learned = learned or learn_scales(chain, wrong)
        linear, rows = linearise(scales.applied(chain), poses), np.arange(len(chain.ends))
        covariance = by_path(linear, rows)
        away = wrong.at(linear.chain, rows, linear.loops[0]).log_density(covariance)
        told, pairs = Testimony.of(linear, away), chain.path[chain.ends]
        apart = pairs[:, 0] != pairs[:, 1]
        refuted = np.flatnonzero(~apart & (student(linear.loops[0], covariance)[0] < away))
        mistaken = [len(group) for group in agreeing_groups(told, refuted)]
        two = [(low, high) for low, high in np.unique(pairs[apart], axis=0).tolist()]
        as_now = not said
        said = {both: said.get(both) or Said.of(told, np.flatnonzero((pairs == both).all(axis=1))) for both in two}
        odds = float(np.log(shares[0] / shares[1]))
        scores = [said[both].best(mistaken, odds) for both in two]
        (score, loop), (low, high) = max(zip(scores, two, strict=True))
        if score > 0:
            last, first = np.flatnonzero(chain.path == low)[-1:], np.flatnonzero(chain.path == high)[:1]
            # of bridges on the way not even the covariance: each would allow for as much as all before it together
            steps = np.where(chain.joins[:, None, None], 0.0, linear.chain.step_covariance)
            told = Testimony.of(replace(linear, chain=replace(linear.chain, step_covariance=steps)), away)
            end, covariance = told.beyond(np.array([loop]), last, first)
            motion = se3.inverse(poses[last[0]]) @ end[0]
            motion[:3, :3] = se3.project_to_so3(motion[:3, :3])  # else rounding doubles with each path
            chain = linked(chain, low, high, motion, LOOSE**2 * covariance[0])
            said = {both: each for both, each in said.items() if not {low, high} & {*both}}
        elif as_now:
            break
        else:
            said = {}
    return chain


@dataclass(frozen=True)
class Said:
    """What the loops between two paths say of how these lie: that of them with which others of several places agree
    most, by how many nats more than chance would; and the first loop of the largest group of one place, its size, and
    those of the groups that contradict it.
    """

    of_places: tuple[float, int]
    first: int
    size: int
    rivals: tuple[int, ...]

    @classmethod
    def of(cls, told: Testimony, rows: Ints) -> Said:
        """That of these loops (K,)."""
        best = -np.inf, -1
        for seed, factor in told.seeds(rows) if len(rows) > 1 else ():
            score = float(told.gains(seed, rows, factor).sum()) - BY_CHANCE - float(np.log(len(told.away)))
            best = max(best, (score, seed))
        groups = agreeing_groups(told, rows)
        first = np.array([group[0] for group in groups])
        against = np.flatnonzero(told.factor(np.full(len(first), first[0]), first) <= 0)
        size = int((told.factor(np.full(len(groups[0]), first[0]), groups[0]) > 0).sum())  # where too many, all are
        return cls(best, int(first[0]), size, tuple(len(groups[each]) for each in against))

    def best(self, mistaken: list[int], odds: float) -> tuple[float, int]:
        """The loop to join the paths by, and by how many nats it is likelier than enough: where others of several
        places agree with it, or more of one place than should where groups of these sizes are mistaken elsewhere. None
        that no other contradicts is less likely than its `odds` beforehand.
        """
        sizes = np.array([*mistaken, *self.rivals])
        likely = max(-_mistaken(self.size, sizes), -np.inf if self.rivals else odds)
        return max(self.of_places, (likely - MISTAKEN, self.first))


def _mistaken(size: int, others: Ints) -> float:
    """The logarithm of how many groups of `size` loops should be mistaken where those of sizes `others (K,)` are, which
    are taken to be exponential; a loop by itself is no group.
    """
    others = others[others > 1]
    count, total = len(others), float(others.sum())
    return float(np.log(MISTAKEN_PLACES + count) - (count + 1) * np.log1p(size / (total + 1)))

"""Loops judged on a chain that may be broken: a step is bridged where this raises the log-evidence of the loops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hodge_pipeline.complex.chi2 import MEDIAN_CHI2, STUDENT_99
from hodge_pipeline.solvers.backbone.bias import without_bias
from hodge_pipeline.solvers.backbone.breaks import Break, Runs, StepModel, agreed_breaks, unusual_breaks
from hodge_pipeline.solvers.backbone.chain import Chain, linked
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE, OutlierModel, mahalanobis, mixture
from hodge_pipeline.solvers.backbone.fit import Fit, optimised
from hodge_pipeline.solvers.backbone.inference import Inferred, LoopJudge, by_chance
from hodge_pipeline.solvers.backbone.judge import densities
from hodge_pipeline.solvers.backbone.levels import MOST_TRIED
from hodge_pipeline.solvers.backbone.linear import linearise
from hodge_pipeline.solvers.backbone.loop_places import loops_at_place
from hodge_pipeline.solvers.backbone.mistakes import SAME_SHIFT, shared_shift, without_shift
from hodge_pipeline.solvers.backbone.pairwise import PairwiseConsistency
from hodge_pipeline.solvers.backbone.places import MISTAKEN, MISTAKEN_PLACES, agreeing_groups, factors_by_chance
from hodge_pipeline.solvers.backbone.scales import DRIFTING, Scales, learned_scales
from hodge_pipeline.types import Bools, Ints

MOST_BREAKS, TRIED_AT_ONCE = 10, 2
"""Breaks that are bridged one after the other, and that are tried each time."""
CONTRADICTED = 1 / 3
"""Share of the loops at the places of used ones that must be used: with fewer, these are compared with motions drawn at
random, which takes three times as long as all else. In parts of four graphs of the literature by chance .08 to .35
agree, but for one of .5; of right ones .47 to .64 where 60 % of the motions are wrong, .21 to .35 where 90 % are; of
RobotCar's .39, .48.
"""
JUDGED_TWICE = 1000
"""Most loops that are judged by stated errors too where learned ones are only a few times as large, and without shifts
that they share: a limit on cost. RobotCar's 2438 took 1.1 CPU s more for the first, of 1.5.
"""
SMALLER, OF_A_SHIFT = (1 / 4, 1 / 16), 3 * BY_CHANCE
"""Factors on the learned errors by which mistaken loops are found; with the smaller alone 286 wrong ones of `alike` are
kept for 38. And the nats that a shift which they share must gain, more than chance for each of its axes.
"""
BENT, ANYWHERE = 0.02, 0.6
"""Share of the runs of steps that are bent by more than 1 % of right ones; and share of random places between which
loops agree, by the drift of the bare path. Beyond both, loops are wrong: .04 to .99 and .80 to .98 where all were wrong
and used, in three graphs of the literature and seven simulated ones. Right ones: up to .26 of random places in 13
graphs of the literature with as many wrong ones, .45 in MIT, whose odometry is off by 84 m; .72, with .01 of the runs
bent, where it turns wrongly by 6° a step.
"""


def infer_bridged(
    chain: Chain,
    trusted: Bools,
    *,
    may_thin: bool,
    most: int,
    is_sought: Callable[[Inferred], bool],
) -> tuple[Chain, Inferred] | None:
    """The chain with its paths joined, without the bias of its steps where this confirms loops, and with up to `most`
    broken steps bridged, and its loops judged; see `LoopJudge` for `trusted (M,)`, `may_thin` and None.

    A step is tried where loops of several places agree that it is broken, or where it is unlike all others. It is
    broken where all loops are likelier with a bridge in its place: by more than chance would have them be. `is_sought`:
    whether breaks should be sought, by the loops judged without any.
    """
    chain = joined(chain)
    by = LoopJudge(OutlierModel.of(chain), trusted, may_thin)

    def judged(unbroken: Chain, first: Inferred) -> tuple[Chain, Inferred]:
        return _bridged(unbroken, first, by, most if most and is_sought(first) else 0)

    first = by.infer(chain)
    if first is None:
        return None
    found = _without_shared_shifts(chain, judged(chain, first), by)
    parted = chain.parted()  # bridges between paths lead as biased steps do
    told = without_bias(parted, first.scales)
    if told is None:
        return found

    def is_told_by(used: Bools) -> bool:  # not by loops that are refused with it
        rows = np.flatnonzero(used)
        return without_bias(parted.with_loops(rows, parted.ends[rows]), first.scales) is not None

    unbiased = joined(told)
    second = by.infer(unbiased)
    if second is None or second.confirmed and not is_told_by(second.used):
        return found
    (apart, other), (chain, before) = judged(unbiased, second), found
    if not is_told_by(other.used):
        return found
    likelier = other.of_places > before.of_places + BY_CHANCE * len(unbiased.bias)
    if apart.broken.sum() > chain.broken.sum():  # breaks may only mend what the wrong bias did
        likelier = likelier and other.log_evidence > before.log_evidence
    return (apart, other) if other.confirmed and (likelier or not before.confirmed) else found


def _bridged(unbroken: Chain, first: Inferred, by: LoopJudge, most: int) -> tuple[Chain, Inferred]:
    """The chain with up to `most` broken steps bridged, and its loops judged; `first`: as they are without."""
    chain = unbroken
    as_stated = _as_stated(chain, first, by)
    if as_stated is not None and _believed(as_stated, first):
        first, as_stated = as_stated, None
    if not first.confirmed:
        first = _drifting(unbroken, by) or first
    found = first
    for _ in range(most):
        better = _better(chain, found, as_stated, by)
        if better is None:
            break
        chain, found = better
        as_stated = _as_stated(chain, found, by)
    # a break found by unconfirmed loops is not confirmed either
    for one, other in [(chain, found)] if found is first else [(chain, found), (unbroken, first)]:
        if not other.confirmed or _is_crumpled(other, by.outliers):
            continue
        if not (_contradicted(other) and _random_motions_do_as_well(one, other, by)):
            return one, other
    return unbroken, by.refused(first)


def _drifting(chain: Chain, by: LoopJudge) -> Inferred | None:
    """The loops judged where steps may turn wrongly by more than they shift, as a gyroscope drifts for long one way.

    None where stated errors say nothing or a bias is taken out, and where places are confirmed by no more than chance
    may add, or loops agree with the poses between any.
    """
    may_drift = chain.stated and not chain.bias.any()
    found = by.best(chain, learned_scales(chain, by.outliers, DRIFTING)) if may_drift else None
    if found is None or not found.confirmed or found.of_places <= MISTAKEN + BY_CHANCE:
        return None
    return None if _fit_anywhere(found, by.outliers) else found


def _is_crumpled(found: Inferred, outliers: OutlierModel) -> bool:
    """Whether loops bend the path, and agree with the poses between any other places too: a path that wrong ones have
    folded, or bent from one mistaken place to the next, is small, and its places are near each other.
    """
    fit = Fit(found.reduced, found.linear)
    chi2 = mahalanobis(*fit.left_out(fit.reduced.of_runs))[0]
    bent = (chi2 > STUDENT_99[len(found.linear.chain.axes)]).sum() > BENT * len(chi2)
    return bool(bent) and _fit_anywhere(found, outliers)


def _fit_anywhere(found: Inferred, outliers: OutlierModel) -> bool:
    return bool((factors_by_chance(found.linear, outliers) > 0).mean() > ANYWHERE)


def _without_shared_shifts(unbroken: Chain, found: tuple[Chain, Inferred], by: LoopJudge) -> tuple[Chain, Inferred]:
    """The chain and its loops without those that take a place for one that looks alike, by a shift that many share;
    what was `found` where all loops are not likelier without that shift.

    They bend the path until they fit: places that differ by a shift are all explained by one flight of stairs that is
    not there. With errors smaller by a factor of `SMALLER` they are refused. All loops are then judged without the
    shift.
    """
    apart, best, mistaken = unbroken, found[1], np.zeros(len(unbroken.ends), bool)
    for factor in SMALLER if len(mistaken) <= JUDGED_TWICE else ():
        while (better := _without_shift(apart, best, factor, by)) is not None:
            apart, best, rows = better
            mistaken[rows] = True
    return (unbroken, by.without(best, unbroken, mistaken)) if mistaken.any() else found


def _without_shift(chain: Chain, found: Inferred, factor: float, by: LoopJudge) -> tuple[Chain, Inferred, Ints] | None:
    """The chain without the shift that loops refused by errors smaller by a factor share, its loops judged, and which
    these are (rows); None where all loops are not likelier so.
    """
    if not found.confirmed:
        return None
    used = np.flatnonzero(found.used)
    some = chain.with_loops(used, chain.ends[used])
    linear, shared = by.select(used).refused_alike(some, found.scales.times(factor))
    if shared is None or shared.nats < OF_A_SHIFT:
        return None
    rows = used[shared.rows]
    shift, alike = shared_shift(chain, linear.poses, rows)
    if 2 * alike < len(rows):
        return None
    apart = without_shift(chain, linear.poses, rows, shift)
    same = by.infer(apart, found.scales)  # so that nothing but the shift differs
    if same is None or not same.confirmed or same.log_evidence <= found.log_evidence:
        return None
    if same.of_places < found.of_places + OF_A_SHIFT:
        return None
    again = _judged_anew(apart, same, by)
    return apart, again if again.confirmed else same, rows


def _judged_anew(chain: Chain, found: Inferred, by: LoopJudge) -> Inferred:
    """The loops judged with scales learned anew, or as `found` where that is likelier."""
    again = by.infer(chain)
    return found if again is None or again.log_evidence < found.log_evidence else again


def _contradicted(found: Inferred) -> bool:
    """Whether fewer than `CONTRADICTED` of the loops at the places of used ones are used: some then agree by chance."""
    places, used = found.start.chain.places, found.used
    return bool(loops_at_place(places[used]).sum() < CONTRADICTED * loops_at_place(places)[used].sum())


def _random_motions_do_as_well(chain: Chain, found: Inferred, by: LoopJudge) -> bool:
    """Whether loops between the same places reach as much log-evidence with motions drawn from a normal distribution as
    wide as that of the measured ones; those of trusted loops stay.
    """
    rng, twists = np.random.default_rng(4), chain.log(chain.motion)
    middle = np.median(twists, axis=0)
    spread = np.median(np.abs(twists - middle), axis=0) / np.sqrt(MEDIAN_CHI2[1])
    for _ in range(MOST_TRIED):
        drawn = chain.exp(middle + spread * rng.standard_normal(twists.shape))
        motion = np.where(by.trusted[:, None, None], chain.motion, drawn)
        other = by.infer(replace(chain, motion=motion), found.scales)
        if other is not None and other.log_evidence > found.log_evidence - BY_CHANCE:
            return True
    return False


def _as_stated(chain: Chain, found: Inferred, by: LoopJudge) -> Inferred | None:
    """The loops judged with errors no larger than stated, where learned ones are larger or confirm no loop; else None.

    A break under all loops looks like larger errors of all steps, and many loops that join right places by a wrong
    motion like larger errors of all loops.
    """
    scales = found.scales.at_most_stated if chain.stated else Scales()
    may_take_long = found.scales.surprise or len(chain.ends) <= JUDGED_TWICE
    larger = chain.stated and found.scales.exceed_stated and may_take_long
    return by.infer(chain, scales) if found.scales != scales and (larger or not found.confirmed) else None


def _believed(as_stated: Inferred, found: Inferred) -> bool:
    """Whether loops judged with errors no larger than stated are to be believed rather than with learned ones: loops
    that these explain by larger errors share a mistake, by which all are likelier.
    """
    if not as_stated.confirmed or not as_stated.start.chain.stated:
        return False
    likelier = as_stated.of_places + as_stated.of_mistakes > found.of_places + found.of_mistakes + BY_CHANCE
    return not found.confirmed or likelier


def _better(chain: Chain, found: Inferred, as_stated: Inferred | None, by: LoopJudge) -> tuple[Chain, Inferred] | None:
    """The chain with one more broken step bridged, and its loops judged; None where no step is broken."""
    surprising = found.scales.surprise or not found.confirmed
    founds = [found] if as_stated is None or not surprising else [found, as_stated]
    for broken, least in [each for one in founds for each in _candidates(chain, one)]:
        tried = bridged(chain, broken)
        same = by.infer(tried, found.scales)  # so that nothing but the step differs
        if same is None or same.log_evidence <= found.log_evidence + least:
            continue
        if not broken.usual and _as_far_as_a_mistake(chain, broken, same):
            continue
        if broken.usual or same.start.chain.corridors_over(broken.at, np.flatnonzero(same.used)) > 1:
            return tried, _judged_anew(tried, same, by)
    return None


def _as_far_as_a_mistake(chain: Chain, broken: Break, found: Inferred) -> bool:
    """Whether a step is bridged by a jump without a turn, about as far as a shift that loops share which are still
    unused: some of those that take a place for one that looks alike, where the path leads from the one to the other.
    """
    split = chain.rotation_axes
    jump = chain.log(chain.between(chain.step[[broken.at]], broken.motion[None]))
    turned = mahalanobis(jump[:, :split], broken.covariance[None, :split, :split])[0][0] > STUDENT_99[split]
    alike = [each.rows for each in found.mistakes() if each.is_shift and each.nats > BY_CHANCE] if not turned else []
    shifts = [shared_shift(found.linear.chain, found.linear.poses, rows)[0] for rows in alike]
    far = float(np.linalg.norm(jump[0, split:]))
    return any(abs(float(np.linalg.norm(shift)) - far) < SAME_SHIFT * far for shift in shifts)


def _candidates(chain: Chain, found: Inferred) -> list[tuple[Break, float]]:
    """Breaks to try, each with the log-evidence that the loops must gain by it beside its own."""
    linear, factor = found.start, found.judged.factor
    shares = np.log(mixture(factor)[0])
    by_chain = np.logaddexp(shares[0] + factor, shares[1])
    pairwise = PairwiseConsistency(linear, by_chain, found.judged.log_wrong, found.used)
    usual, least = StepModel.of(chain), by_chance(len(factor))
    fold = np.log(max((1 / loops_at_place(pairwise.chain.places)).sum(), 1))  # for the best of as many places
    agreed = [each for each in agreed_breaks(pairwise, usual) if each.log_evidence > BY_CHANCE + fold]
    far, agreed = [each for each in agreed if not each.usual], [each for each in agreed if each.usual]
    unlike = [each for each in unusual_breaks(usual) if each.log_evidence > BY_CHANCE]
    candidates = [(each, least) for each in agreed[:TRIED_AT_ONCE] if each is agreed[0] or each.at != agreed[0].at]
    if len(found.reduced.runs):
        runs = Runs.of(optimised(Fit(found.reduced, found.linear)), linear.poses, usual)
        of_run, scores = runs.likeliest_break(), runs.score(np.array([each.at for each in unlike], np.int64))
        unlike = [each for each, score in zip(unlike, scores, strict=True) if score > BY_CHANCE]
        if of_run.log_evidence > BY_CHANCE:
            candidates.append((of_run, BY_CHANCE - of_run.log_evidence))
    candidates += [(each, max(least - each.log_evidence, BY_CHANCE)) for each in unlike]
    return candidates + [(each, least) for each in far[:1]]


def bridged(chain: Chain, broken: Break) -> Chain:
    """The chain with a bridge in place of the broken step."""
    step, covariance, is_bridged = chain.step.copy(), chain.step_covariance.copy(), chain.bridged.copy()
    step[broken.at], covariance[broken.at], is_bridged[broken.at] = broken.motion, broken.covariance, True
    return replace(chain, step=step, step_covariance=covariance, bridged=is_bridged)


def joined(chain: Chain) -> Chain:
    """The chain with bridges between its paths, such as those of several robots.

    Two paths are joined where loops between several places agree on their relative pose, or more loops of one place
    than mistaken places have, or a single loop where hardly any is wrong.
    """
    learned = None
    while chain.apart.any():
        outliers = OutlierModel.of(chain)
        scales, shares = learned = learned or next(learned_scales(chain, outliers))
        linear = linearise(scales.applied(chain), chain.poses)
        log_right, log_wrong = densities(linear, np.arange(len(chain.ends)), outliers)
        pairwise, pairs = PairwiseConsistency.of(linear, log_wrong), chain.path[chain.ends]
        refuted = np.flatnonzero(~chain.apart & (log_right < log_wrong - MISTAKEN))
        mistaken = [len(group) for group in agreeing_groups(pairwise, refuted)]
        odds, two = float(np.log(shares[0] / shares[1])), np.unique(pairs[chain.apart], axis=0)
        between = [np.flatnonzero((pairs == both).all(axis=1)) for both in two]
        scores = [join_evidence(pairwise, rows, mistaken, odds) for rows in between]
        (score, loop), (low, high) = max(zip(scores, two.tolist(), strict=True))
        if score <= 0:
            break
        chain = _joined_by(chain, pairwise, loop, low, high)
    return chain


def _joined_by(chain: Chain, pairwise: PairwiseConsistency, loop: int, low: int, high: int) -> Chain:
    """The chain with a bridge between two paths that leads as one loop between them does."""
    linear = pairwise.linear
    last, first = np.flatnonzero(chain.path == low)[-1], np.flatnonzero(chain.path == high)[0]
    # bridges on the way count as exact: with its covariance each would allow for as much as all before it together
    steps = np.where(chain.joins[:, None, None], 0.0, linear.chain.step_covariance)
    exact = replace(pairwise, linear=replace(linear, chain=replace(linear.chain, step_covariance=steps)))
    return linked(chain, low, high, *exact.bridge(loop, int(last), int(first)))


def join_evidence(pairwise: PairwiseConsistency, rows: Ints, mistaken: list[int], odds: float) -> tuple[float, int]:
    """By how many nats the likeliest of the loops `rows (K,)`, all those between two paths, exceeds what joins these,
    and this loop: by loops of several places that agree with it, or as the first of the largest group at one place.

    `mistaken`: sizes of groups of wrong loops elsewhere; `odds`: prior log-odds of a loop, the least of a group that
    no other contradicts.
    """
    groups = agreeing_groups(pairwise, rows)
    first = int(groups[0][0])
    factors = [pairwise.factor(np.full(len(group), first), group) for group in groups]
    rivals = [len(each) for each in factors if each.max() < -MISTAKEN]
    size = int((factors[0] > 0).sum())  # where too many, all loops are a group
    likely = max(-_mistaken(size, np.array([*mistaken, *rivals])), -np.inf if rivals else odds)
    best = likely - MISTAKEN, first
    for seed, factor in pairwise.seeds(rows) if len(rows) > 1 else ():
        score = float(pairwise.gains(seed, rows, factor).sum()) - BY_CHANCE - float(np.log(len(pairwise.log_wrong)))
        best = max(best, (score, seed))
    return best


def _mistaken(size: int, others: Ints) -> float:
    """The logarithm of how many groups of at least `size` wrong loops are expected where those of sizes `others (K,)`
    are wrong, by an exponential distribution of sizes; single loops are left out.
    """
    others = others[others > 1]
    count, total = len(others), float(others.sum())
    return float(np.log(MISTAKEN_PLACES + count) - (count + 1) * np.log1p(size / (total + 1)))

"""Which loops of a trusted chain are right: Bayes factors at the poses that the other loops lead to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline.solvers.backbone.breaks import Testimony
from hodge_pipeline.solvers.backbone.chain import Chain, loops_at_place, one_of_each_place
from hodge_pipeline.solvers.backbone.evidence import EVEN, Scales, Wrong, learn_scales, mixture, student
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, Reduced, from_rotations, linearise, root, settled, without
from hodge_pipeline.solvers.backbone.polish import polished
from hodge_pipeline.types import Bools, Floats, Ints

ROUNDS = 6
SAMPLES = 64
MOST_STEPS = 15


@dataclass(frozen=True)
class Judged:
    """Loops judged at some poses: `log_odds (M,)` that each is right, by all others; `factor (M,)` its log Bayes factor
    without the share of right ones; `chi2 (M,)` of its residual at poses solved without it; `log_density
    (2, M)` of it, right and wrong.
    """

    log_odds: Floats
    factor: Floats
    chi2: Floats
    log_density: Floats


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
    def _polished(self) -> tuple[Linear, Floats]:
        return polished(self.reduced, self.linear)

    @property
    def poses(self) -> Floats:
        """World from each position (n, 4, 4) by the used loops."""
        return self._polished[0].poses

    @property
    def loop_width(self) -> Floats:
        """Factors (M,) on the loops' standard deviations for the last solve."""
        return self._polished[1]


def infer(
    chain: Chain, wrong: Wrong, always: Bools, thin: bool = True, scales: Scales | None = None, *, anew: bool = False
) -> Inferred | None:
    """Judge the loops of a chain; those of `always (M,)` count whatever they say. Where they would leave more than
    `MOST_UNKNOWNS`, all are judged at the poses of some of the right ones, or None comes back without `thin`.

    `scales`: of the errors; learned from the loops where none are given. `anew`: where nothing confirms them, judged
    again from the places of most loops on.
    """
    poses = chain.poses
    scales, shares = learn_scales(chain, poses, wrong) if scales is None else (scales, EVEN)
    chain = scales.applied(chain)
    start = linearise(chain, poses)
    alone = _judge(start, None, shares, wrong)
    judge = partial(_inferred, start, alone, shares=shares, wrong=wrong, always=always, thin=thin, scales=scales)
    found = judge(alone.factor > np.log(max(len(always), 1)))
    if found is None or found.confirmed or not anew:
        return found
    # a lone wrong loop that chance favours may have refuted the others
    others = [judge(place) for place in crowded(start, alone)]
    return max([found, *filter(None, others)], key=lambda each: (each.confirmed, each.log_evidence))


def crowded(start: Linear, alone: Judged) -> list[Bools]:
    """The loops (M,) of each of the `MOST_PLACES` largest groups, of two at least, that a factor > 0 speaks for."""
    rows = np.flatnonzero(alone.factor > 0)
    groups = [group for group in agreeing_groups(start, alone, rows)[:MOST_PLACES] if len(group) > 1]
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
    chain = start.chain
    linear, limit, used = start, np.log(max(len(always), 1)), used | always
    ends = chain.places
    best, top, seen = (alone, start), -np.inf, b""
    for number in range(ROUNDS):
        rows = np.flatnonzero(used)
        if number < SETTLING and len(rows):  # later: a group that is mistaken vouches for itself
            rows = rows[one_of_each_place(ends[rows])]
        reduced = thinned(chain, rows)
        if not thin and len(reduced.active) < len(rows):
            return None
        fit = settled(Fit(reduced, linear), MOST_STEPS)
        if number == SETTLING and fit.cost > len(reduced.active) * len(chain.axes):
            # more than right loops should leave: the descent may have ended in a valley beside
            other = settled(Fit(reduced, from_rotations(linear, reduced.active)), MOST_STEPS)
            fit = min(fit, other, key=lambda each: each.cost)
        linear = fit.linear
        judged = _judge(linear, fit, shares, wrong)
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
    agreed = (judged.factor > _limit(judged)) & (judged.log_odds > 0)
    enough = MISTAKEN + (scales.surprise() if chain.stated else 0.0)
    used, confirmed = _of_right_places(start, linear, alone, judged, agreed, wrong, enough)
    used |= always
    reduced = thinned(chain, np.flatnonzero(used))
    if (agreed & ~used).any():
        fit = settled(Fit(reduced, start), MOST_STEPS)
        linear, judged = fit.linear, _judge(fit.linear, fit, shares, wrong)
        top = mixture(judged.log_density)[1] - float(judged.log_density[1].sum())
    return Inferred(used, judged, scales, start, linear if used.any() else start, reduced, top, confirmed)


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


def thinned(chain: Chain, rows: Ints) -> Reduced:
    """The network of these loops, or of as many of them, spread evenly over their ends, as can be inverted."""
    spread, count = rows[np.argsort(chain.ends[rows, 0], kind="stable")], min(len(rows), MOST_ACTIVE)
    while True:
        chosen = spread[np.linspace(0, len(spread) - 1, count).astype(np.int64)]
        reduced = Reduced.of(chain, np.sort(chosen))
        unknowns = reduced.network.core_size * len(chain.axes)
        if unknowns <= MOST_UNKNOWNS:
            return reduced
        count = round(THINNING * count * MOST_UNKNOWNS / unknowns)


MOST_UNKNOWNS = 1500
"""In a dense matrix, which takes .5 CPU s to invert."""
MOST_ACTIVE = 2000
"""Loops at the most: between their ends even a long path drifts by little."""
THINNING = 0.8
"""Of as many loops as would leave `MOST_UNKNOWNS` if these grew in proportion to the loops."""


def _limit(judged: Judged) -> float:
    """The log Bayes factor that one wrong loop is expected to reach by chance, of as many as are likely to be wrong."""
    return float(np.log(max((1 / (1 + np.exp(np.clip(judged.log_odds, -500, 500)))).sum(), 1)))


def _of_right_places(
    start: Linear, linear: Linear, alone: Judged, judged: Judged, used: Bools, wrong: Wrong, enough: float
) -> tuple[Bools, bool]:
    """The used loops (M,) of places that are not mistaken for others, and whether they say more than chance finds:
    log-odds that are `enough`.

    Loops of one place agree also where it is mistaken: of each, one is judged at the poses that those of the other
    right places lead to, beginning with the place that says most by itself. `linear`: at the poses of all used loops.
    """
    if not used.any() or (judged.factor[used] - np.log(len(used))).sum() <= by_chance(len(used)):
        return used, False
    chain, ends, rows = start.chain, start.chain.places, np.flatnonzero(used)
    first = one_of_each_place(ends[rows])
    chosen, size = rows[first], loops_at_place(ends[rows])[first]
    away = np.flatnonzero(cKDTree(ends[chosen]).query(ends, p=np.inf)[0] > 1.0)
    unused = [len(group) for group in agreeing_groups(start, alone, away)]

    def rivals(right: Bools) -> Floats:
        sizes = np.sort(np.concatenate([unused, size[~right] / ALIKE]))
        return np.asarray(np.log(len(sizes) - np.searchsorted(sizes, size) + MISTAKEN_PLACES))

    def factors(right: Bools, at: Linear = start) -> Floats:
        fit = settled(Fit(thinned(chain, chosen[right]), at), MOST_STEPS)
        return _judge(fit.linear, fit, EVEN, wrong, tense=True).factor[chosen]

    def said_by(right: Bools, factor: Floats) -> float:
        """Where places are few, each counts by the less of what all others and those before it say: two that agree,
        agree once. By the latter alone a drifting lattice is taken for a backbone, 40 % of its wrong edges for right.
        """
        rows = np.flatnonzero(right)
        if len(rows) <= FEW:
            rows = rows[np.argsort(-bare[rows], kind="stable")]
            after = [bare[row] if not k else factors(np.isin(each, rows[:k]))[row] for k, row in enumerate(rows)]
            return together(np.minimum(factor[rows], np.array(after) - rivals(right)[rows]))
        return together(factor[rows])

    right, bare, each = np.ones(len(chosen), bool), alone.factor[chosen], np.arange(len(chosen))
    strongest = each == np.argmax(bare - rivals(right))
    for number in range(ROUNDS):
        factor = factors(right, start if number else linear) - rivals(right)
        if not number and said_by(right, factor) > enough:
            return used, True
        before, right = right, factor > enough if number else strongest
        by_itself = float((bare - rivals(strongest))[strongest][0])
        said = max(said_by(factor > enough, factor), by_itself)
        if said == by_itself:
            right = right | strongest
        if (before == right).all():
            break
    nearest = cKDTree(ends[chosen]).query(ends, p=np.inf)[1]
    return used & right[nearest], said > enough


def agreeing_groups(start: Linear, alone: Judged, rows: Ints) -> list[Ints]:
    """Groups of these loops, the largest first: each of one place, that agree with one of them as the steps between
    their ends go. Where loops of a place contradict each other, few of them are one testimony. All those of a place
    where there are too many to compare.
    """
    if not len(rows):
        return []
    ends = start.chain.places[rows]
    tree = cKDTree(ends)
    if loops_at_place(ends).sum() > MOST_PAIRS:
        place = one_of_each_place(ends)
        return sorted((rows[tree.query_ball_point(ends[at], 1.0, p=np.inf)] for at in place), key=len, reverse=True)
    first, second = tree.query_pairs(1.0, p=np.inf, output_type="ndarray").T
    told = Testimony(start.chain, start, alone.log_density[0], alone.log_density[1], np.zeros(len(alone.factor), bool))
    pairs = np.stack([first, second], axis=1)[told.factor(rows[first], rows[second]) > 0]
    both = np.concatenate([pairs, pairs[:, ::-1], np.repeat(np.arange(len(rows)), 2).reshape(-1, 2)])
    both = both[np.argsort(both[:, 0], kind="stable")]
    near = np.split(both[:, 1], np.cumsum(np.bincount(both[:, 0], minlength=len(rows)))[:-1])
    free, out = np.ones(len(rows), bool), []
    for row in np.argsort([-len(each) for each in near], kind="stable").tolist():
        if free[row]:
            out.append(rows[near[row]])
            free[near[row]] = False
    return out


MOST_PAIRS = 200_000
"""Of loops that are compared: a limit on memory and time. All of 6000 at a few places took 2 GB and 22 CPU s."""


def together(log_odds: Floats) -> float:
    """The log-odds that all places are right: of what is expected beforehand, that of one counts."""
    return float(log_odds.sum()) + max(len(log_odds) - 1, 0) * float(np.log(MISTAKEN_PLACES))


ALIKE = 0.75
"""Of a place's loops: a used place of as many that contradicts it is its rival, as is an unused one of all as many."""
MISTAKEN_PLACES = 0.2
"""To each right one, of places that loops agree on, beside the rivals that are not used. With more
a path that closes once would stay open: its loops can say little more than that the drift is as stated.
"""
FEW = 6
"""Places at the most that are held against those before them alone: a limit on cost. Of 96 simulated graphs,
most or all of whose loops are wrong, the same three are worse than their odometry with 2, 6 and 30; with 0 seven are.
"""
MISTAKEN = float(np.log(20.0))
"""The log-odds of right places against mistaken ones that are enough, where steps err as stated; where it takes larger
errors for places to be right, mistaken ones may have said so: see `Scales.surprise`.
"""


def by_chance(count: int) -> float:
    """The log-evidence that chance may reach among so many loops."""
    return BY_CHANCE + BY_CHANCE_EACH_FOLD * float(np.log(max(count, 1)))


def _judge(linear: Linear, fit: Fit | None, shares: Floats, wrong: Wrong, tense: bool = False) -> Judged:
    """The loops at a fit, or at the bare chain; `tense`: with errors by which half of those in the fit are usual."""
    covariance = uncertainty(linear, fit)
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    residual = linear.loops[0].copy()
    if fit is not None:
        residual[fit.reduced.active] = left_out(fit, covariance)
    if tense and fit is not None and len(fit.reduced.active):
        usual = student(residual[fit.reduced.active], covariance[fit.reduced.active])[1]
        covariance = covariance * max(1.0, float(np.median(usual)) / len(linear.chain.axes))
    log_density = np.zeros((2, len(covariance)))
    chi2 = np.full(len(covariance), np.nan)
    log_density[0, known], chi2[known] = student(residual[known], covariance[known])
    log_density[1, known] = wrong.log_density(linear.chain, linear.poses)[known]
    factor = log_density[0] - log_density[1]
    return Judged(factor + np.log(shares[0] / shares[1]), factor, chi2, log_density)


def left_out(fit: Fit, covariance: Floats) -> Floats:
    """Residuals of the active loops at poses solved without them: `V S⁻¹ r` with the covariances V there and S of r."""
    residual, own = fit.loops
    return np.asarray((covariance[fit.reduced.active] @ np.linalg.solve(own, residual[..., None]))[..., 0])


def uncertainty(linear: Linear, fit: Fit | None) -> Floats:
    """The covariance (M, p, p) of each loop's residual at poses solved without it; infinite where nothing tells."""
    chain, own = linear.chain, linear.loops[1]
    a, b = chain.ends.T
    same = chain.path[a] == chain.path[b]
    out = np.where(same[:, None, None], linear.path(a, b), np.inf)
    if fit is None or not len(fit.reduced.active):
        return out + own
    through = _between(fit)
    out = np.where((_size(through) < _size(out))[:, None, None], through, out) + own
    out[fit.reduced.active] = without(fit.loops[1], fit.factor.across()[len(fit.reduced.runs) :])
    return out


def _size(covariance: Floats) -> Floats:
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(covariance[:, 0, 0]), np.einsum("mii->m", covariance), np.inf)


def _between(fit: Fit) -> Floats:
    """The covariance of the motion between the ends of every loop by the nearest ends of active ones."""
    linear, reduced, samples = fit.linear, fit.reduced, _samples(fit)
    chain, near, gap = linear.chain, [], np.zeros_like(linear.loops[1])
    for end in chain.ends.T:
        right = np.clip(np.searchsorted(reduced.ends, end), 0, len(reduced.ends) - 1)
        left = np.maximum(right - 1, 0)
        distance = [
            np.where(chain.path[reduced.ends[k]] == chain.path[end], np.abs(reduced.ends[k] - end), np.inf)
            for k in (left, right)
        ]
        nearest = np.where(distance[0] < distance[1], left, right)
        apart = np.isinf(np.minimum(*distance))
        along = linear.path(end, reduced.ends[nearest], chain.ends[:, 1])
        gap += np.where(apart[:, None, None], np.inf, along)
        near.append(nearest)
    component = reduced.network.component
    at = chain.ends[:, 1]
    for rows in np.split(np.arange(len(gap)), np.arange(BATCH, len(gap), BATCH)):
        first, second = (linear.carry(reduced.ends[end[rows]], at[rows]) @ samples[end[rows]] for end in near)
        difference = second - first
        gap[rows] += difference @ np.swapaxes(difference, 1, 2) / max(SAMPLES - gap.shape[1] - 1, 1)
    gap[component[near[0]] != component[near[1]]] = np.inf
    return gap


BATCH = 500
"""Loops whose samples fit in a processor's cache."""


def _samples(fit: Fit) -> Floats:
    """Moves (R, p, SAMPLES) of the ends drawn from their joint distribution: solves with noisy measurements."""
    size = (len(fit.precision), fit.precision.shape[-1], SAMPLES)
    return fit.factor.solve(fit.force(root(fit.precision) @ np.random.default_rng(0).standard_normal(size)))

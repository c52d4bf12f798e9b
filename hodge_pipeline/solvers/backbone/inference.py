"""Which loops of a trusted chain are right: Bayes factors at the poses that the other loops lead to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.solvers.backbone.chain import Chain, one_of_each_place, places_along
from hodge_pipeline.solvers.backbone.evidence import EVEN, Scales, Wrong, learn_scales, mixture, student
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, Reduced, linearise, root, settled, without
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
    """The result: loops that are `used (M,)`, how all were judged, the poses of the used ones, and what their errors
    were found to be: scales, and `loop_width (M,)`, factors on standard deviations for the last solve.

    `log_evidence`: of the loops as judged, against all being wrong. `confirmed`: whether they say more than chance; if
    not, none should be used: see `refused`.
    """

    used: Bools
    judged: Judged
    poses: Floats
    scales: Scales
    loop_width: Floats
    log_evidence: float
    confirmed: bool


def infer(
    chain: Chain, wrong: Wrong, always: Bools, thin: bool = True, scales: Scales | None = None
) -> Inferred | None:
    """Judge the loops of a chain; those of `always (M,)` count whatever they say. Where they would leave more than
    `MOST_UNKNOWNS`, all are judged at the poses of some of the right ones, or None comes back without `thin`.

    `scales`: of the errors; learned from the loops where none are given.
    """
    poses = chain.poses
    scales, shares = learn_scales(chain, poses, wrong) if scales is None else (scales, EVEN)
    chain = scales.applied(chain)
    linear = start = linearise(chain, poses)
    judged = _judge(start, None, shares, wrong)
    limit = np.log(max(len(always), 1))
    used = (judged.factor > limit) | always
    ends = places_along(chain)
    best, top, seen = (judged, start), -np.inf, b""
    for number in range(ROUNDS):
        rows = np.flatnonzero(used)
        if number < SETTLING and len(rows):  # later: a group that is mistaken vouches for itself
            rows = rows[one_of_each_place(ends[rows])]
        reduced = thinned(chain, rows)
        if not thin and len(reduced.active) < len(rows):
            return None
        fit = settled(Fit(reduced, linear), MOST_STEPS)
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
    used = (judged.factor > _limit(judged)) & (judged.log_odds > 0)
    confirmed = _confirmed(linear, judged, used, wrong)
    used |= always
    rows = thinned(chain, np.flatnonzero(used)).active
    linear, width = polished(rows, linear if used.any() else start)
    return Inferred(used, judged, linear.poses, scales, width, top, confirmed)


def refused(found: Inferred, chain: Chain, always: Bools) -> Inferred:
    """The result without the loops that nothing confirms: at the poses of the bare chain and of those of `always`."""
    chain = found.scales.applied(chain)
    rows = thinned(chain, np.flatnonzero(always)).active
    linear, width = polished(rows, linearise(chain, chain.poses))
    return replace(found, used=always.copy(), poses=linear.poses, loop_width=width)


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


def _confirmed(linear: Linear, judged: Judged, used: Bools, wrong: Wrong) -> bool:
    """Whether the used loops say more together than chance finds, and so do the places that they join.

    Loops of one place agree also where it is mistaken for another: of each, one is judged at the poses that those of
    the other places lead to.
    """
    if not used.any() or (judged.factor[used] - np.log(len(used))).sum() <= by_chance(len(used)):
        return False
    chain, ends, rows = linear.chain, places_along(linear.chain), np.flatnonzero(used)
    count, chosen = len(one_of_each_place(ends)), rows[one_of_each_place(ends[rows])]
    reduced = thinned(chain, chosen)
    fit = settled(Fit(reduced, linear), MOST_STEPS)
    factor = _judge(fit.linear, fit, EVEN, wrong, tense=True).factor[reduced.active]
    return float(np.maximum(factor - np.log(count), 0.0).sum()) > MISTAKEN


MISTAKEN = float(np.log(20.0))
"""Log-evidence that places may reach by chance, all of which are mistaken for others by loops that agree: one graph in
twenty. More would refuse the loops of a path that closes once: these can say no more than the drift is small.
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
    if tense and fit is not None:
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

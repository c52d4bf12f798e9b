"""Loops judged at some poses: the densities of their residuals, right and wrong, at poses solved without each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.solvers.backbone.evidence import Wrong, student
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, root
from hodge_pipeline.types import Floats, Ints

SAMPLES = 64
"""Draws of the ends' errors: what they say of a standard deviation is off by a tenth."""


@dataclass(frozen=True)
class Judged:
    """Loops judged at some poses: `log_odds (M,)` that each is right, by all others; `factor (M,)` its log Bayes factor
    without the share of right ones; `chi2 (M,)` of its residual at poses solved without it; `wrong (M,)`: the
    log-density of its residual at hand if it is wrong.
    """

    log_odds: Floats
    factor: Floats
    chi2: Floats
    wrong: Floats


def judge(linear: Linear, fit: Fit | None, shares: Floats, wrong: Wrong) -> Judged:
    """The loops at a fit, or at the bare chain."""
    covariance, residual = uncertainty(linear, fit), linear.loops[0].copy()
    if fit is not None and len(fit.reduced.active):
        active = fit.reduced.active
        residual[active], covariance[active] = fit.left_out(fit.reduced.of_loops)
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    (right, away), chi2 = np.zeros((2, len(covariance))), np.full(len(covariance), np.nan)
    right[known], chi2[known] = student(residual[known], covariance[known])
    away[known] = wrong.at(linear.chain, known, linear.loops[0][known]).log_density(covariance[known])
    return Judged(right - away + np.log(shares[0] / shares[1]), right - away, chi2, away)


def uncertainty(linear: Linear, fit: Fit | None) -> Floats:
    """The covariance (M, p, p) of each loop's residual at the poses of a fit; infinite where nothing tells."""
    own = linear.loops[1]
    out = _along(linear, np.arange(len(own)), np.inf)
    if fit is None or not len(fit.reduced.active):
        return out + own
    through = _between(fit)
    return np.asarray(np.where((_size(through) < _size(out))[:, None, None], through, out) + own)


def by_path(linear: Linear, rows: Ints) -> Floats:
    """The covariance (K, p, p) of the residuals of these loops by the path between their ends; their own between two
    paths.
    """
    return linear.loops[1][rows] + _along(linear, rows, 0.0)


def _along(linear: Linear, rows: Ints, between: float) -> Floats:
    """The covariance (K, p, p) of the path between the ends of these loops, `between` two paths this number."""
    a, b = linear.chain.ends[rows].T
    same = linear.chain.path[a] == linear.chain.path[b]
    return np.where(same[:, None, None], linear.path(a, b), between)


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
    pairs, of_loop = np.unique(np.stack(near), axis=1, return_inverse=True)
    first, second = reduced.ends[pairs]
    spread = np.empty((len(first), *gap.shape[1:]))
    for rows in np.split(np.arange(len(first)), np.arange(BATCH, len(first), BATCH)):
        moved = linear.carry(first[rows], second[rows]) @ samples[pairs[0, rows]]
        difference = samples[pairs[1, rows]] - moved
        spread[rows] = difference @ np.swapaxes(difference, 1, 2) / max(SAMPLES - gap.shape[1] - 1, 1)
    into = linear.carry(second[of_loop], at)
    gap += into @ spread[of_loop] @ np.swapaxes(into, 1, 2)
    gap[component[near[0]] != component[near[1]]] = np.inf
    return gap


BATCH = 500
"""Pairs of ends whose samples fit in a processor's cache."""


def _samples(fit: Fit) -> Floats:
    """Moves (R, p, SAMPLES) of the ends drawn from their joint distribution: solves with noisy measurements."""
    size = (len(fit.precision), fit.precision.shape[-1], SAMPLES)
    return fit.factor.solve(fit.force(root(fit.precision) @ np.random.default_rng(0).standard_normal(size)))

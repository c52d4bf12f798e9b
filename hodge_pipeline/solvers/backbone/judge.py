"""Log-odds of loops: densities of their residuals, if right and if wrong, at poses solved without each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.solvers.backbone.evidence import OutlierModel, student_log_density
from hodge_pipeline.solvers.backbone.fit import Fit
from hodge_pipeline.solvers.backbone.linear import Linear, cholesky
from hodge_pipeline.types import Floats, Ints

SAMPLES = 64
"""Draws of the ends' errors, from which standard deviations are known to a tenth."""


@dataclass(frozen=True)
class Judged:
    """Loops judged at some poses, by all others.

    - `factor (M,)`: log Bayes factor of each; `log_odds (M,)`: with the prior shares of right and wrong loops; both 0,
      or the prior, where its ends are not connected.
    - `chi2 (M,)`: of its residual at poses solved without it, NaN where its ends are not connected.
    - `log_wrong (M,)`: the log-density of its residual at the poses if it is wrong.
    """

    log_odds: Floats
    factor: Floats
    chi2: Floats
    log_wrong: Floats

    def select(self, rows: Ints) -> Judged:
        """The loops `rows (K,)` alone."""
        return Judged(self.log_odds[rows], self.factor[rows], self.chi2[rows], self.log_wrong[rows])


def judge(linear: Linear, fit: Fit | None, shares: Floats, outliers: OutlierModel) -> Judged:
    """The loops judged at the poses of a fit, or of the bare chain; `shares (2,)`: prior, of right and wrong loops."""
    covariance, residual = uncertainty(linear, fit), linear.loops[0].copy()
    if fit is not None and len(fit.reduced.active):
        active = fit.reduced.active
        residual[active], covariance[active] = fit.left_out(fit.reduced.of_loops)
    known = np.flatnonzero(np.isfinite(covariance[:, 0, 0]))
    (right, log_wrong), chi2 = np.zeros((2, len(covariance))), np.full(len(covariance), np.nan)
    right[known], chi2[known] = student_log_density(residual[known], covariance[known])
    log_wrong[known] = outliers.at(linear.chain, known, linear.loops[0][known]).log_density(covariance[known])
    return Judged(right - log_wrong + np.log(shares[0] / shares[1]), right - log_wrong, chi2, log_wrong)


def uncertainty(linear: Linear, fit: Fit | None) -> Floats:
    """The covariance (M, p, p) of each loop's residual at the poses of a fit, ∞ where its ends are not connected."""
    along = by_path(linear, np.arange(len(linear.loops[1])), np.inf)
    if fit is None or not len(fit.reduced.active):
        return along
    through = _through_ends(fit) + linear.loops[1]
    is_nearer = np.einsum("mii->m", through) < np.einsum("mii->m", along)
    return np.where(is_nearer[:, None, None], through, along)


def by_path(linear: Linear, rows: Ints, apart: float = 0.0) -> Floats:
    """The covariance (K, p, p) of the residuals of loops (rows) along the bare chain; where their ends lie on two
    paths, `apart` more than that of the loop alone.
    """
    chain = linear.chain
    between = np.where(chain.apart[rows, None, None], apart, linear.path(*chain.ends[rows].T))
    return np.asarray(linear.loops[1][rows] + between)


def densities(linear: Linear, rows: Ints, outliers: OutlierModel) -> tuple[Floats, Floats]:
    """The log-densities (K,) of the residuals of loops (rows) along the bare chain, if they are right and if wrong."""
    covariance, residual = by_path(linear, rows), linear.loops[0][rows]
    log_wrong = outliers.at(linear.chain, rows, residual).log_density(covariance)
    return student_log_density(residual, covariance)[0], log_wrong


def _through_ends(fit: Fit) -> Floats:
    """The covariance (M, p, p) of the motion between the ends of each loop, by the nearest ends of active ones."""
    linear, reduced, samples = fit.linear, fit.reduced, _samples(fit)
    chain, near, gap = linear.chain, [], np.zeros_like(linear.loops[1])
    for end in chain.ends.T:
        before = reduced.anchor[end]
        after = np.minimum(before + 1, len(reduced.ends) - 1)
        is_nearer = reduced.ends[after] - end <= np.abs(reduced.ends[before] - end)
        nearest = np.where(is_nearer & (chain.path[reduced.ends[after]] == chain.path[end]), after, before)
        along = linear.path(end, reduced.ends[nearest], chain.ends[:, 1])
        gap += np.where(reduced.touched[end, None, None], along, np.inf)
        near.append(nearest)
    pairs, of_loop = np.unique(np.stack(near), axis=1, return_inverse=True)
    first, second = reduced.ends[pairs]
    spread = np.empty((len(first), *gap.shape[1:]))
    for rows in np.split(np.arange(len(first)), np.arange(BATCH, len(first), BATCH)):
        moved = linear.carry(first[rows], second[rows]) @ samples[pairs[0, rows]]
        difference = samples[pairs[1, rows]] - moved
        spread[rows] = difference @ np.swapaxes(difference, 1, 2) / (SAMPLES - gap.shape[1] - 1)
    into = linear.carry(second[of_loop], chain.ends[:, 1])
    gap += into @ spread[of_loop] @ np.swapaxes(into, 1, 2)
    gap[np.not_equal(*reduced.network.component[np.stack(near)])] = np.inf
    return gap


BATCH = 500
"""Pairs of ends whose samples fit in a processor's cache."""


def _samples(fit: Fit) -> Floats:
    """Errors (R, p, SAMPLES) of the ends drawn from their joint distribution, by solves with noisy measurements."""
    size = (len(fit.precision), fit.precision.shape[-1], SAMPLES)
    return fit.factor.solve(fit.force(cholesky(fit.precision) @ np.random.default_rng(0).standard_normal(size)))

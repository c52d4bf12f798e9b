"""Steps that are all too long or too short by one factor against the loops: of all paths, or of one, as a session has.

It is named and never taken out: loops between places that are almost one tell no factor, and maps would shrink.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE
from hodge_pipeline.solvers.backbone.fit import Fit, optimised, thinned
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS, SIGMAS
from hodge_pipeline.solvers.backbone.linear import linearise
from hodge_pipeline.solvers.backbone.loop_places import one_of_each_place
from hodge_pipeline.solvers.reweighted import SETTLED
from hodge_pipeline.types import Bools, Floats, Ints

LEAST_NAMED = float(np.log(1.07))
"""Logarithm of the least factor that is named: it is 1.05 in w20000, whose errors lengthen its paths."""
TOLD = 0.1
"""Largest standard deviation of the logarithm of a factor that is named. Loops of almost one place, as all of
Bicocca's, make a path the likelier the shorter it is: its factor is 1.5 to 2.3, to .19 to .5, those of ten others of
the literature to .004 to .1, of 100 simulated ones to .09 but for a few.
"""
SPREAD = 0.5
"""Prior standard deviation of a factor, for one that loops do not tell."""


@dataclass(frozen=True)
class StepLength:
    """Steps to positions `of (n,)` that are `factor` times too long; `of_all`: no path differs from the others."""

    of: Bools
    factor: float
    of_all: bool


def misstated_lengths(fitted: Chain, poses: Floats, used: Ints) -> list[StepLength]:
    """Paths whose steps have another length than the loops `used (K,)` say, those first that explain most; `poses
    (n, 4, 4)`: solved ones.

    A factor has to make the residuals of one loop of each place smaller than chance does, by whatever errors: those
    that were learned with a wrong length explain it. All loops together have to tell the same factor, within
    `SIGMAS` of its standard deviations: where loops or their errors are mistaken they tell one that is 3.5 to 6 off.
    """
    measured = fitted.measured
    path = np.cumsum(fitted.step_edge < 0) - 1
    alone = [measured & (path == number) for number in np.unique(path[measured])]
    groups = [measured, *alone] if len(alone) > 1 else [measured]
    places = thinned(fitted, used[one_of_each_place(fitted.places[used])])
    freedom = len(fitted.axes) * (len(places.active) - len(np.unique(path[fitted.ends[places.active]])) + 1)
    found: list[StepLength] = []
    fit = optimised(Fit(places, linearise(fitted, poses)))
    while freedom > len(groups) and len(found) < len(alone):
        best = max(groups, key=lambda of: _gain(fit, of))
        other, factor = _refitted(fit, best)
        before, after = (max(each.cost, np.finfo(float).tiny) for each in (fit, other))
        if 0.5 * freedom * np.log(before / after) < BY_CHANCE + np.log(len(groups)):
            break
        sigma = np.sqrt(after / freedom / _score(other, best)[1])
        if sigma > TOLD:
            break
        _, more = _refitted(Fit(thinned(fitted, used), other.linear), best)
        if abs(np.log(more)) > SIGMAS * sigma:
            break
        found.append(StepLength(best, factor * more, best is measured))
        fit = other
    return [each for each in found if abs(np.log(each.factor)) > LEAST_NAMED]


def _refitted(fit: Fit, of: Bools) -> tuple[Fit, float]:
    """The fit with the likeliest length of the steps `of (n,)`, and by how many times they were too long."""
    log_length = 0.0
    for _ in range(MOST_ROUNDS):
        slope, curvature = _score(fit, of)
        change = (slope - log_length / SPREAD**2) / (curvature + 1 / SPREAD**2)
        log_length += (change := float(np.clip(change, -SPREAD, SPREAD)))
        chain, step = fit.linear.chain, fit.linear.chain.step.copy()
        step[of, :3, 3] *= np.exp(change)
        linear = linearise(replace(chain, step=step), fit.linear.poses)
        fit = optimised(replace(fit, linear=linear))
        if abs(change) < SETTLED:
            break
    return fit, float(np.exp(-log_length))


def _gain(fit: Fit, of: Bools) -> float:
    """By how much χ² falls with the likeliest length of these steps, to first order."""
    slope, curvature = _score(fit, of)
    return slope**2 / (curvature + 1 / SPREAD**2)


def _score(fit: Fit, of: Bools) -> tuple[float, float]:
    """Minus half the gradient of χ² by the logarithm of the length of the steps `of (n,)`, and half its curvature, at
    poses that follow it.
    """
    chain, (low, high) = fit.linear.chain, fit.reduced.ends[fit.reduced.runs].T
    axes = chain.axes[chain.rotation_axes :] - 3
    back = np.swapaxes(chain.step[:, :3, :3], 1, 2) @ chain.step[:, :3, 3:]
    moved = np.where(of[:, None], (fit.linear.poses[:, :3, :3] @ back)[:, axes, 0], 0.0).cumsum(axis=0)
    longer = np.zeros((*fit.residual.shape, 1))
    longer[: len(low), chain.rotation_axes :, 0] = moved[low] - moved[high]
    pushed = fit.precision @ np.concatenate([longer, fit.residual[..., None]], axis=2)
    force = fit.force(pushed)
    follows = fit.factor.solve(force[..., :1])
    by_length, by_residual = (longer * pushed[..., :1]).sum(), (longer * pushed[..., 1:]).sum()
    return (
        float((follows * force[..., 1:]).sum() - by_residual),
        float(by_length - (follows * force[..., :1]).sum()),
    )

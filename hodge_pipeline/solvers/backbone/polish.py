"""The poses of the loops that are right, with heavy tails and for errors that are alike where loops are near."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.complex.judging import tail_weight
from hodge_pipeline.solvers.backbone.chain import loops_at_place
from hodge_pipeline.solvers.backbone.evidence import squares
from hodge_pipeline.solvers.backbone.fit import Fit, Linear, Reduced, settled
from hodge_pipeline.types import Floats

LOCAL = 0.5
"""Of the scale of the steps' errors over long paths, that over short ones: these errors are alike from step to step.
Fitted, with the next, on the graphs of Bicocca and RobotCar.
"""
CROWDED_POWER = 0.5
"""The power of the number of loops at one place by which their variances are larger: 0 for errors that are independent,
1 for the same error in all.
"""
ROUNDS, STEPS = 5, 3
"""Times that weights are taken anew, and Gauss–Newton's steps for each: limits on cost."""
SAME_WEIGHT = 0.01
"""Loops whose weights change by less are not solved for again."""


def polished(reduced: Reduced, linear: Linear) -> tuple[Linear, Floats]:
    """The chain at the poses of these active loops, and the factors (M,) on the standard deviations of all."""
    chain, count, rows = linear.chain, len(linear.chain.ends), reduced.active
    if not len(rows):
        return linear, np.ones(count)
    chain = replace(chain, step_covariance=LOCAL**2 * chain.step_covariance)
    wide = np.ones(count)
    wide[rows] = loops_at_place(chain.places[rows]) ** CROWDED_POWER
    chain = replace(chain, covariance=chain.covariance * wide[:, None, None])
    weights = np.ones(count)
    for _ in range(ROUNDS):
        weighted = replace(chain, covariance=chain.covariance / weights[:, None, None])
        fit = settled(Fit(reduced, replace(linear, chain=weighted)), STEPS)
        linear, (residual, covariance) = fit.linear, fit.loops
        chi2 = squares(residual, covariance * weights[rows, None, None])[0]
        before = weights[rows]
        weights[rows] = tail_weight(chi2, len(chain.axes))
        if np.abs(weights[rows] - before).max() < SAME_WEIGHT:
            break
    return linear, np.sqrt(wide / weights)

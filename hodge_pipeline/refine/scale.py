"""The metric scale of a model, from what a depth sensor saw at its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.types import Floats
from hodge_pipeline.types.text import counted

LEAST_POINTS, LEAST_IMAGES = 50, 3
"""Points with depth, and images that see them, below which the scale is not told."""
MAX_SPREAD, OF_CONSTANT, FINE_SPREAD = 0.15, 1 / 3, 0.02
"""Median deviation of the ratios, as a share, beyond which the depth is not of these images: at most the first, and at
most the second of what the same depth everywhere would give, for in a room even that of a mirrored or of another image
is off by some 10 % only (half of it); a sensor's own depth agrees to a few per cent. The third is always near enough.
"""
CLEARLY_BETTER = 0.7
"""Deviation along rays over that along the axis below which depth is along rays."""
MOST_OFF = 0.1
"""Share of images whose own scale may be off by more than `MAX_SPREAD`."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a Gaussian over its median absolute deviation."""
MEDIAN_TO_MEAN = 1.2533
"""Standard error of the median of Gaussian samples over that of their mean."""
LEAST_SIGMA = 1e-4
"""Floor of the relative standard error: no depth sensor's calibration is known better."""
NO_DEPTH = "there is no depth"


@dataclass(frozen=True)
class Scale:
    """Metres in one unit of a model, with the relative standard error `sigma`; 1 and a `reason` where unknown.

    `spread`: the median deviation of the points' ratios from their median, as a share of it.
    """

    metres_per_unit: float
    sigma: float
    points: int
    images: int
    spread: float
    reason: str = ""

    @property
    def is_observable(self) -> bool:
        """Whether depth tells it."""
        return not self.reason

    @property
    def doubt(self) -> str:
        """Why a model that has depth is not in metres; "" where it is, or has none."""
        return f"not in metres, since {self.reason}" if self.reason and self.reason != NO_DEPTH else ""

    @property
    def is_one(self) -> bool:
        """Whether the model is metric already, as far as depth can tell (two standard errors)."""
        return self.is_observable and abs(self.metres_per_unit - 1) <= 2 * self.sigma

    def __str__(self) -> str:
        if not self.is_observable:
            return f"scale not observable, kept: {self.reason}"
        return (
            f"scale {self.metres_per_unit:.6g} m per unit (± {self.sigma:.2%}), by depth at "
            f"{counted(self.points, 'point')} of "
            f"{counted(self.images, 'image')}, half of them within {self.spread:.1%}"
        )


def metric_scale(depths: Sequence[Floats]) -> Scale:
    """The scale by depths at points (P, 3) of each image: metres that the sensor saw, units of the model, and the
    length of the ray to unit depth. It is the median of the ratios of the first two.

    Points of one image share the errors of its pose and calibration, so the standard error is that of the median of the
    images' own medians.
    """
    useful = [one for one in depths if len(one)]
    sensor, model, ray = np.concatenate([np.zeros((0, 3)), *useful]).T
    if not len(depths):
        return _unknown(0, 0, NO_DEPTH)
    if len(sensor) < LEAST_POINTS or len(useful) < LEAST_IMAGES:
        return _unknown(
            len(sensor), len(useful), f"depth at only {counted(len(sensor), 'point')} of {len(useful)} images"
        )
    scale, spread = _median_and_spread(sensor / model)
    middles = np.array([np.median(one[:, 0] / one[:, 1]) for one in useful]) / scale
    reason = _not_of_these(sensor, model, ray) or _other_units(middles)
    if reason:
        return _unknown(len(sensor), len(useful), reason)
    deviation = MAD_TO_SIGMA * float(np.median(np.abs(middles - np.median(middles))))
    sigma = max(MEDIAN_TO_MEAN * deviation / np.sqrt(len(useful)), LEAST_SIGMA)
    return Scale(scale, sigma, len(sensor), len(useful), spread)


def _not_of_these(sensor: Floats, model: Floats, ray: Floats) -> str:
    """Why depth is not that of the points (P,); "" where it fits far better than the same depth everywhere would."""
    spread, of_constant, of_rays = (
        _median_and_spread(one)[1] for one in (sensor / model, 1 / model, sensor / (model * ray))
    )
    if of_rays < CLEARLY_BETTER * spread and spread > FINE_SPREAD:
        return (
            f"depth seems to be measured along rays ({of_rays:.1%} off the points in the median, as depth along the "
            f"axis {spread:.1%}): give depth along the camera's axis"
        )
    if spread <= min(MAX_SPREAD, max(OF_CONSTANT * of_constant, FINE_SPREAD)):
        return ""
    return f"depth and points disagree (half of the ratios are off by more than {spread:.0%}): depth of other images?"


def _other_units(middles: Floats) -> str:
    """Why the images' own medians, over that of all, are not of one unit; "" where they are."""
    off = np.abs(middles - 1) > MAX_SPREAD
    if off.mean() <= MOST_OFF:
        return ""
    factor = np.median(middles[off])
    return f"the depth of {off.sum()} of {len(middles)} images is {factor:.2g} times what the others' scale gives"


def _median_and_spread(ratios: Floats) -> tuple[float, float]:
    """The median, and the median deviation from it as a share of it."""
    median = float(np.median(ratios))
    return median, float(np.median(np.abs(ratios / median - 1)))


def _unknown(points: int, images: int, reason: str) -> Scale:
    return Scale(1.0, float("nan"), points, images, float("nan"), reason)

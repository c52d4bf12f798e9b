"""The metric scale of a model, from what a depth sensor saw at its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.types import Floats
from hodge_pipeline.types.text import counted

LEAST_POINTS, LEAST_IMAGES = 50, 3
"""Points with depth, and images that see them, below which the scale is not told."""
MAX_SPREAD = 0.15
"""Median deviation of the ratios, as a share, beyond which the depth is not of these images: a sensor's own depth
agrees to a few per cent, that of other images to some thirty."""
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


def metric_scale(ratios: Sequence[Floats]) -> Scale:
    """The scale by ratios (P,) of sensor depth in metres to depth in the model, one array for each image: their median.

    Points of one image share the errors of its pose and calibration, so the standard error is that of the median of the
    images' own medians.
    """
    useful = [one for one in ratios if len(one)]
    found = np.concatenate([np.zeros(0), *useful])
    if not len(ratios):
        return _unknown(0, 0, NO_DEPTH)
    if len(found) < LEAST_POINTS or len(useful) < LEAST_IMAGES:
        return _unknown(
            len(found), len(useful), f"depth at only {counted(len(found), 'point')} of {len(useful)} images"
        )
    scale = float(np.median(found))
    spread = float(np.median(np.abs(found / scale - 1)))
    if not spread <= MAX_SPREAD:
        reason = (
            f"depth and points disagree (half of the ratios are off by more than {spread:.0%}): depth of other images?"
        )
        return _unknown(len(found), len(useful), reason)
    middles = np.array([np.median(one) for one in useful]) / scale
    deviation = MAD_TO_SIGMA * float(np.median(np.abs(middles - np.median(middles))))
    sigma = max(MEDIAN_TO_MEAN * deviation / np.sqrt(len(useful)), LEAST_SIGMA)
    return Scale(scale, sigma, len(found), len(useful), spread)


def _unknown(points: int, images: int, reason: str) -> Scale:
    return Scale(1.0, float("nan"), points, images, float("nan"), reason)

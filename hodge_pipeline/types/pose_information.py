"""What observations tell of poses together: which they fix, and how well."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hodge_pipeline.types.arrays import Bools, Floats

GAUGE = 7
"""Turn, shift and size of the whole, which no track tells."""


@dataclass(frozen=True)
class PoseInformation:
    """Information (G, n, n) over (φ, ρ) of the `fixed (B,)` bodies, one after the other: of all of them as one group,
    or, where they are too many, of each given all others, which is too sure.
    """

    fixed: Bools
    groups: Floats

    @cached_property
    def standard_errors(self) -> Floats:
        """Of each body's rotation (rad) and position (units) (B, 2): roots of the mean variance of three axes.

        In the gauge in which the bodies as a whole stay where they are. NaN of bodies that are not fixed.
        """
        out = np.full((len(self.fixed), 2), np.nan)
        if self.fixed.any():
            alone = len(self.groups) == self.fixed.sum() > 1
            covariance = np.linalg.pinv(self.groups, hermitian=True) if alone else self._without_gauge()[None]
            variances = np.diagonal(covariance, axis1=1, axis2=2).reshape(-1, 2, 3).mean(axis=2)
            out[self.fixed] = np.sqrt(np.maximum(variances, 0.0))
        return out

    def _without_gauge(self) -> Floats:
        """The pseudo-inverse without the directions that are free; lengths count as angles, which suits unit scenes."""
        values, vectors = np.linalg.eigh((self.groups[0] + self.groups[0].T) / 2)
        kept = np.arange(len(values)) >= GAUGE
        kept &= values > 1e-12 * values[-1]
        return np.asarray((vectors[:, kept] / values[kept]) @ vectors[:, kept].T)

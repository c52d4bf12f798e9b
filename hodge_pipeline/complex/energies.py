"""The energies of a decomposition's parts: a module of its own, since worker processes load it and not the solver's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ROUNDING = 1e-20
"""Energies below it, squares of radians and metres, are those of rounding."""


@dataclass(frozen=True)
class Energies:
    """Energy Σ w|ω|² of the parts of a 1-form, (rotation in rad², translation in m²) each, on so many simplices.

    Exact: what moving the poses takes away; co-exact: the curl of triangles; harmonic: loops that no triangle fills.
    """

    simplices: tuple[int, ...]
    exact: tuple[float, float]
    coexact: tuple[float, float]
    harmonic: tuple[float, float]

    @property
    def total(self) -> tuple[float, float]:
        """The energy of all parts: rotation, translation."""
        rotation, translation = np.sum((self.exact, self.coexact, self.harmonic), axis=0).tolist()
        return rotation, translation

    @property
    def shares(self) -> dict[str, tuple[float, float]]:
        """The share of each part in the rotation's and the translation's energy; 0 where there is none at all."""
        parts = {"exact": self.exact, "coexact": self.coexact, "harmonic": self.harmonic}
        total = np.array(self.total)
        scale = np.where(total > ROUNDING, total, np.inf)
        return {name: (float(part[0] / scale[0]), float(part[1] / scale[1])) for name, part in parts.items()}

"""Whether a value got better or worse, and by how much, in words; differences too small to measure are none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hodge_pipeline.types import Floats

Better: TypeAlias = Literal["lower", "higher"]

SAME = 0.02
"""Relative change of an error that counts as none: the truth of RGB-D benchmarks is no more exact."""
MEASURABLE = 1e-6
"""Least measurable difference, as a share of the scene's extent, and of an angle in radians. Clouds are held in single
precision, which rounds a coordinate by 6e-8 of itself; a pose and a distance add up some ten such roundings."""
NEAR_WHOLE = 1e-9
"""What a change of units may add to a whole number."""
VERBS = {1: "fell", 0: "hardly changed,", -1: "rose"}


def sign_of(before: float, after: float, tolerance: float, better: Better = "lower") -> int:
    """1 better, −1 worse, 0 within the tolerance; a value that became NaN is worse, one that was NaN counts as 0."""
    if before != before:
        return 0
    gain = before - after if better == "lower" else after - before
    return -1 if not gain >= -tolerance else int(gain > tolerance)


def floor_of(*positions: Floats) -> float:
    """The least measurable length in metres: `MEASURABLE` of the largest extent of these sets of positions (N, 3)."""
    known = [one[np.isfinite(one).all(axis=1)] for one in positions]
    return MEASURABLE * max((float(np.linalg.norm(np.ptp(one, axis=0))) for one in known if len(one)), default=0.0)


@dataclass(frozen=True)
class Change:
    """One error before and after, lower is better: a length in metres or an angle in degrees (`unit`).

    `what` names it in a sentence, `short` in a headline; a difference up to `floor` is not measurable.
    """

    what: str
    short: str
    before: float
    after: float
    floor: float = 0.0
    unit: Literal["m", "°"] = "m"

    @property
    def is_measured(self) -> bool:
        """Whether the difference is above the floor."""
        return not abs(self.after - self.before) <= self.floor

    @property
    def share(self) -> float:
        """Relative change: −0.4 where the error fell by 40 %; NaN where it was below the floor and rose above it."""
        if not self.is_measured:
            return 0.0
        return (self.after - self.before) / self.before if self.before > self.floor else float("nan")

    @property
    def sign(self) -> int:
        """1 better, −1 worse, 0 where the change is too small to count."""
        return sign_of(self.before, self.after, max(SAME * abs(self.before), self.floor))

    def __str__(self) -> str:
        before, after = self.values
        if not self.is_measured:
            return f"{self.what} is unchanged at {after}"
        return f"{self.what} {VERBS[self.sign]} from {before} to {after}{self._in_percent}"

    @property
    def briefly(self) -> str:
        """`RPE 17 mm → 20 mm`."""
        return f"{self.short} {' → '.join(self.values)}"

    @property
    def line(self) -> str:
        """`ATE 5 cm → 3 cm (−40 %, better)`."""
        word = {1: "better", 0: "unchanged", -1: "worse"}[self.sign]
        return f"{self.briefly}{f' ({percent(self.share)}, {word})' if self._in_percent else f' ({word})'}"

    @property
    def values(self) -> tuple[str, str]:
        """Before and after in one unit, with the same decimals."""
        larger = max((value for value in (self.before, self.after) if value < float("inf")), default=0.0)
        factor, unit = (1.0, "°") if self.unit == "°" else _unit(larger)
        before, after = (f"{text}{unit}" for text in alike(self.before * factor, self.after * factor))
        return self._or_floor(self.before, before), self._or_floor(self.after, after)

    def _or_floor(self, value: float, text: str) -> str:
        """The text of a value, replaced where that is below the floor or not finite."""
        if self.floor <= abs(value) < float("inf"):
            return text
        return angle(value, self.floor) if self.unit == "°" else length(value, None, self.floor)

    @property
    def _in_percent(self) -> str:
        return "" if np.isnan(self.share) else f" ({percent(self.share)})"


def length(metres: float, unit_of_m: float | None = None, floor_m: float = 0.0) -> str:
    """A length with the unit that suits it, or suits the length `unit_of_m`; `< 0.005 mm` below the floor."""
    if not abs(metres) < float("inf"):
        return "–"
    if abs(metres) < floor_m:
        return f"< {length(floor_m)}"
    factor, unit = _unit(abs(metres if unit_of_m is None else unit_of_m))
    return f"{metres * factor:.3g}{unit}"


def _unit(size_m: float) -> tuple[float, str]:
    """The factor from metres to the unit that suits a size, and its name after a space."""
    if size_m < 0.025:
        return 1000.0, " mm"
    if size_m < 1:
        return 100.0, " cm"
    return (1.0, " m") if size_m < 999.5 else (0.001, " km")


def alike(before: float, after: float, digits: int = 3) -> tuple[str, str]:
    """Two numbers with the same decimals, so that the larger has `digits` significant ones.

    Whole numbers have no decimals; a small number that this leaves fewer than two digits has two.
    """
    larger = max(abs(before), abs(after))
    if not 1e-3 <= larger < 1e6:  # too small or too large for decimals, or no number
        return f"{before:.{digits}g}", f"{after:.{digits}g}"
    is_whole = all(abs(value - round(value)) < NEAR_WHOLE for value in (before, after) if math.isfinite(value))
    decimals = 0 if is_whole else max(digits - 1 - math.floor(math.log10(larger)), 0)
    least = 0.0 if is_whole else 10.0 ** (1 - decimals)
    first, second = (
        f"{value:.{decimals}f}" if value == 0 or abs(value) >= least else f"{value:.2g}" for value in (before, after)
    )
    return first, second


def angle(degrees: float, floor_deg: float = 0.0) -> str:
    """An angle in degrees; `< 6e-05°` below the floor."""
    if not abs(degrees) < float("inf"):
        return "–"
    return f"< {floor_deg:.1g}°" if abs(degrees) < floor_deg else f"{degrees:.3g}°"


def percent(share: float) -> str:
    """A share in per cent with its sign, a real minus; `0 %` without one."""
    return f"{share * 100:+.0f} %".replace("-", "−") if abs(share) >= 0.005 else "0 %"

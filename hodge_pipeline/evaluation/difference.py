"""What a difference between two values of one measure comes to: better, worse, or none that was measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hodge_pipeline.types import Floats

Better: TypeAlias = Literal["lower", "higher"]

SAME = 0.02
"""A relative change below this counts as none: a truth of the kind that RGB-D benchmarks have is no finer."""
MEASURABLE = 1e-6
"""Of the scene's extent, and in radians of an angle: the least difference that is one. Clouds are held in single
precision, which rounds a coordinate by 6e-8 of itself; a pose and a distance add up some ten such roundings."""
VERBS = {1: "fell", 0: "hardly changed,", -1: "rose"}


def sign_of(before: float, after: float, tolerance: float, better: Better = "lower") -> int:
    """1 better, −1 worse, 0 where the difference is within the tolerance; a value that is lost (NaN) is worse."""
    if before != before:
        return 0
    gain = before - after if better == "lower" else after - before
    return -1 if not gain >= -tolerance else int(gain > tolerance)


def floor_of(*positions: Floats) -> float:
    """The least length (m) that was measured: `MEASURABLE` of the extent of these positions (N, 3) each."""
    known = [one[np.isfinite(one).all(axis=1)] for one in positions]
    return MEASURABLE * max((float(np.linalg.norm(np.ptp(one, axis=0))) for one in known if len(one)), default=0.0)


@dataclass(frozen=True)
class Change:
    """One error before and after, lower is better: a length in metres or an angle in degrees (`unit`).

    `short` names it in a headline; a difference of up to `floor` was not measured.
    """

    what: str
    short: str
    before: float
    after: float
    floor: float = 0.0
    unit: Literal["m", "°"] = "m"

    @property
    def is_measured(self) -> bool:
        """Whether there is any difference above the floor."""
        return not abs(self.after - self.before) <= self.floor

    @property
    def share(self) -> float:
        """−0.4 where the error fell by 40 %; NaN where nothing was measured before, and now is."""
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
        """Before and after in the same unit."""
        if self.unit == "°":
            return angle(self.before, self.floor), angle(self.after, self.floor)
        larger_m = max(self.before, self.after)
        return length(self.before, larger_m, self.floor), length(self.after, larger_m, self.floor)

    @property
    def _in_percent(self) -> str:
        return "" if np.isnan(self.share) else f" ({percent(self.share)})"


def length(metres: float, unit_of_m: float | None = None, floor_m: float = 0.0) -> str:
    """A length with a unit that suits its size, or the size `unit_of_m` of another; `< 0.005 mm` below the floor."""
    if not abs(metres) < float("inf"):
        return "–"
    if abs(metres) < floor_m:
        return f"< {length(floor_m)}"
    size_m = abs(metres if unit_of_m is None else unit_of_m)
    if size_m < 0.025:
        return f"{metres * 1000:.3g} mm"
    if size_m < 1:
        return f"{metres * 100:.3g} cm"
    return f"{metres:.3g} m" if size_m < 999.5 else f"{metres / 1000:.3g} km"


def angle(degrees: float, floor_deg: float = 0.0) -> str:
    """An angle in degrees; `< 6e-05°` below the floor."""
    if not abs(degrees) < float("inf"):
        return "–"
    return f"< {floor_deg:.1g}°" if abs(degrees) < floor_deg else f"{degrees:.3g}°"


def percent(share: float) -> str:
    """A signed share in per cent, with a real minus sign; none of what rounds to 0."""
    return f"{share * 100:+.0f} %".replace("-", "−") if abs(share) >= 0.005 else "0 %"

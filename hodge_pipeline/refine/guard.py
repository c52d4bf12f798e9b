"""The guard of every refinement: a result that is worse than its input by its own measures is never kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import ndtr, stdtrit

from hodge_pipeline.evaluation.difference import Better, alike, sign_of
from hodge_pipeline.types import Floats

SCORE_TOLERANCE = 0.002
"""Least tolerance of a score exp(−d/σ), σ = 69 mm: what 0.14 mm of distance between clouds make."""
NOISE_SIGMAS = 3.0
"""Standard errors of a mean difference that count as its noise."""
Outcome: TypeAlias = Literal["refined", "optimal", "worse", "forced", "convention", "nothing"]


@dataclass(frozen=True)
class Measure:
    """One quality of the poses, before and after.

    `better` says which way is good; a change the other way counts beyond `tolerance`, the measure's own noise in its
    own unit. `is_held_out`: it is of measurements that took no part in the solve.
    """

    name: str
    before: float
    after: float
    better: Better = "lower"
    tolerance: float = 0.0
    unit: str = ""
    is_held_out: bool = False

    @property
    def is_worse(self) -> bool:
        """Whether it got worse by more than the tolerance; a measure that is lost (NaN) is worse."""
        return sign_of(self.before, self.after, self.tolerance, self.better) < 0

    @property
    def is_better(self) -> bool:
        """Whether it got better by more than the tolerance."""
        return sign_of(self.before, self.after, self.tolerance, self.better) > 0

    @property
    def leans_better(self) -> bool:
        """Whether it got better by more than a third of the tolerance: one standard error where that is three."""
        return sign_of(self.before, self.after, self.tolerance / 3, self.better) > 0

    def __str__(self) -> str:
        return f"{self.name} {' → '.join(alike(self.before, self.after, 4))}{self.unit and ' '}{self.unit}"


@dataclass(frozen=True)
class PoseChange:
    """How far the poses moved, and how well the measurements fix them: root mean squares over the poses.

    The uncertainties are two standard deviations, NaN where the measurements do not tell.
    """

    translation_m: float
    rotation_deg: float
    translation_uncertainty_m: float
    rotation_uncertainty_deg: float
    is_metric: bool = True
    """False where no scale is known: lengths are in the model's own unit, whatever the names say."""

    @property
    def is_significant(self) -> bool:
        """Whether the poses moved by more than their own stated uncertainty, in either part."""
        return not (
            self.translation_m <= self.translation_uncertainty_m and self.rotation_deg <= self.rotation_uncertainty_deg
        )

    def __str__(self) -> str:
        moved, known = (
            f"{length * 1000:.3g} mm" if self.is_metric else f"{length:.3g} units"
            for length in (self.translation_m, self.translation_uncertainty_m)
        )
        told = f"poses moved by {moved} and {self.rotation_deg:.2g}° (RMS)"
        if self.translation_uncertainty_m != self.translation_uncertainty_m:
            return f"{told}; the measurements do not tell how well they are known"
        return f"{told}, known to {known} and {self.rotation_uncertainty_deg:.2g}°"


@dataclass(frozen=True)
class Decision:
    """What becomes of a refinement, why, and the measures that decided.

    - `refined`: the result is written;
    - `optimal`: the input is given back, since it fits what was held out as well (poses that moved by more than their
      uncertainty must gain one standard error, others three); or, with nothing held out, since no pose moved by more
      than its uncertainty;
    - `worse`: the input is given back, since the result fails a measure; exit code 3;
    - `forced`: as `worse`, but the result is written;
    - `convention`: the input is given back, since it explains what was registered only if it is read otherwise; exit
      code 3;
    - `nothing`: only the report is written, since no measurement relates the poses; exit code 3.
    """

    outcome: Outcome
    reason: str
    measures: tuple[Measure, ...] = ()
    change: PoseChange | None = None
    doubt: str = ""
    """Why even what is kept may be wrong."""

    @property
    def keeps_input(self) -> bool:
        """Whether the input is given back, byte for byte."""
        return self.outcome in ("optimal", "worse", "convention", "nothing")

    @property
    def exit_code(self) -> int:
        """3 where the result failed its own checks, else 0."""
        return 3 if self.outcome in ("worse", "convention", "nothing") else 0


def mean_noise(differences: Floats) -> float:
    """What chance makes of the mean of paired differences (P,): `NOISE_SIGMAS` standard errors of a normal one, more of
    few pairs by Student's t, which do not tell their own spread; infinite of a single one.
    """
    count = len(differences)
    if count < 2:
        return float("inf")
    return float(-stdtrit(count - 1, ndtr(-NOISE_SIGMAS)) * differences.std(ddof=1) / np.sqrt(count))


def decide(measures: Sequence[Measure], change: PoseChange | None = None, *, force: bool = False) -> Decision:
    """The decision on a refinement. With `force` a worse result is written; an optimal input is still given back.

    Measurements held out come before the uncertainty, which weak or overconfident edges state wrongly. A result that is
    worse by held-out measures alone is no failure: the input is `optimal` by them.
    """
    measures = tuple(measures)
    worse = [measure for measure in measures if measure.is_worse]
    held_out = [measure for measure in measures if measure.is_held_out]
    moved = change is None or change.is_significant
    if worse and (force or not all(measure.is_held_out for measure in worse)):
        reason = "worse by its own measures: " + "; ".join(str(measure) for measure in worse)
        return Decision("forced" if force else "worse", reason, measures, change)
    if held_out and not any(measure.is_better or (moved and measure.leans_better) for measure in held_out):
        told = "; ".join(str(measure) for measure in held_out)
        return Decision("optimal", f"already optimal: what was held out fits no better: {told}", measures, change)
    if not held_out and not moved:
        return Decision("optimal", f"already optimal: {change}", measures, change)
    return Decision("refined", "; ".join(str(measure) for measure in measures) or "nothing measured", measures, change)

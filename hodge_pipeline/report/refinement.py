"""What became of a refinement, as reports show it."""

from __future__ import annotations

from hodge_pipeline.refine.guard import Decision
from hodge_pipeline.report.contents import MeasureRow, RefinementSummary

HEADLINES = {
    "refined": "Better than the poses given",
    "optimal": "The poses given were as good already: they are given back",
    "worse": "Worse than the poses given: those are given back",
    "forced": "Worse than the poses given, written all the same",
    "nothing": "Nothing could be refined: no poses are written",
}


def summary(decision: Decision) -> RefinementSummary:
    """The decision as the report shows it."""
    rows = tuple(MeasureRow(m.name, m.before, m.after, m.better, m.unit, m.is_worse) for m in decision.measures)
    change = "" if decision.change is None else f"The {decision.change}."
    return RefinementSummary(decision.outcome, HEADLINES[decision.outcome], decision.reason, rows, change)

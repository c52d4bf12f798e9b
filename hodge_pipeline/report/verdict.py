"""Whether the run made the poses better, and what a reader should distrust."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hodge_pipeline.evaluation.cloud_distance import NO_NEIGHBOUR_M
from hodge_pipeline.report.contents import GraphSummary, Report, TrajectoryRow
from hodge_pipeline.types import Floats

Outcome: TypeAlias = Literal["improved", "unchanged", "worse", "mixed", "not measured"]

SAME = 0.02
"""A relative change below this counts as none: a truth of the kind that RGB-D benchmarks have is no finer."""

LARGE_RESIDUAL_M = 0.1
LARGE_RESIDUAL_DEG = 5.0
UNMATCHED_SHARE = 0.01
UNSETTLED_M, UNSETTLED_SHARE = 0.05, 0.01
"""By how much (root mean square), and by which share of the path, the last of several rounds may move the positions.
Runs that end near the truth move by less than 1 cm, one whose edges slide along a bare floor by 30."""
NO_MEASURE = "there were neither overlapping clouds nor true poses to compare the poses by."


REFINEMENTS: dict[str, Outcome] = {
    "refined": "improved", "optimal": "unchanged", "worse": "worse", "forced": "worse",
    "nothing": "not measured",
}  # fmt: skip
VERBS = {1: "fell", 0: "hardly changed,", -1: "rose"}
GRAPH_NAMES = {"distance": "near-centroid pairs", "iou": "overlapping pairs"}


@dataclass(frozen=True)
class Change:
    """One error before and after, in metres, and by which share of itself it changed."""

    what: str
    before_m: float
    after_m: float

    @property
    def share(self) -> float:
        """−0.4 where the error fell by 40 %."""
        return (self.after_m - self.before_m) / self.before_m if self.before_m > 0 else float(self.after_m > 0)

    @property
    def sign(self) -> int:
        """1 better, −1 worse, 0 where the change is too small to count."""
        return 0 if abs(self.share) <= SAME else (1 if self.share < 0 else -1)

    def __str__(self) -> str:
        before, after = self.lengths
        return f"{self.what} {VERBS[self.sign]} from {before} to {after} ({percent(self.share)})"

    @property
    def lengths(self) -> tuple[str, str]:
        """Before and after in the same unit."""
        larger_m = max(self.before_m, self.after_m)
        return length(self.before_m, larger_m), length(self.after_m, larger_m)


@dataclass(frozen=True)
class Verdict:
    """The outcome in one word, in a headline, in detail, and the changes it rests on."""

    outcome: Outcome
    headline: str
    details: str
    changes: tuple[Change, ...]

    @property
    def sentence(self) -> str:
        """Headline and details in one."""
        return f"{self.headline}: {self.details}"


def judge(report: Report) -> Verdict:
    """The verdict on a report: every measured error counts, and where they disagree it is `mixed`.

    A refinement has been judged already, by its guard.
    """
    changes = (*_score_changes(report), *_trajectory_changes(report))
    if report.refinement is not None:
        refinement = report.refinement
        return Verdict(REFINEMENTS[refinement.outcome], refinement.headline, f"{refinement.reason}.", changes)
    if not changes:
        return Verdict("not measured", "Not measured", NO_MEASURE, ())
    signs = {change.sign for change in changes} - {0}
    outcome: Outcome = "unchanged" if not signs else "mixed" if len(signs) > 1 else _one_way(signs.pop())
    told = "; ".join(str(change) for change in changes)
    return Verdict(outcome, f"{outcome.capitalize()} against {report.before}", f"{told}.", changes)


def _one_way(sign: int) -> Outcome:
    return "improved" if sign > 0 else "worse"


def _score_changes(report: Report) -> Iterator[Change]:
    table = report.scores
    if table is None or report.before not in table.names or report.after not in table.names:
        return
    before, after = table.names.index(report.before), table.names.index(report.after)
    for graph in table.graphs:
        distance = graph.mean_distance_m
        if graph.counts[before] and graph.counts[after]:
            what = f"the mean distance of overlapping clouds ({GRAPH_NAMES[graph.kind]})"
            yield Change(what, float(distance[before]), float(distance[after]))


def _trajectory_changes(report: Report) -> Iterator[Change]:
    rows = {row.name: row for row in report.trajectories if row.frames}
    if report.before in rows and report.after in rows:
        before, after = rows[report.before].ate_rmse_m, rows[report.after].ate_rmse_m
        yield Change("the error of the trajectory (ATE)", before, after)


def suspicions(report: Report) -> tuple[str, ...]:
    """What a reader should distrust, one line each; the run's own notes come first."""
    graph = () if report.graph is None else tuple(_graph_suspicions(report.graph))
    return (
        *_unsettled(report),
        *report.notes,
        *graph,
        *_edge_suspicions(report),
        *_unmatched(report),
        *(line for row in report.trajectories for line in _trajectory_suspicions(row)),
    )


def _unsettled(report: Report) -> Iterator[str]:
    scale = report.scores.scale if report.scores else 1.0
    path_m = max((_path_m(path.positions) for path in report.pictures.paths if path.name == report.after), default=0.0)
    if report.last_shift_m is not None and report.last_shift_m > max(UNSETTLED_M * scale, UNSETTLED_SHARE * path_m):
        yield (
            "The result is not to be trusted: the last round still moved the cameras by "
            f"{length(report.last_shift_m)}, so the registered pairs do not agree on one scene. Frames nearer to each "
            "other, or more texture, would help."
        )


def _path_m(positions: Floats) -> float:
    return float(np.nansum(np.linalg.norm(np.diff(positions, axis=0), axis=1)))


def _graph_suspicions(graph: GraphSummary) -> Iterator[str]:
    if len(graph.components) > 1:
        yield (
            f"The viewing graph falls into {len(graph.components)} parts that nothing connects: "
            "their poses relative to each other mean nothing."
        )
    alone = sum(part.count == 1 for part in graph.components)
    if alone and graph.vertices > 1:
        yield f"{alone} of {graph.vertices} frames have no edge at all: they keep the pose they started with."
    if graph.edges_ignored:
        yield f"The solver ignored {graph.edges_ignored} of {graph.edges} edges (weight 0)."
    wrong, suspect = graph.verdicts_in_use.get("wrong", 0), graph.verdicts_in_use.get("suspect", 0)
    if wrong or suspect:
        yield (
            f"Of the edges that the solver used {wrong} are judged wrong and {suspect} suspect: hodge diagnose "
            "shows them."
        )
    if untestable := graph.verdicts.get("untestable", 0):
        yield f"{untestable} of {graph.edges} edges are untestable: nothing in the graph says whether they are right."


def _edge_suspicions(report: Report) -> Iterator[str]:
    large = [
        edge
        for edge in report.worst_edges
        if edge.weight > 0 and (edge.residual_m > _large_m(report) or edge.residual_deg > LARGE_RESIDUAL_DEG)
    ]
    if large:
        yield (
            f"At least {len(large)} edges that the solver used are more than {length(_large_m(report))} or "
            f"{LARGE_RESIDUAL_DEG:g}° off the result: see the worst edges."
        )


def _large_m(report: Report) -> float:
    return LARGE_RESIDUAL_M * (report.scores.scale if report.scores else 1.0)


def _unmatched(report: Report) -> Iterator[str]:
    if report.scores is None:
        return
    for graph in report.scores.graphs:
        for name, unmatched, count in zip(report.scores.names, graph.unmatched, graph.counts, strict=True):
            if unmatched > UNMATCHED_SHARE * count:
                pairs = f"{unmatched} of {count} {GRAPH_NAMES[graph.kind]}"
                yield f"{name}: {pairs} have no point within {length(graph.scale * NO_NEIGHBOUR_M)} of each other."


def _trajectory_suspicions(row: TrajectoryRow) -> Iterator[str]:
    if row.left_out:
        yield f"{row.name}: {row.left_out} frames without a true pose, or joined to no other, are not in its error."
    if row.degenerate:
        yield f"{row.name}: its positions lie on a line (or are fewer than three): its orientations aligned it."


def length(metres: float, unit_of_m: float | None = None) -> str:
    """A length with a unit that suits its size, or the size `unit_of_m` of another."""
    if not abs(metres) < float("inf"):
        return "–"
    size_m = abs(metres if unit_of_m is None else unit_of_m)
    if size_m < 0.025:
        return f"{metres * 1000:.3g} mm"
    return f"{metres * 100:.3g} cm" if size_m < 1 else f"{metres:.3g} m"


def percent(share: float) -> str:
    """A signed share in per cent, with a real minus sign."""
    return f"{share * 100:+.0f} %".replace("-", "−")

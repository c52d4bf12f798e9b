"""Whether the run made the poses better."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hodge_pipeline.evaluation.difference import MEASURABLE, Change
from hodge_pipeline.report.contents import GRAPH_NAMES, Report
from hodge_pipeline.report.suspicions import suspicions
from hodge_pipeline.types.notes import Note

Outcome: TypeAlias = Literal["improved", "unchanged", "worse", "mixed", "not measured"]

MOST_SIZES = 3
"""Pieces whose sizes a headline tells."""
NO_MEASURE = "nothing was there to compare the poses by, before and after."

REFINEMENTS: dict[str, Outcome] = {
    "refined": "improved", "solved": "improved", "optimal": "unchanged", "worse": "worse", "forced": "worse",
    "convention": "not measured", "nothing": "not measured",
}  # fmt: skip
LEADS = {
    "images missing": "{count} of {detail} are missing",
    "colour unpaired": "{count} of {detail} depth images have no colour image of their time or number",
    "colour paired anew": "colour is that of {detail}, which lies on depth",
    "other scale": "in another scale than the truth",
    "truth convention": "the truth seems to be in another convention",
    "truth clock": "{detail}",
    "truth unlike": "still poses would explain the registered motion better than the truth",
    "unsettled": "not settled",
    "tracking lost": "tracking was lost at {count} of {frames} frames",
    "images unread": "{count} of {frames} frames have images that cannot be read",
    "untestable": "nothing confirms {count} of {detail} edges",
}
REASONS = {
    "camera or object": "images contradict the camera's motion",
    "unheld": "what frames share lets them slide",
    "path loose": "the scans tell little of how far the scanner went",
    "reader's doubt": "the camera is assumed and images do not confirm it",
    "path scaled": "the path is of another size than the one given",
    "given unlike": "still poses would explain the registered motion better than those given",
    "mostly untested": "most of the poses given have no frame",
    "frames outside": "most frames lie outside the time of the poses given",
    "depth unit": "depth is probably not in metres",
    "colour beside depth": "depth seems not to be registered to colour",
    "colour of another moment": "colour seems to be of another moment than depth",
    "focal length": "images contradict the camera's focal length",
    "scan unit": "its unit seems not to be the metre",
    "sweeps in map": "the sweeps seem to be in map coordinates",
    "left apart": "a guess joins what tracking left apart",
    "wrong": "edges that it uses are judged wrong",
}
"""By kind of note, what a headline begins with (`LEADS`; those `OF_MOST` frames from `MOSTLY_LOST` on), and the reasons
of `in doubt, since …` (`REASONS`), whatever the measures say."""
OF_MOST = {"tracking lost", "images unread", "untestable"}
MOSTLY_LOST = 0.5
"""The share of the frames; of edges that nothing confirms, of the edges."""


@dataclass(frozen=True)
class Verdict:
    """The outcome of all measures in one word; a headline, which begins with doubts and the pieces of several; the
    details, and the changes they rest on. `reason` is why a refinement, or a solve, came out as it did.
    """

    outcome: Outcome
    headline: str
    details: str
    changes: tuple[Change, ...]
    pieces: int
    reason: str
    is_doubtful: bool

    @property
    def sentence(self) -> str:
        """Headline and details in one."""
        return f"{self.headline}. {capital(self.details)}"

    @property
    def points(self) -> tuple[str, ...]:
        """What the headline rests on, a short line each."""
        if not self.changes and not self.reason:
            return (capital(self.details),)
        return (*filter(None, [capital(self.reason)]), *(change.line for change in self.changes))

    @property
    def mark(self) -> Outcome:
        """What the page shows at a glance: a scene in doubt or in several pieces is no plain success, whatever the
        measures say.
        """
        return "mixed" if (self.pieces > 1 or self.is_doubtful) and self.outcome == "improved" else self.outcome


def judge(report: Report) -> Verdict:
    """The verdict on a report: every measured error counts, and where they disagree it is `mixed`.

    A refinement has been judged already, by its guard; an error against the truth that got worse is named all the same.
    """
    changes = (*_trajectory_changes(report), *_score_changes(report))
    outcome, headline, details = _judged(report, changes)
    pieces, reason = _pieces(report), report.refinement.reason if report.refinement else ""
    if pieces:
        all_joined = report.source.unordered and len(report.pieces) == 1 and outcome in ("improved", "unchanged")
        headline = pieces if all_joined else f"{pieces}: {headline[:1].lower()}{headline[1:]}"
    told = suspicions(report)
    apart = {"left apart"} if len(report.pieces) > 1 else set()  # then nothing joins them, and the headline says so
    reasons = " and ".join(REASONS[note.kind] for note in told if note.kind in REASONS.keys() - apart)
    frames = report.source.frames
    doubts = [
        LEADS[note.kind].format(count=note.count, detail=note.detail, frames=frames)
        for note in told
        if note.kind in LEADS and (note.kind not in OF_MOST or _is_most(note, frames))
    ]
    doubts += [f"in doubt, since {reasons}"] if reasons else []
    doubts += [report.refinement.doubt] if report.refinement and report.refinement.doubt else []
    headline = capital(": ".join(f"{text[:1].lower()}{text[1:]}" for text in (*doubts, headline)))
    return Verdict(outcome, headline, details, changes, max(len(report.pieces), 1), reason, bool(doubts))


def _is_most(note: Note, frames: int) -> bool:
    """Whether a note is on most of the frames, or of the edges, of which nothing confirms those of a tree."""
    return note.count > MOSTLY_LOST * (int(note.detail) if note.kind == "untestable" else frames)


def _judged(report: Report, changes: tuple[Change, ...]) -> tuple[Outcome, str, str]:
    better, worse = ([change for change in changes if change.sign == sign] for sign in (1, -1))
    but = ", ".join(change.briefly for change in worse)
    told = f"{'; '.join(str(change) for change in changes)}."
    if report.refinement is not None:
        refinement = report.refinement
        outcome = REFINEMENTS[refinement.outcome]
        if outcome == "improved" and worse:
            good = f" ({min(better, key=lambda change: change.share).briefly})" if better else ""
            return "mixed", f"{refinement.headline}{good}, but {but}", f"{refinement.reason}."
        return outcome, refinement.headline, f"{refinement.reason}."
    if not changes:
        return "not measured", "Not measured", report.unmeasured or NO_MEASURE
    if better and worse:
        good = min(better, key=lambda change: change.share).briefly
        good += f" and {len(better) - 1} more better" if len(better) > 1 else ""
        return "mixed", f"Mixed against {report.before}: {good}, but {but}", told
    outcome = "improved" if better else "worse" if worse else "unchanged"
    return outcome, f"{outcome.capitalize()} against {report.before}", told


def capital(text: str) -> str:
    """The text with its first letter large."""
    return text[:1].upper() + text[1:]


def _pieces(report: Report) -> str:
    """The components in words; empty where all frames are joined and that is expected."""
    graph, sizes = report.graph, report.pieces
    if graph is None or graph.vertices < 2:
        return ""
    of_all = f"of {graph.vertices} {report.source.vertex_name}"
    if not sizes:
        notes = {note.kind: note for note in report.notes}
        if (note := notes.get("ambiguous")) is not None:
            todo = "take scans in between, with furniture or targets in sight"
            return f"No two {of_all} joined, and {note.count} of {note.detail} pairs fit in several ways ({todo})"
        note = notes.get("none joined")
        return f"No two {of_all} joined" + (f" ({note.detail})" if note else "")
    told = sizes[0] < graph.vertices or report.source.unordered or report.source.kind == "scans"
    return in_pieces(sizes, graph.vertices, report.source.vertex_name) if told else ""


def in_pieces(sizes: Sequence[int], vertices: int, name: str) -> str:
    """In words the pieces that join at least two vertices, most first, and how many vertices are alone."""
    of_all = f"of {vertices} {name}"
    if len(sizes) == 1:
        return f"{sizes[0]} {of_all} joined"
    listed = [str(size) for size in sizes[:MOST_SIZES]] + ["…"] * (len(sizes) > MOST_SIZES)
    alone = vertices - sum(sizes)
    return f"In {len(sizes)} pieces ({', '.join(listed)} {of_all}{f'; {alone} alone' if alone else ''})"


def _score_changes(report: Report) -> Iterator[Change]:
    table = report.scores
    if table is None or report.before not in table.names or report.after not in table.names:
        return
    before, after = table.names.index(report.before), table.names.index(report.after)
    for graph in table.graphs:
        distance = graph.mean_distance_m
        if graph.counts[before] and graph.counts[after]:
            name = GRAPH_NAMES[graph.kind]
            what, short = f"the mean distance of overlapping clouds ({name})", f"distance of clouds ({name})"
            yield Change(what, short, float(distance[before]), float(distance[after]), report.floor_m)


def _trajectory_changes(report: Report) -> Iterator[Change]:
    rows = {row.name: row for row in report.trajectories if row.frames}
    if report.before not in rows or report.after not in rows:
        return
    before, after = rows[report.before], rows[report.after]
    floor = report.floor_m
    yield Change("the error of the trajectory (ATE)", "ATE", before.ate_rmse_m, after.ate_rmse_m, floor)
    largest = Change("the largest error of a position", "largest error", before.ate_max_m, after.ate_max_m, floor)
    if largest.sign < 0:
        yield largest
    if not np.isfinite(before.rpe_translation_m):
        return
    step = "from frame to frame" if before.rpe_delta_frames == 1 else f"over {before.rpe_delta_frames} frames"
    what = f"the error of the motion {step} (RPE)"
    yield Change(what, "RPE", before.rpe_translation_m, after.rpe_translation_m, floor)
    what, floor_deg = f"the error of the rotation {step} (RPE)", float(np.rad2deg(MEASURABLE))
    yield Change(what, "RPE of the rotation", before.rpe_rotation_deg, after.rpe_rotation_deg, floor_deg, "°")

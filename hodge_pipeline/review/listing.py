"""What a page shows as JSON: the state, the table of edges in parts, filtered and sorted, and one edge in detail."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.diagnosis.result import WORST_FIRST
from hodge_pipeline.diagnosis.wording import cycle_error, name_cycle
from hodge_pipeline.pairs.edits import pair_names
from hodge_pipeline.review.adding import Candidate
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.settle import Judged
from hodge_pipeline.types import Bools, Ints, Words


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Query:
    """Which edges to list, in which order, and which part: `count` of them from the row `first` on.

    `verdicts`: none means all; `min_gap` in frames between the ends; `frame`: edges of this vertex id alone.
    """

    verdicts: tuple[str, ...] = ()
    min_gap: int = 0
    min_residual_m: float = 0.0
    frame: str = ""
    sort: Literal["score", "residual", "turn", "gap", "cycles", "name"] = "score"
    descending: bool = False
    first: Annotated[int, Field(ge=0)] = 0
    count: Annotated[int, Field(ge=1, le=500)] = 100


def list_edges(session: Session, query: Query) -> dict[str, Any]:
    """How many edges match the query (`total`), and the part of them that it asks for."""
    with session.changed:
        table, settled, judged = session.table, session.settled, session.judged
        switches = table.switches(session.decisions.history)
        revision, selected = session.decisions.revision, session.look.selected
    edges, ids = table.edges, table.graph.vertex_ids
    passing, closing = cycle_counts(judged, len(edges))
    known = np.isin(np.arange(len(edges)), () if judged is None else judged.rows)
    rows = np.flatnonzero(_wanted(session, query))
    rows = rows[_order(session, query, rows, passing - closing)]
    total, rows = len(rows), rows[query.first : query.first + query.count]
    listed = [
        {
            "row": row,
            "name": name,
            "verdict": str(edges.verdict[row]),
            "score": _number(edges.probability[row]),
            "residual_m": _number(settled.residual_m[row]),
            "residual_deg": _number(np.degrees(settled.residual_rad[row])),
            "gap": int(abs(np.diff(table.graph.edges[row])[0])),
            "source": str(edges.proposed_by[row]),
            "cycles": int(passing[row]) if known[row] else None,
            "closing": int(closing[row]),
            "counts": bool(settled.weights[row] > 0),
            "status": str(edges.status[row]),
            "decision": str(switches[row]),
            "reason": session.subject.worded(str(edges.why[row])),
        }
        for row, name in zip(rows.tolist(), pair_names(ids, table.graph.edges[rows]), strict=True)
    ]
    place = {"revision": revision, "selected": selected}
    return {"total": total, "first": query.first, "edges": listed, **place}


def _wanted(session: Session, query: Query) -> Bools:
    """The edges (E,) that match the query."""
    table, settled = session.table, session.settled
    pairs = table.graph.edges
    wanted = np.abs(pairs[:, 0] - pairs[:, 1]) >= query.min_gap
    if query.verdicts:
        wanted &= np.isin(table.edges.verdict, query.verdicts)
    if query.min_residual_m > 0:
        wanted &= ~(settled.residual_m < query.min_residual_m)
    if query.frame:
        wanted &= (table.graph.vertex_ids[pairs].astype(str) == query.frame).any(axis=1)
    return np.asarray(wanted)


def _order(session: Session, query: Query, rows: Ints, failing: Ints) -> Ints:
    """The order of the rows, the worst first, or last where `descending`; `failing (E,)` counts cycles that fail.

    Ties of the score are broken by the residuals at the first poses, so that edges keep their places while decisions
    move the poses.
    """
    edges, settled, pairs = session.table.edges, session.settled, session.table.graph.edges
    residual_m = np.nan_to_num(settled.residual_m[rows], nan=np.inf)
    first_m = np.full(len(edges), np.inf)
    first_m[: len(session.first.residual_m)] = np.nan_to_num(session.first.residual_m, nan=np.inf)
    shown = np.nan_to_num(edges.probability[rows], nan=0.5).round(2)  # as the page has it, so that equal ones tie
    keys: dict[str, tuple[Any, ...]] = {
        "score": (-first_m[rows], shown, _ranks(edges.verdict[rows])),
        "residual": (-residual_m,),
        "turn": (-np.nan_to_num(settled.residual_rad[rows], nan=np.inf),),
        "gap": (-np.abs(pairs[rows, 0] - pairs[rows, 1]),),
        "cycles": (-failing[rows],),
        "name": (pairs[rows, 1], pairs[rows, 0]),
    }
    order = np.lexsort(keys[query.sort])
    return order[::-1] if query.descending else order


def _ranks(verdict: Words) -> Ints:
    """The place of each verdict in the order of the report, unknown ones last."""
    places = {name: place for place, name in enumerate(WORST_FIRST)}
    return np.array([places.get(str(one), len(places)) for one in verdict], np.int64)


def cycle_counts(judged: Judged | None, count: int) -> tuple[Ints, Ints]:
    """How many cycles pass through each edge (E,), and how many of these close; zeros while nothing is judged."""
    passing, closing = np.zeros(count, np.int64), np.zeros(count, np.int64)
    if judged is not None:
        cycles, rows = judged.diagnosis.cycles, judged.rows
        closes = np.repeat(cycles.closes, cycles.loops.lengths)
        passing[rows] = np.bincount(cycles.loops.edge, minlength=len(rows))
        closing[rows] = np.bincount(cycles.loops.edge, closes, len(rows)).astype(np.int64)
    return passing, closing


def describe(session: Session, edge: int) -> dict[str, Any]:
    """The selected edge in detail: its cycles that close and that fail. Raises `GraphError` for no edge."""
    with session.changed:
        table, judged = session.table, session.judged
    table.check_row(edge)
    cycles = [
        {"closes": one.closes, "text": one.frames, "error": session.subject.worded(one.error)}
        for one in witnesses(session, edge)
    ]
    (name,) = pair_names(table.graph.vertex_ids, table.graph.edges[[edge]])
    beside = len(table.rows[name])
    known = judged is not None and judged.row(edge) is not None
    return {"row": edge, "name": name, "cycles": cycles, "beside": beside, "known": known}


class Witness(NamedTuple):
    """A cycle through an edge: whether it closes, its frames and error in words, and its vertex rows `along (n,)`."""

    closes: bool
    frames: str
    error: str
    along: Ints


def witnesses(session: Session, edge: int) -> list[Witness]:
    """The cycles for and against an edge; none while it is not judged."""
    judged, table = session.judged, session.table
    if judged is None or (row := judged.row(edge)) is None:
        return []
    found, graph = judged.diagnosis, table.graph.select(judged.rows)
    out = []
    for closes, telling in ((True, found.witnesses_for[row]), (False, found.witnesses_against[row])):
        for cycle in telling[telling >= 0].tolist():
            along = found.cycles.loops.select(np.array([cycle])).vertices(graph.edges)
            words = name_cycle(graph, found.cycles, cycle), cycle_error(found.cycles, cycle)
            out.append(Witness(closes, *words, along))
    return out


def state(session: Session) -> dict[str, Any]:
    """All that a page shows beside the table; the keys are those that `page.js` reads."""
    with session.changed:
        table, settled, decisions = session.table, session.settled, session.decisions
        counted = settled.weights > 0
        words, counts = np.unique(table.edges.verdict, return_counts=True)
        latest, candidate = decisions.history.latest, session.candidate
        look = session.look
        return {
            "version": session.version,
            "revision": decisions.revision,
            "settled_revision": settled.revision,
            "name": session.subject.name,
            "path": str(session.subject.path),
            "locked": session.locked,
            "message": session.message,
            "doing": session.quick.doing or session.slow.doing,
            "is_run": session.subject.is_run,
            "finish": session.subject.finish,
            "unit": session.subject.unit,
            "has_clouds": session.subject.clouds is not None,
            "notes": list(session.subject.notes),
            "verdicts": dict(zip(words.tolist(), counts.tolist(), strict=True)),
            "poses": len(settled.world_from_cam),
            "edges": len(table),
            "counting": int(counted.sum()),
            "disabled": session.disabled,
            "pieces": int(settled.component.max(initial=-1)) + 1,
            "seconds": round(settled.seconds, 4),
            "moved_m": _number(settled.moved_m),
            "error_m": None if settled.error_m is None else _number(settled.error_m),
            "first_error_m": None if session.first.error_m is None else _number(session.first.error_m),
            "converged": settled.converged,
            "latest": "" if latest is None else str(decisions.history.edits[latest]),
            "can_undo": latest is not None,
            "can_redo": decisions.can_redo,
            "to_register": session.missing(),
            "look": {**vars(look), "picked": [_name(session, row) for row in look.picked]},
            "candidate": None if candidate is None else _candidate(session, candidate),
        }


def _name(session: Session, row: int) -> str:
    """The id of a vertex, as the source has it."""
    return str(session.table.graph.vertex_ids[row])


def _candidate(session: Session, candidate: Candidate) -> dict[str, Any]:
    found = candidate.found
    return {
        "pair": f"{_name(session, candidate.i)}-{_name(session, candidate.j)}",
        "registered": found is not None,
        "guess_by": candidate.guess_by,
        "fitness": None if found is None else _number(found.fitness),
        "rmse_m": None if found is None else _number(found.rmse_m),
        "rejected": candidate.rejected,
        "points": min(len(candidate.points_i), len(candidate.points_j)),
        "residual_m": _number(candidate.residual_m),
        "residual_deg": _number(candidate.residual_deg),
    }


def _number(value: Any) -> float | None:
    """A number of five digits for JSON, which has no NaN: None."""
    return float(f"{value:.5g}") if np.isfinite(value) else None

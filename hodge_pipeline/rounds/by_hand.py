"""The round that a person's edits add to a run: edges of the last one switched off or on, and newly registered ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.pairs.edits import ENABLED, REGISTERED, RIGHT, History, joining, read_history, vertex_rows
from hodge_pipeline.rounds.more import Placed, register_more
from hodge_pipeline.rounds.one_round import EDITED, Registered, Work
from hodge_pipeline.scene import Round
from hodge_pipeline.start.unordered.folds import laid_apart
from hodge_pipeline.store.workspace import EDITS_FILE
from hodge_pipeline.types import Edges, Floats, ViewGraph
from hodge_pipeline.types.edges import DISABLED, HELD_OUT, REJECTED, USED
from hodge_pipeline.types.notes import Note

BY_HAND = "by_hand"
UNKNOWN = np.full((4, 4), np.nan)
NEXT = "hodge edit --list shows them, hodge edit --undo takes the last back"


def edited_rounds(work: Work, folder: Path, rounds: Sequence[Round]) -> Iterator[Registered]:
    """One more round, that of the edits in the run folder; nothing where there are none.

    It begins at the poses of the earlier round that its edges agree with best, since those after a wrong edge may be
    far off, and is solved by the recipe's solver.
    """
    last, history = rounds[-1], read_history(folder / EDITS_FILE)
    if not history.switches:
        return
    ids, registered, before = last.vertex_ids, last.registered(work.measured), last.world_from_cam
    edges, fresh = _edited(work, registered, history), np.zeros(0, np.int64)
    if history.registered:
        placed = _placed(work, edges.as_graph(ids, edges.counts))
        before, pairs = placed.world_from_cam, vertex_rows(ids, history.registered)
        guesses = np.array([history.guesses.get(pair, UNKNOWN) for pair in history.registered])
        new = register_more(work, "registration, by hand", BY_HAND, pairs, placed, guesses)
        edges = _edited(work, Edges.joined([registered, new]), history)
        fresh = np.arange(len(registered), len(registered) + len(new))
    _tell(work, edges.select(edges.status != HELD_OUT), ids, history)
    start = _start(work, edges.as_graph(ids, edges.counts), rounds)
    yield Registered(EDITED, edges, fresh, before, start, edges.counts & joining(ids, edges.pairs, *history.right))


def _placed(work: Work, graph: ViewGraph) -> Placed:
    found = diagnose(graph, work.recipe.diagnosis)
    return Placed(laid_apart(found.piece, found.world_from_cam, work.scene.clouds), found.piece)


def _start(work: Work, graph: ViewGraph, rounds: Sequence[Round]) -> Floats:
    """The poses of the round with the least mean residual of the edges, the latest of equals; robust poses by the edges
    themselves where they join components that no round had joined.
    """

    def distance(one: Round) -> float:
        translation_m, angle_rad = edge_residuals(graph, one.world_from_cam)
        known = np.hypot(translation_m, se3.ARM_M * float(work.recipe.scale) * angle_rad)
        return float(np.nanmean(known)) if np.isfinite(known).any() else np.inf

    apart = connected_components(rounds[-1].graph.edges, graph.vertex_count)
    if (apart[graph.edges[:, 0]] != apart[graph.edges[:, 1]]).any():
        return _placed(work, graph).world_from_cam
    return min(reversed(rounds), key=distance).world_from_cam


def _edited(work: Work, registered: Edges, history: History) -> Edges:
    """The table with the status of every pair by its acceptance, then by the edits."""
    edges = Edges.joined([work.accept(registered), Edges.measured(work.measured)])
    let_in = (edges.status == REJECTED) & joining(work.measured.vertex_ids, edges.pairs, *history.enabled)
    edges = edges.put(let_in, status=USED, why="")
    off = edges.in_graph & joining(work.measured.vertex_ids, edges.pairs, *history.disabled)
    return edges.put(off, status=DISABLED)


def _tell(work: Work, edges: Edges, vertex_ids: NDArray[np.generic], history: History) -> None:
    for word in (DISABLED, ENABLED, RIGHT, REGISTERED):
        if pairs := [pair for pair, switch in history.switches.items() if switch == word]:
            work.steps.note(Note("edited", len(pairs), f"{word} {', '.join(pairs)} ({NEXT})"))
    found = {pair: joining(vertex_ids, edges.pairs, pair) for pair in history.switches}
    if lost := [pair for pair, rows in found.items() if not rows.any()]:
        work.steps.note(Note("edit lost", len(lost), ", ".join(lost)))
    for pair in history.registered:
        rows = edges.select(found[pair])
        if len(rows) and not rows.in_graph.any():
            told = f"{pair} was registered and rejected, {rows.why[-1]}: --enable {pair} lets it in all the same"
            work.steps.note(Note("edit rejected", detail=told))

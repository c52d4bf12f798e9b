"""The round that a person's edits add to a run: the last one's edges, some switched off or on, some registered anew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import steps
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.pairs.edits import ENABLED, REGISTERED, History, joining, read_history, vertex_rows
from hodge_pipeline.pairs.more import MoreRound, Placed, register_more
from hodge_pipeline.registration.acceptance import accepted
from hodge_pipeline.scene import Round
from hodge_pipeline.stages import Workers
from hodge_pipeline.start.unordered.pieces import laid_apart
from hodge_pipeline.store.job import Job
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Source, ViewGraph
from hodge_pipeline.types.edges import DISABLED, HELD_OUT, REJECTED, USED

ARM_M = 1.0
"""A residual rotation counts as its arc at this distance."""
BY_HAND = "by_hand"
NEXT = "hodge edit --list shows them, hodge edit --undo takes the last back"


def edited_rounds(
    job: Job, source: Source, measured: ViewGraph, rounds: Sequence[Round], workers: Workers
) -> Iterator[MoreRound]:
    """One more round, that of the edits in the run folder; nothing where there are none.

    It begins at the poses of the earlier round that its edges agree with best, since those after a wrong edge may be
    far off, and is solved by the recipe's solver. Its stages' keys hold what the edits come to, so that a run that is
    resumed has them too, and one whose edits are undone is as it was.
    """
    number, last = len(rounds), rounds[-1]
    history = read_history(job.workspace.folder)
    if not history.switches:
        return
    ids, registered, before = last.vertex_ids, last.registered(measured), last.world_from_cam
    edges, new = _edited(job, registered, measured, history), Edges.of([])
    inputs: tuple[str, ...] = (f"register-{number - 1}", f"solve-{number - 1}")
    if history.registered:
        placed = _placed(job, edges.select(edges.counts).as_graph(ids))
        before, pairs = placed.world_from_cam, vertex_rows(ids, history.registered)
        title = "registration, by hand"
        new = register_more(job, number, title, BY_HAND, source, pairs, placed, workers, inputs)
        edges = _edited(job, Edges.joined([registered, new]), measured, history)
        new = edges.select(np.arange(len(registered), len(registered) + len(new)))
        inputs = (*inputs, f"register-{number}")
    _tell(job, edges.select(edges.status != HELD_OUT), ids, history)
    options = (job.recipe.solver, history.switches)
    with job.stage(f"solve-{number}", "solve, edited", 1, options, inputs) as (folder, advance):
        if not folder.finished:
            kept = edges.select(edges.counts).as_graph(ids)
            solution = job.recipe.solver.solve(kept, _start(job, kept, rounds))
            weights = np.zeros(len(edges))
            weights[edges.counts] = solution.weights
            solution = replace(solution, weights=weights[edges.in_graph])
            steps.save_round(folder.path, edges, ids, solution)
            for note in solution.notes:
                job.note(f"edited: {note}")
            advance(1)
    edited = replace(steps.load_round(job.path(f"solve-{number}")), edited=True)
    yield MoreRound(edited, new, before)


def _placed(job: Job, graph: ViewGraph) -> Placed:
    found = diagnose(graph, job.recipe.diagnosis)
    clouds = CloudSet.open(job.path("clouds"))
    return Placed(laid_apart(found.piece, found.world_from_cam, clouds), found.piece)


def _start(job: Job, graph: ViewGraph, rounds: Sequence[Round]) -> Floats:
    """The poses of the round, the latest of equals, that the edges are nearest to on average; the robust ones of the
    edges themselves where they join what no round had joined.
    """

    def distance(one: Round) -> float:
        translation_m, angle_rad = edge_residuals(graph, one.world_from_cam)
        known = np.hypot(translation_m, ARM_M * angle_rad)
        return float(np.nanmean(known)) if np.isfinite(known).any() else np.inf

    apart = connected_components(rounds[-1].graph.edges, graph.vertex_count)
    if (apart[graph.edges[:, 0]] != apart[graph.edges[:, 1]]).any():
        return _placed(job, graph).world_from_cam
    return min(reversed(rounds), key=distance).world_from_cam


def _edited(job: Job, registered: Edges, measured: ViewGraph, history: History) -> Edges:
    """Every pair of a round as its acceptance and then the edits have it."""
    edges = Edges.joined([accepted(job, registered), Edges.measured(measured)])
    let_in = (edges.status == REJECTED) & _any_joining(edges, measured.vertex_ids, history.enabled)
    edges = edges.put(let_in, status=USED, why="")
    off = edges.in_graph & _any_joining(edges, measured.vertex_ids, history.disabled)
    return edges.put(off, status=DISABLED)


def _any_joining(edges: Edges, vertex_ids: NDArray[np.generic], pairs: tuple[str, ...]) -> Bools:
    found = np.zeros(len(edges), bool)
    for pair in pairs:
        found |= joining(vertex_ids, edges.pairs, pair)
    return found


def _tell(job: Job, edges: Edges, vertex_ids: NDArray[np.generic], history: History) -> None:
    for word in (DISABLED, ENABLED, REGISTERED):
        if pairs := [pair for pair, switch in history.switches.items() if switch == word]:
            job.note(f"edited by hand: {word} {', '.join(pairs)} ({NEXT})")
    found = {pair: joining(vertex_ids, edges.pairs, pair) for pair in history.switches}
    if lost := [pair for pair, rows in found.items() if not rows.any()]:
        job.note(f"edits without effect, since the last round has no such edge: {', '.join(lost)}")
    for pair in history.registered:
        rows = edges.select(found[pair])
        if len(rows) and not rows.in_graph.any():
            job.note(f"{pair} was registered and rejected, {rows.why[-1]}: --enable {pair} lets it in all the same")

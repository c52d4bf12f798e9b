"""The round that a person's edits add to a run: the last one's edges, some switched off or on, some registered anew."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.pairs.edits import DISABLED, ENABLED, REGISTERED, History, joining, read_history, vertex_rows
from hodge_pipeline.pairs.more import MoreRound, Placed, register_more, with_more
from hodge_pipeline.registration.acceptance import rejections
from hodge_pipeline.registration.pairs import Registered
from hodge_pipeline.rounds import Round
from hodge_pipeline.sources.measured_edges import joined
from hodge_pipeline.stages import Workers
from hodge_pipeline.start.unordered.pieces import laid_apart
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.types import Bools, Candidates, CloudSet, Floats, Source, ViewGraph

ARM_M = 1.0
"""A residual rotation counts as its arc at this distance."""
BY_HAND = "by_hand"
NEXT = "hodge edit --list shows them, hodge edit --undo takes the last back"


@dataclass(frozen=True)
class _Edges:
    """Every edge of a round and every pair that is none: `reasons (E,)` why, empty where it is one; `disabled (E,)`."""

    graph: ViewGraph
    reasons: NDArray[np.str_]
    chosen: Bools
    disabled: Bools

    @property
    def kept(self) -> ViewGraph:
        """The edges that count."""
        return self.graph.select(self.chosen & ~self.disabled)


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
    if not history.switches or last.candidates is None or last.registered is None:
        return
    edges = _edited(job, last.candidates, last.registered, measured, history)
    candidates, registered, new = last.candidates, last.registered, last.registered.select(np.zeros(0, np.int64))
    before, inputs = last.world_from_cam, [f"register-{number - 1}", f"solve-{number - 1}"]
    if history.registered:
        placed = _placed(job, edges.kept)
        before, pairs = placed.world_from_cam, vertex_rows(measured.vertex_ids, history.registered)
        new = register_more(job, number, "registration, by hand", source, pairs, placed, workers, tuple(inputs))
        candidates, registered = with_more(candidates, new.pairs, BY_HAND), Registered.joined([registered, new])
        edges = _edited(job, candidates, registered, measured, history)
        inputs.append(f"register-{number}")
    _tell(job, edges, history)
    graph, off = edges.graph.select(edges.chosen), edges.disabled[edges.chosen]
    options = (job.recipe.solver, history.switches)
    with job.stage(f"solve-{number}", "solve, edited", 1, options, tuple(inputs)) as (folder, advance):
        if not folder.finished:
            solution = job.recipe.solver.solve(edges.kept, _start(job, edges.kept, rounds))
            weights = np.zeros(graph.edge_count)
            weights[~off] = solution.weights
            artifacts.save_solution(folder.path / "solution.npz", replace(solution, weights=weights))
            for note in solution.notes:
                job.note(f"edited: {note}")
            advance(1)
    solution = artifacts.load_solution(job.path(f"solve-{number}") / "solution.npz")
    rejected = edges.graph.edges[~edges.chosen], edges.reasons[~edges.chosen]
    edited = Round(graph, solution.world_from_cam, candidates, registered, solution, *rejected, disabled=off)
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


def _edited(job: Job, candidates: Candidates, registered: Registered, measured: ViewGraph, history: History) -> _Edges:
    graph = joined([registered.as_graph(measured.vertex_ids, candidates.source), measured])
    reasons = rejections(job, registered)
    reasons = np.concatenate([reasons, np.full(measured.edge_count, "", reasons.dtype)])
    chosen = (reasons == "") | _any_joining(graph, history.enabled)
    return _Edges(graph, reasons, chosen, _any_joining(graph, history.disabled))


def _any_joining(graph: ViewGraph, pairs: tuple[str, ...]) -> Bools:
    found = np.zeros(graph.edge_count, bool)
    for pair in pairs:
        found |= joining(graph, pair)
    return found


def _tell(job: Job, edges: _Edges, history: History) -> None:
    for word in (DISABLED, ENABLED, REGISTERED):
        if pairs := [pair for pair, switch in history.switches.items() if switch == word]:
            job.note(f"edited by hand: {word} {', '.join(pairs)} ({NEXT})")
    found = {pair: joining(edges.graph, pair) for pair in history.switches}
    if lost := [pair for pair, rows in found.items() if not rows.any()]:
        job.note(f"edits without effect, since the last round has no such edge: {', '.join(lost)}")
    for pair in history.registered:
        rows = found[pair]
        if rows.any() and not edges.chosen[rows].any():
            reason = edges.reasons[rows][-1]
            job.note(f"{pair} was registered and rejected, {reason}: --enable {pair} lets it in all the same")

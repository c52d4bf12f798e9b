"""The round that a person's edits add to a run: the last one's edges, some switched off or on, solved again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hodge_pipeline import artifacts
from hodge_pipeline.edits import DISABLED, ENABLED, History, joining, read_history
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.job import Job
from hodge_pipeline.measured import joined
from hodge_pipeline.registration.pairs import Registered
from hodge_pipeline.rounds import Round
from hodge_pipeline.types import Bools, Floats, ViewGraph

ARM_M = 1.0
"""A residual rotation counts as its arc at this distance."""
NEXT = "hodge edit --list shows them, hodge edit --undo takes the last back"


def edited_rounds(job: Job, registered: Registered, measured: ViewGraph, rounds: Sequence[Round]) -> tuple[Round, ...]:
    """One more round, that of the edits in the run folder; nothing where there are none.

    It begins at the poses of the earlier round that its edges agree with best, since those after a wrong edge may be
    far off, and is solved by the recipe's solver. Its stage's key holds what the
    edits come to, so that a run that is resumed has them too, and one whose edits are undone is as it was.
    """
    number, last = len(rounds), rounds[-1]
    history = read_history(job.workspace.folder)
    if not history.switches or last.candidates is None:
        return ()
    everything = joined([registered.as_graph(last.graph.vertex_ids, last.candidates.source), measured])
    _tell(job, everything, history)
    reasons = job.recipe.acceptance.reasons(registered)
    reasons = np.concatenate([reasons, np.full(measured.edge_count, "", reasons.dtype)])
    chosen = (reasons == "") | _any_joining(everything, history.enabled)
    graph = everything.select(chosen)
    disabled = _any_joining(graph, history.disabled)
    options = (job.recipe.solver, history.switches)
    inputs = (f"register-{number - 1}", f"solve-{number - 1}")
    with job.stage(f"solve-{number}", "solve, edited", 1, options, inputs) as (folder, advance):
        if not folder.finished:
            kept = graph.select(~disabled)
            solution = job.recipe.solver.solve(kept, _start(kept, rounds))
            weights = np.zeros(graph.edge_count)
            weights[~disabled] = solution.weights
            artifacts.save_solution(folder.path / "solution.npz", replace(solution, weights=weights))
            for note in solution.notes:
                job.note(f"edited: {note}")
            advance(1)
    solution = artifacts.load_solution(job.path(f"solve-{number}") / "solution.npz")
    rejected = everything.edges[~chosen], reasons[~chosen]
    return (Round(graph, solution.world_from_cam, last.candidates, solution, *rejected, disabled=disabled),)


def _start(graph: ViewGraph, rounds: Sequence[Round]) -> Floats:
    """The poses of the round, the latest of equals, that the edges are nearest to on average."""

    def distance(one: Round) -> float:
        translation_m, angle_rad = edge_residuals(graph, one.world_from_cam)
        known = np.hypot(translation_m, ARM_M * angle_rad)
        return float(np.nanmean(known)) if np.isfinite(known).any() else np.inf

    return min(reversed(rounds), key=distance).world_from_cam


def _any_joining(graph: ViewGraph, pairs: tuple[str, ...]) -> Bools:
    found = np.zeros(graph.edge_count, bool)
    for pair in pairs:
        found |= joining(graph, pair)
    return found


def _tell(job: Job, graph: ViewGraph, history: History) -> None:
    for word, pairs in ((DISABLED, history.disabled), (ENABLED, history.enabled)):
        if pairs:
            job.note(f"edited by hand: {word} {', '.join(pairs)} ({NEXT})")
    lost = [pair for pair in history.switches if not joining(graph, pair).any()]
    if lost:
        job.note(f"edits without effect, since the last round has no such edge: {', '.join(lost)}")

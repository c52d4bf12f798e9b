"""The rounds that a run adds by itself: it registers the pairs that its diagnosis suggests, and solves with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline import steps
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.result import UNTESTABLE
from hodge_pipeline.diagnosis.suggestions import suggest_pairs
from hodge_pipeline.pairs.candidates import labelled
from hodge_pipeline.pairs.more import MoreRound, Placed, register_more, with_more
from hodge_pipeline.refine.verdict import held_out_pairs
from hodge_pipeline.registration.acceptance import rejections
from hodge_pipeline.registration.pairs import Registered
from hodge_pipeline.rounds import Round
from hodge_pipeline.sources.measured_edges import joined
from hodge_pipeline.stages import Workers
from hodge_pipeline.start.unordered.pieces import laid_apart
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.types import Candidates, CloudSet, Floats, Ints, Source, ViewGraph

SUGGESTED = "suggested"


@dataclass(frozen=True)
class _Proposal:
    """Pairs (P, 2) to register, the robust poses, and how many edges could not be tested."""

    pairs: Ints
    placed: Placed
    untestable: int


def suggested_rounds(
    job: Job, source: Source, clouds: CloudSet, measured: ViewGraph, rounds: Sequence[Round], workers: Workers
) -> Iterator[MoreRound]:
    """As many rounds as the recipe's `suggestions` allow and are of use, each after the last of `rounds`, which the
    caller extends by it.
    """
    tried = _held_out(job)
    for number in range(len(rounds), len(rounds) + job.recipe.suggestions.rounds):
        last = rounds[-1]
        proposal = _propose(job, number, source, clouds, last, tried)
        if not len(proposal.pairs) or last.candidates is None or last.registered is None:
            return
        tried = np.concatenate([tried, proposal.pairs])
        title = f"registration, suggested, round {number}"
        inputs = (f"edges-{number}",)
        new = register_more(job, number, title, source, proposal.pairs, proposal.placed, workers, inputs)
        new, start = _judged(job, last, new, proposal, clouds)
        registered = Registered.joined([last.registered, new])
        candidates = with_more(last.candidates, new.pairs, SUGGESTED)
        found = steps.solve(job, number, source, candidates, registered, start, measured)
        accepted = int((rejections(job, new) == "").sum())
        job.note(
            f"round {number}: of {len(proposal.pairs)} suggested pairs {accepted} became edges; before it "
            f"{proposal.untestable} of {last.graph.edge_count} edges could not be tested"
        )
        yield MoreRound(found, new, proposal.placed.world_from_cam)


def _propose(job: Job, number: int, source: Source, clouds: CloudSet, last: Round, tried: Ints) -> _Proposal:
    """Stage `edges-<number>`: what is worth registering after the last round."""
    options, name = job.recipe.suggestions, f"edges-{number}"
    keyed, inputs = (options, job.recipe.diagnosis), ("clouds", f"solve-{number - 1}")
    with job.stage(name, f"suggestions, round {number}", 1, keyed, inputs) as (folder, advance):
        if not folder.finished:
            found = diagnose(last.graph, job.recipe.diagnosis)
            known = last.graph.edges if last.registered is None else last.registered.pairs
            poses = laid_apart(found.piece, found.world_from_cam, clouds)
            told = suggest_pairs(
                last.graph,
                found,
                options.pairs,
                overlapping=options.among.propose(source.frames, clouds, poses).pairs,
                tried=np.concatenate([known, tried]),
            )
            told = told.select(told.score >= options.min_gain)
            artifacts.save(folder.path / "candidates.npz", labelled(told.pairs, SUGGESTED))
            untestable = np.array((found.verdict == UNTESTABLE).sum())
            arrays = {"world_from_cam": poses, "piece": found.piece, "untestable": untestable}
            artifacts.save_arrays(folder.path / "poses.npz", arrays)
            advance(1)
    pairs = artifacts.load(job.path(name) / "candidates.npz", Candidates).pairs
    stored = artifacts.load_arrays(job.path(name) / "poses.npz")
    placed = Placed(stored["world_from_cam"], stored["piece"])
    return _Proposal(pairs, placed, int(stored["untestable"]))


def _judged(job: Job, last: Round, new: Registered, proposal: _Proposal, clouds: CloudSet) -> tuple[Registered, Floats]:
    """The new registrations and the poses to solve from.

    What joins two pieces is kept where the diagnosis of all edges together keeps it, and begins at its robust poses:
    the pieces had no common frame before.
    """
    across = proposal.placed.across(new.pairs)
    if not across.any():
        return new, last.world_from_cam
    accepted = rejections(job, new) == ""
    graph = joined([last.graph, new.as_graph(last.graph.vertex_ids, np.full(len(new.pairs), SUGGESTED))])
    weighed = np.append(np.ones(last.graph.edge_count, bool), accepted)
    found = diagnose(graph.select(weighed), job.recipe.diagnosis)
    kept = np.zeros(len(new.pairs), bool)
    kept[accepted] = found.kept[last.graph.edge_count :]
    return new.select(~across | kept), laid_apart(found.piece, found.world_from_cam, clouds)


def _held_out(job: Job) -> Ints:
    return np.zeros((0, 2), np.int64) if job.given is None else held_out_pairs(job)

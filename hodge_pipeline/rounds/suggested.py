"""The rounds that a run adds by itself: it registers the pairs that its diagnosis suggests, and solves with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline import steps
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.result import UNTESTABLE
from hodge_pipeline.diagnosis.suggestions import suggest_pairs
from hodge_pipeline.pairs.more import MoreRound, Placed, register_more
from hodge_pipeline.refine.verdict import held_out_pairs
from hodge_pipeline.registration.acceptance import accepted
from hodge_pipeline.scene import Round
from hodge_pipeline.stages import Workers
from hodge_pipeline.start.unordered.pieces import laid_apart
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, Source, ViewGraph
from hodge_pipeline.types.edges import REJECTED

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
    tried = held_out_pairs(rounds)
    for number in range(len(rounds), len(rounds) + job.recipe.suggestions.rounds):
        last = rounds[-1]
        proposal = _propose(job, number, source, clouds, last, tried)
        if not len(proposal.pairs):
            return
        tried = np.concatenate([tried, proposal.pairs])
        title = f"registration, suggested, round {number}"
        inputs = (f"edges-{number}",)
        new = register_more(job, number, title, SUGGESTED, source, proposal.pairs, proposal.placed, workers, inputs)
        edges = accepted(job, Edges.joined([last.registered(measured), new]))
        rows = np.arange(len(edges) - len(new), len(edges))
        edges, start = _judged(job, last, edges, rows, proposal, clouds)
        found = steps.solve(job, number, source, edges, start, measured)
        new = edges.select(rows)
        job.note(
            f"round {number}: of {len(proposal.pairs)} suggested pairs {int(new.counts.sum())} became edges; before it "
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
            poses = laid_apart(found.piece, found.world_from_cam, clouds)
            told = suggest_pairs(
                last.graph,
                found,
                options.pairs,
                overlapping=options.among.propose(source.frames, clouds, poses).pairs,
                tried=np.concatenate([last.edges.pairs, tried]),
            )
            told = told.select(told.score >= options.min_gain)
            artifacts.save(folder.path / steps.EDGES, Edges.proposed(told.pairs, SUGGESTED))
            untestable = np.array((found.verdict == UNTESTABLE).sum())
            arrays = {"world_from_cam": poses, "piece": found.piece, "untestable": untestable}
            artifacts.save_arrays(folder.path / "poses.npz", arrays)
            advance(1)
    pairs = artifacts.load(job.path(name) / steps.EDGES, Edges).pairs
    stored = artifacts.load_arrays(job.path(name) / "poses.npz")
    placed = Placed(stored["world_from_cam"], stored["piece"])
    return _Proposal(pairs, placed, int(stored["untestable"]))


def _judged(
    job: Job, last: Round, edges: Edges, rows: Ints, proposal: _Proposal, clouds: CloudSet
) -> tuple[Edges, Floats]:
    """The table, of which `rows` are new, and the poses to solve from.

    What joins two pieces is kept where the diagnosis of all edges together keeps it, and begins at its robust poses:
    the pieces had no common frame before.
    """
    new = edges.select(rows)
    across = proposal.placed.across(new.pairs)
    if not across.any():
        return edges, last.world_from_cam
    graph = ViewGraph.joined([last.graph, new.select(new.counts).as_graph(last.vertex_ids)])
    found = diagnose(graph, job.recipe.diagnosis)
    dropped = rows[new.counts][~found.kept[last.graph.edge_count :] & across[new.counts]]
    edges = edges.put(dropped, status=REJECTED, why="the diagnosis of all edges does not keep it")
    return edges, laid_apart(found.piece, found.world_from_cam, clouds)

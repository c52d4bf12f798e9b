"""The rounds that a run adds by itself: it registers the pairs that its diagnosis suggests, and solves with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import UNTESTABLE
from hodge_pipeline.pairs.held_out import held_out_pairs
from hodge_pipeline.recipe.round_options import SuggestionOptions
from hodge_pipeline.rounds.more import Placed, register_more
from hodge_pipeline.rounds.one_round import Registered, Work
from hodge_pipeline.rounds.suggestions import suggest_pairs
from hodge_pipeline.scene import Round
from hodge_pipeline.stages import Step
from hodge_pipeline.start.unordered.folds import laid_apart
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, Source, ViewGraph
from hodge_pipeline.types.edges import REJECTED
from hodge_pipeline.types.notes import Note

SUGGESTED = "suggested"


@dataclass(frozen=True)
class Suggested:
    """Pairs (P, 2) to register, the robust poses, and how many edges could not be tested."""

    pairs: Ints
    placed: Placed
    untestable: int


def suggested_rounds(work: Work, rounds: Sequence[Round]) -> Iterator[Registered]:
    """As many rounds as the recipe's `suggestions` allow and are of use, each after the last of `rounds`, which the
    caller extends by it.
    """
    tried, recipe, scene = held_out_pairs(rounds), work.recipe, work.scene
    for number in range(len(rounds), len(rounds) + recipe.suggestions.rounds):
        last = rounds[-1]
        found = work.steps.step(
            suggest_edges, last, scene.source, scene.clouds, recipe.suggestions, recipe.diagnosis, tried,
            title=f"suggestions, round {number}",
        )  # fmt: skip
        if not len(found.pairs):
            return
        tried = np.concatenate([tried, found.pairs])
        title = f"registration, suggested, round {number}"
        new = register_more(work, title, SUGGESTED, found.pairs, found.placed)
        edges = work.accept(Edges.joined([last.registered(work.measured), new]))
        rows = np.arange(len(edges) - len(new), len(edges))
        edges, start = _judged(work, last, edges, rows, found)
        new = edges.select(rows)
        untested = f"before it {found.untestable} of {last.graph.edge_count} edges could not be tested"
        told = f"round {number}: of {len(found.pairs)} suggested pairs {int(new.counts.sum())} became edges; {untested}"
        work.steps.note(Note("suggested", len(found.pairs), told))
        yield Registered(f"round {number}", work.with_measured(edges), rows, found.placed.world_from_cam, start)


def suggest_edges(
    last: Round,
    source: Source,
    clouds: CloudSet,
    options: SuggestionOptions,
    diagnosis: DiagnosisOptions,
    tried: Ints,
    *,
    step: Step,
) -> Suggested:
    """Step: what is worth registering after the last round, of pairs not `tried` (P, 2) yet."""
    found = diagnose(last.graph, diagnosis)
    poses = laid_apart(found.piece, found.world_from_cam, clouds)
    told = suggest_pairs(
        last.graph,
        found,
        options.pairs,
        overlapping=options.among.propose(source.frames, clouds, poses).pairs,
        tried=np.concatenate([last.edges.pairs, tried]),
    )
    told = told.select(told.score >= options.min_gain)
    pairs = Edges.proposed(told.pairs, SUGGESTED).pairs
    return Suggested(pairs, Placed(poses, found.piece), int((found.verdict == UNTESTABLE).sum()))


def _judged(work: Work, last: Round, edges: Edges, rows: Ints, suggested: Suggested) -> tuple[Edges, Floats]:
    """The table, of which `rows` are new, and the poses to solve from.

    What joins two pieces is kept where the diagnosis of all edges together keeps it, and begins at its robust poses:
    the pieces had no common frame before.
    """
    new = edges.select(rows)
    across = suggested.placed.across(new.pairs)
    if not across.any():
        return edges, last.world_from_cam
    graph = ViewGraph.joined([last.graph, new.as_graph(last.vertex_ids, new.counts)])
    found = diagnose(graph, work.recipe.diagnosis)
    dropped = rows[new.counts][~found.kept[last.graph.edge_count :] & across[new.counts]]
    edges = edges.put(dropped, status=REJECTED, why="the diagnosis of all edges does not keep it")
    return edges, laid_apart(found.piece, found.world_from_cam, work.scene.clouds)

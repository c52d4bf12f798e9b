"""What became of a refinement, as reports show it, and the report of a refined model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hodge_pipeline.recipe import binding
from hodge_pipeline.refine.guard import Decision
from hodge_pipeline.refine.model import RefinedModel
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.report.contents import (
    EdgeRow,
    Pictures,
    RefinementSummary,
    Report,
    SourceSummary,
    StageRow,
    paths_of,
)
from hodge_pipeline.report.summary import graph_summary, worst_edges
from hodge_pipeline.store import yaml_file
from hodge_pipeline.store.cost import Cost
from hodge_pipeline.store.store import versions
from hodge_pipeline.types.notes import Note, notes_of
from hodge_pipeline.types.text import counted

HEADLINES = {
    "refined": "Better than the poses given",
    "optimal": "No significant improvement: the poses given are given back",
    "worse": "Not better than the poses given: those are given back",
    "forced": "Not better than the poses given, written all the same",
    "convention": "The poses given look to be of another convention: they are given back",
    "nothing": "Nothing could be refined: no poses are written",
}


def summary(decision: Decision) -> RefinementSummary:
    """The decision as the report shows it."""
    change = "" if decision.change is None else f"The {decision.change}."
    headline, measures = HEADLINES[decision.outcome], tuple(decision.measures)
    return RefinementSummary(decision.outcome, headline, decision.reason, measures, change, doubt=decision.doubt)


def _scales(result: RefinedModel) -> str:
    before = "; ".join(str(scale) for scale in dict.fromkeys(result.scales))
    after = "" if not result.final_scale.is_observable else f". After: {result.final_scale}"
    return f"Before: {before}{after}."


def model_report(results: Sequence[RefinedModel], options: ModelRefinement, source: str, cost: Cost) -> Report:
    """The report of the first result, which has most images; the others in its notes."""
    first = results[0]
    others = [
        f"model {number} ({counted(result.start.quality.images, 'image')}): {result.decision.outcome}, "
        f"{result.decision.reason}"
        for number, result in enumerate(results[1:], start=1)
    ]
    metric = () if first.final_scale.is_observable else (Note("no metres"),)
    solved = first.solved
    sets = {"start": first.start.world_from_body, "result": first.model.world_from_body}
    quality = first.start.quality
    pictures, graph, worst = Pictures(paths_of(sets)), None, tuple[EdgeRow, ...]()
    if solved is not None:
        edges, names = solved.edges(first.model.world_from_body), solved.graph.vertex_ids
        graph, worst = graph_summary(edges, names, solved.solution.component), worst_edges(edges, names)
        pictures = Pictures.of_graph(sets, solved.graph, solved.solution.component)
    return Report(
        title=f"{source}, refined",
        source=SourceSummary(counted(quality.points, "point"), source, quality.images, format="colmap", kind="images"),
        before="start",
        refinement=replace(
            summary(first.decision), scale=_scales(first), candidates=tuple(first.candidates), kept=first.kept_row
        ),
        graph=graph,
        worst_edges=worst,
        stages=(StageRow("refine", cost.wall_s, cost.cpu_s, cost.peak_mb),),
        notes=(*metric, *notes_of("refinement", (*others, *first.notes))),
        versions=versions(),
        recipe=yaml_file.dump(binding.unbind(options)),
        pictures=pictures,
        has_metres=first.final_scale.is_observable,
    )

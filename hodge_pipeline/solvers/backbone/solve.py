"""Maximum-likelihood poses of a backbone and the loops that it confirms."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from hodge_pipeline.solvers.backbone.trust import Backbone
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName, solve
from hodge_pipeline.solvers.setup import held_rows
from hodge_pipeline.solvers.stated import is_explained
from hodge_pipeline.types import Floats, Solution, ViewGraph


def solve_on_backbone(
    graph: ViewGraph,
    backbone: Backbone,
    *,
    start: Floats | None,
    objective: ObjectiveName,
    dimension: Literal[2, 3] | None = None,
    certificate: bool = False,
) -> Solution:
    """The poses, and `weights` 1 for the backbone and the loops that count; `start (V, 4, 4)` sets the gauge.

    The information is taken as it is stated where it explains what these edges leave over, else with the errors that
    the backbone and its loops were found to have.

    `confirmed` is None where no loop is: the poses are then those of the backbone, and a note says so.
    """
    fixed, unheld = held_rows(graph, start)
    used = backbone.used

    def solved(chosen: ViewGraph) -> Solution:
        return solve(
            chosen,
            start=start if len(fixed) else backbone.placed(start),
            initial="chordal" if len(fixed) else "given",
            objective=objective,
            dimension=dimension,
            fixed=fixed,
            certificate=certificate,
        )

    chosen = graph.select(np.flatnonzero(used))
    final = solved(chosen)
    if not is_explained(chosen, final):
        final = solved(backbone.weighted(graph))
    metrics = {
        **final.metrics,
        "kept_edges": float(used.sum()),
        "tested_edges": float(np.isfinite(backbone.chi2).sum()),
    }
    return replace(
        final,
        weights=used.astype(float),
        notes=(*unheld, backbone.note, *final.notes),
        metrics=metrics,
        confirmed=True if backbone.found.confirmed else None,
    )

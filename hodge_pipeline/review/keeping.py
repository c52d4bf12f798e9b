"""Save what a review made: a pose graph or a COLMAP model under a new name, so that nothing is overwritten."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.errors import not_written
from hodge_pipeline.pairs.edits import write_history
from hodge_pipeline.refine.reprojection_cost import SAME_COST, costs
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.subject import SIDE_FILE, Subject
from hodge_pipeline.store.workspace import EDITS_FILE
from hodge_pipeline.types import Floats, Trajectory, ViewGraph
from hodge_pipeline.types.text import counted
from hodge_pipeline.types.tracked_model import TrackedModel
from hodge_pipeline.uses.model_folder import MODELS

SAME_PX = 1e-3
"""A smaller rise of the mean error is none: keypoints are less exact, bundle adjustment stops nearer to its optimum."""


def save(session: Session) -> tuple[Path, str]:
    """Write the latest decisions, solved, with their history; the new file or folder, and a sentence on it.

    Raises `WorkspaceError` where it cannot be written.
    """
    session.quick.wait()
    with session.changed:
        table, settled, history = session.table, session.settled, session.decisions.history
    subject = session.subject
    path = _free(subject)
    try:
        if subject.model is not None:
            told = _write_model(path, subject.model, settled.world_from_cam)
            write_history(path / EDITS_FILE, history)
        else:
            chosen = table.graph.select(np.flatnonzero(settled.weights > 0))
            told = _write_graph(path, subject, chosen, settled.world_from_cam)
            write_history(path.with_name(path.name + SIDE_FILE), history)
    except OSError as error:
        raise not_written(path, error) from error
    return path, told


def _write_graph(path: Path, subject: Subject, graph: ViewGraph, world_from_cam: Floats) -> str:
    """Write the graph at these poses (V, 4, 4) as g2o; how many edges it has."""
    trajectory = Trajectory(np.arange(len(world_from_cam), dtype=float), world_from_cam)
    source = replace(subject.source, graph=graph, trajectory=trajectory)
    registry.load("writers", "g2o")().write(path, source)
    return counted(graph.edge_count, "edge")


def _write_model(path: Path, model: TrackedModel, world_from_body: Floats) -> str:
    """Write the model, adjusted from these poses (B, 4, 4), as `hodge refine colmap` does; its errors in words."""
    done = model.moved(world_from_body).merged().adjusted()
    before, after = costs([model.quality], [done.quality])
    folder = path / MODELS / "0"
    folder.mkdir(parents=True)
    done.write(folder)
    is_worse = after.px > (1 + SAME_COST) * before.px + SAME_PX
    worse = "; that is worse: keep the model as it was" if is_worse else ""
    return f"after bundle adjustment, mean reprojection error {before.px:.3g} → {after.px:.3g} px{worse}"


def _free(subject: Subject) -> Path:
    """An unused name beside the subject: `graph.reviewed.g2o`, `graph.reviewed-2.g2o`, …; `model.reviewed`, …"""
    path = subject.path.resolve()
    folder, stem, ending = path.parent, path.name if path.is_dir() else path.stem, ".g2o"
    if subject.model is not None:
        ending = ""
    elif path.is_dir():
        folder = path
    number = 1
    while True:
        named = folder / f"{stem}.reviewed{f'-{number}' if number > 1 else ''}{ending}"
        if not named.exists() and not named.with_name(named.name + SIDE_FILE).exists():
            return named
        number += 1

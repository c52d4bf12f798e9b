"""What a review leaves beside its decisions: a pose graph in a new file, nothing written over."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.errors import GraphError, not_written
from hodge_pipeline.pairs.edits import write_history_file
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.subject import SIDE_FILE
from hodge_pipeline.types import Trajectory


def save_graph(session: Session) -> Path:
    """Write the edges that count, at their poses, as g2o beside the graph, and the decisions beside that; the new file.

    Raises `WorkspaceError` where it cannot be written.
    """
    with session.changed:
        table, settled, history = session.table, session.settled, session.decisions.history
        current = settled.revision == session.decisions.revision or not session.quick.doing
    if not current:
        raise GraphError("the latest decision is being solved: save when that is done")
    subject = session.subject
    path = _free(subject.path)
    chosen = table.graph.select(np.flatnonzero(settled.weights > 0))
    trajectory = Trajectory(np.arange(len(settled.world_from_cam), dtype=float), settled.world_from_cam)
    source = replace(subject.source, graph=chosen, trajectory=trajectory)
    try:
        registry.load("writers", "g2o")().write(path, source)
        write_history_file(path.with_name(path.name + SIDE_FILE), history)
    except OSError as error:
        raise not_written(path, error) from error
    return path


def _free(path: Path) -> Path:
    """A name beside a graph that nothing has: `graph.reviewed.g2o`, `graph.reviewed-2.g2o`, …"""
    folder, stem = (path, path.name) if path.is_dir() else (path.parent, path.stem)
    number = 1
    while True:
        named = folder / f"{stem}.reviewed{f'-{number}' if number > 1 else ''}.g2o"
        if not named.exists() and not named.with_name(named.name + SIDE_FILE).exists():
            return named
        number += 1

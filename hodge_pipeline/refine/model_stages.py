"""The stages of the refinement of one model, kept in the run folder: what was stopped goes on at the last of them."""

from __future__ import annotations

import os
import uuid
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hodge_pipeline.stages import TrackedModel
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.workspace import StageFolder, Workspace, key_of
from hodge_pipeline.types import ViewGraph

NOTES = "notes.json"


def models_key(models: Sequence[TrackedModel], *parts: Any) -> str:
    """The key of what is computed from models and options: name, size and time of every file; of models in memory, one
    that no other has.
    """
    if not all(model.files for model in models):
        return uuid.uuid4().hex
    files = [file for model in models for file in (*model.files, *model.measurements)]
    status = [(str(file.absolute()), os.stat(file)) for file in files]
    return key_of([(path, found.st_size, found.st_mtime_ns) for path, found in status], *parts)


@dataclass(frozen=True)
class ModelStages:
    """The stages of model `number`, under the `key` of what they are computed from."""

    workspace: Workspace
    key: str
    number: int = 0

    def stage(self, name: str) -> AbstractContextManager[StageFolder]:
        """The folder of a stage, to be written unless it is finished."""
        return self.workspace.stage(self._name(name), key_of(self.key, self._name(name)))

    def path(self, name: str) -> Path:
        """Where a finished stage lies."""
        return self.workspace.path(self._name(name))

    def notes(self, name: str) -> tuple[str, ...]:
        """The notes of a finished stage."""
        return tuple(artifacts.read_json(self.path(name) / NOTES))

    def _name(self, name: str) -> str:
        return f"{name}-{self.number}"


def measured_edges(model: TrackedModel, stages: ModelStages) -> tuple[ViewGraph, tuple[str, ...]]:
    """The model's edges from what its images share, and what was left out."""
    with stages.stage("measured") as folder:
        if not folder.finished:
            graph, notes = model.measured()
            artifacts.save(folder.path / "graph.npz", graph)
            artifacts.write_json(folder.path / NOTES, notes)
    return artifacts.load(stages.path("measured") / "graph.npz", ViewGraph), stages.notes("measured")

"""Show a recording in a notebook cell by Rerun's widget."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import rerun.notebook
from rerun.error_utils import RerunMissingDependencyError

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording.stream import APPLICATION
from hodge_pipeline.store.workspace import RECORDING_FILE


def viewer(folder: Path, width: int, height: int) -> Any:
    """A `rerun.notebook.Viewer` of a run's recording, in pixels. Raises `WorkspaceError` where there is none, or no
    rerun-notebook.
    """
    recording = folder / RECORDING_FILE
    if not recording.is_file():
        raise WorkspaceError(f"{recording}: no recording here: make one with `hodge record RUN --level normal`")
    stream = rerun.RecordingStream(APPLICATION)
    try:
        shown = rerun.notebook.Viewer(width=width, height=height, recording=stream)
    except RerunMissingDependencyError as error:
        raise WorkspaceError("no viewer for notebooks is installed: pip install 'hodge-pipeline[notebook]'") from error
    stream.log_file_from_path(recording)
    return shown

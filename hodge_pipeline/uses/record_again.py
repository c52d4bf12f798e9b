"""Make the recording of a run again, with other options, from what its folder holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording.run import Recording
from hodge_pipeline.run_folder import Run, check_layout
from hodge_pipeline.scene import key_source
from hodge_pipeline.sources.opening import fingerprints, remembered
from hodge_pipeline.store.log import log, logging_to
from hodge_pipeline.store.progress import Watcher
from hodge_pipeline.store.store import Store
from hodge_pipeline.store.workspace import LOG_FILE, RECORDING_FILE, holding
from hodge_pipeline.types import Source

PARTS = "recording"
"""The folder of the recording's steps: they depend on its options, so the run's own are not replaced."""


def record_again(folder: Path, options: Mapping[str, Any], watcher: Watcher | None = None) -> tuple[Path, bool]:
    """Record a run again with other `RecordingOptions`; the path of the recording, and whether the run has ended.

    Nothing is computed again. A run that was killed is recorded as far as it came; images, where the source is still
    there. Raises `WorkspaceError` for no run, one in progress, or options that record nothing.
    """
    check_layout(folder)
    run = Run.load(folder)
    recipe = run.recipe
    changed = replace(recipe, recording=replace(recipe.recording, **options))
    if changed.recording.level == "off":
        raise WorkspaceError(f"{folder}: its recipe records nothing: add --level normal")
    with holding(folder), logging_to(folder / LOG_FILE):
        log.info("recording made again from the run folder")
        (folder / PARTS).mkdir(exist_ok=True)
        store = Store(folder / PARTS, watcher)
        store.note(*run.options_left_out)
        source = _with_images(run, store)
        with Recording(store, folder, changed, source) as recording:
            recording.begin(source, run.clouds, run.rounds[0])
            _record(run, recording)
    return folder / RECORDING_FILE, run.ending is not None


def _with_images(run: Run, store: Store) -> Source:
    """The key frames of the run, with their images where the source is unchanged."""
    opened, reader, complaint = run.reopened()
    store.note(*complaint)
    source = run.source if opened is None else remembered(opened, reader, store, fingerprints(opened.files))
    keys = key_source(source, run.key_frames.rows)
    store.remember(keys, store.key([source, run.key_frames.rows]))
    return keys


def _record(run: Run, recording: Recording) -> None:
    """Everything after the first round, in the order in which the run recorded it."""
    for number, one in enumerate(run.rounds[1:], start=1):
        recording.round(number, one)
    if (run.result.edges.verdict != "").any():
        recording.diagnosis(run.result)
        recording.scores(run.scores)
    recording.models(run.models)

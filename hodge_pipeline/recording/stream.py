"""Recording streams into files, written under a temporary name and renamed when complete."""

from __future__ import annotations

import hashlib
import math
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event, Thread

import numpy as np
import rerun as rr

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import layout
from hodge_pipeline.scene import UNIX_STAMP_S, has_real_stamps
from hodge_pipeline.types import Floats, Frame, Ints
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.output_files import draft_of

APPLICATION = "hodge-pipeline"
"""Application id, under which the viewer stores a layout that the user has changed."""
TURN_S, STALLED_S = 2.0, 60.0
"""How long Rerun is waited for at a time, and after how long without a byte its writer counts as dead."""
LEAST_FREE_BYTES = 1 << 16
"""A disk with less free counts as full: a recording needs more for one image and its cloud."""


@dataclass(frozen=True)
class Part:
    """A part of a recording while it is written: `options` say what is kept, `solver_bytes` what one round may take.

    `slot` is its stage's on the story. `is_scanner`: the poses are those of scanners or robots, x ahead and z up.
    `notes` grow by what was thinned or left out.
    """

    stream: rr.RecordingStream
    options: RecordingOptions = field(default_factory=RecordingOptions)
    solver_bytes: float = math.inf
    slot: int = 0
    is_scanner: bool = False
    notes: list[str] = field(default_factory=list)

    def note(self, text: str, level: str = "INFO") -> None:
        """Note what was thinned or left out, in the log too."""
        self.notes.append(f"recording: {text}")
        log_notes(self.stream, self.slot, self.notes[-1:], level)

    def some(self, available: int, most: int, bytes_each: float, max_bytes: float, what: str) -> Ints:
        """The rows to keep of so many, spread evenly: see `RecordingOptions.count`; what is left out is noted."""
        rows = evenly(available, self.options.count(most, available, bytes_each, max_bytes))
        if len(rows) < available:
            self.note(f"{len(rows)} of {available} {what}")
        return rows


def identity_of_poses(world_from_cam: Floats) -> str:
    """The identity of a recording that these poses alone tell apart."""
    return hashlib.sha256(np.ascontiguousarray(world_from_cam).tobytes()).hexdigest()[:32]


def open_stream(recording_id: str, application: str = APPLICATION) -> rr.RecordingStream:
    """A stream of its own, without clock timelines: the same input gives the same rows."""
    stream = rr.RecordingStream(application, recording_id=recording_id, send_properties=False)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


@contextmanager
def writing(
    path: Path, recording_id: str, blueprint: rr.blueprint.Blueprint | None = None, application: str = APPLICATION
) -> Iterator[rr.RecordingStream]:
    """A stream into this file, which appears under its name only when all is in it."""
    partial = draft_of(path)
    stream = open_stream(recording_id, application)
    try:
        stream.save(partial, default_blueprint=blueprint)
    except RuntimeError as error:
        partial.unlink(missing_ok=True)
        raise _unwritable(partial) from error
    try:
        yield stream
        _finish(stream, partial)
    except WorkspaceError:
        partial.unlink(missing_ok=True)
        raise
    except BaseException:
        _finish(stream, partial)
        partial.unlink(missing_ok=True)
        raise
    os.replace(partial, path)


def _finish(stream: rr.RecordingStream, partial: Path) -> None:
    """All of the stream in its file. Raises `WorkspaceError` where it cannot be written.

    Once a write has failed, Rerun's own wait for the rest may never end, not even at exit: so it is waited for in
    turns, and a stream whose file stands still is left to a thread that ends with the process.
    """
    size, stalled_s = -1, 0.0
    while True:
        try:
            stream.flush(timeout_sec=TURN_S)
        except RuntimeError as error:
            grown = partial.stat().st_size
            size, stalled_s = grown, 0.0 if grown > size else stalled_s + TURN_S
            is_full = shutil.disk_usage(partial.parent).free < LEAST_FREE_BYTES
            if "timed out" in str(error) and stalled_s < STALLED_S and not is_full:
                continue
            rr.unregister_shutdown()
            Thread(target=lambda _: Event().wait(), args=(stream,), daemon=True).start()
            raise _unwritable(partial) from error
        stream.disconnect()
        return


def _unwritable(partial: Path) -> WorkspaceError:
    return WorkspaceError(
        f"{partial.parent}: the recording cannot be written (is the disk full?): what was finished stays; "
        "make room and run the same command again"
    )


def story_columns(slot: int, share: Floats) -> list[rr.TimeColumn]:
    """Times on the story timeline at these shares, in [0, 1), of a stage's slot, and the stage that the slot is."""
    slots = slot + np.asarray(share, float)
    return [
        rr.TimeColumn(layout.STORY, duration=layout.SLOT_S * slots),
        rr.TimeColumn(layout.STAGE, sequence=np.floor(slots).astype(np.int64)),
    ]


def frame_columns(frames: Sequence[Frame], count: int, rows: Ints) -> list[rr.TimeColumn]:
    """The times of frames `rows` of `count`: frame row, story, and sensor time where the stamps are real."""
    columns = [rr.TimeColumn(layout.FRAME, sequence=rows), *story_columns(0, rows / max(count, 1))]
    if has_real_stamps(frames):
        stamps = np.array([frames[row].stamp_s for row in rows])
        since_1970 = min(frame.stamp_s for frame in frames) > UNIX_STAMP_S
        columns.append(
            rr.TimeColumn(layout.TIME, timestamp=stamps) if since_1970 else rr.TimeColumn(layout.TIME, duration=stamps)
        )
    return columns


def log_notes(stream: rr.RecordingStream, slot: int, notes: Iterable[str], level: str = "INFO") -> None:
    """Lines of the run's log, at the start of a stage's slot."""
    for note in notes:
        stream.set_time(layout.STORY, duration=layout.SLOT_S * slot)
        stream.set_time(layout.STAGE, sequence=slot)
        stream.log(layout.LOG, rr.TextLog(_utf8(note), level=level))
    stream.reset_time()


def _utf8(text: str) -> str:
    """The text with what is not UTF-8, as in names of other systems, written out."""
    return text.encode("utf-8", "backslashreplace").decode()


def log_markdown(stream: rr.RecordingStream, path: str, text: str) -> None:
    """A text that is there at every time."""
    stream.log(path, rr.TextDocument(_utf8(text), media_type=rr.MediaType.MARKDOWN), static=True)

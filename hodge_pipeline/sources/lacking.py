"""What the frames of a source lack that a run profits from."""

from __future__ import annotations

from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Source
from hodge_pipeline.types.notes import Note


def lacking(source: Source) -> tuple[Note, ...]:
    """Notes on frames with depth and no colour, and on a trajectory that is of none of the frames."""
    notes, with_depth = list[Note](), [frame for frame in source.frames if frame.read_depth is not None]
    without = sum(frame.read_colour is None for frame in with_depth)
    if without:
        notes.append(Note("no colour", without, str(len(with_depth))))
    posed = any(frame.world_from_cam is not None or frame.true_world_from_cam is not None for frame in source.frames)
    if source.trajectory is not None and not posed:
        notes.append(Note("no pose near", len(source.frames)))
    return tuple(notes)


def check_measurable(source: Source) -> None:
    """Raise `SourceError`, with what the reader left out, where no frame has depth with a camera, or points."""
    if any(frame.read_points or (frame.read_depth and frame.camera) for frame in source.frames):
        return
    why = "".join(f"; {note}" for note in source.notes)
    raise SourceError(
        f"{source.path}: no frame has depth with a camera, or points, so that there is nothing to register{why}: hodge "
        "inspect says what the source is good for"
    )

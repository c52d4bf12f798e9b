"""Open a source with the recipe's reader; warn if another reader fits much better, or frames lack what a run needs."""

from __future__ import annotations

import uuid
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from hodge_pipeline import registry
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import Guess, guess_reader, guesses
from hodge_pipeline.sources.unknown import without_frames
from hodge_pipeline.stages import FrameReader, Steps
from hodge_pipeline.store.store import file_facts
from hodge_pipeline.types import Source
from hodge_pipeline.types.notes import Note

SURE = 0.6
"""Confidence from which another reader is suggested."""
NAMED = 5
MARGIN = 0.2
"""By how much its confidence must exceed that of the recipe's reader."""

RECIPES = {"clouds": "scans"}
"""The recipe to try first for a reader, where it is not the one of its name: nothing tells the order of clouds."""

Fingerprints = dict[Path, tuple[Any, ...]]


def remembered(source: Source, reader: FrameReader | None, steps: Steps, prints: Fingerprints) -> Source:
    """The source, keyed in the store by the fingerprints of its files and by the reader with its options.

    A source made in memory, without a reader, gets a random key: no other run reuses its steps.
    """
    files = [(str(path.absolute()), *found) for path, found in prints.items()]
    steps.remember(source, uuid.uuid4().hex if reader is None else steps.key([files, reader]))
    return source


def fingerprints(files: Sequence[Path], *, strict: bool = False) -> Fingerprints:
    """Size and time of each file, with its SHA-256 where `strict`; nothing for one that is not there."""
    return {path: _fingerprint(path, strict) for path in files}


def changed_since(before: Fingerprints, *, strict: bool) -> tuple[Note, ...]:
    """A note where files no longer have these fingerprints, so that results may mix two versions of them."""
    now = fingerprints(list(before), strict=strict)
    changed = [path.name for path in before if now[path] != before[path]]
    return (Note("input changed", len(changed), ", ".join(changed[:NAMED])),) if changed else ()


def _fingerprint(path: Path, strict: bool) -> tuple[Any, ...]:
    try:
        status = path.stat()
        if not strict or not path.is_file():
            return status.st_size, status.st_mtime_ns
        return status.st_mtime_ns, *file_facts(path)
    except OSError:
        return ()


def open_with_reader(
    path: Path, reader: FrameReader | None, recipes: Collection[str] = ()
) -> tuple[Source, FrameReader]:
    """The source at a path and the reader that opened it; without a reader, the surest.

    Where another reader is much surer of the path than this one, the error (`SourceError`), or else a note, names it
    and the recipe for it, where it is among `recipes`.
    """
    chosen = reader or guess_reader(path)
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    try:
        source = _opened(chosen, path)
    except SourceError as error:
        likelier = _likelier(path, chosen)
        if likelier is None:
            raise
        raise SourceError(
            f"{error}; it looks like {_described(likelier)}: {_remedy(likelier.name, path, recipes)}"
        ) from error
    likelier = None if reader is None else _likelier(path, chosen)
    if likelier is not None:
        read_as = f"read as {registry.name_of(chosen)}, but it looks like {_described(likelier)}"
        source = replace(source, notes=(*source.notes, f"{read_as}: {_remedy(likelier.name, path, recipes)}"))
    return source, chosen


def _opened(reader: FrameReader, path: Path) -> Source:
    try:
        return reader.open(path)
    except MemoryError as error:
        raise SourceError(f"{path}: needs more memory than there is: give a part of it, or free some") from error


def _likelier(path: Path, chosen: FrameReader) -> Guess | None:
    """The surest reader, where it is another than the chosen one and much surer."""
    if not path.exists() or chosen.sniff(path).confidence > 1 - MARGIN:
        return None
    best = next(iter(guesses(path)), None)
    if best is None or best.name == registry.name_of(chosen) or best.sniff.confidence < SURE:
        return None
    return best if best.sniff.confidence >= chosen.sniff(path).confidence + MARGIN else None


def _described(guess: Guess) -> str:
    return f"{guess.name} ({guess.sniff.reason})"


def _remedy(reader: str, path: Path, recipes: Collection[str]) -> str:
    """What to try: the recipe named as the reader, else the option that takes it; another command without frames."""
    if (recipe := RECIPES.get(reader, reader)) in recipes:
        return f"try the recipe {recipe}"
    try:
        source: Source = registry.load("readers", reader)().open(path)
    except SourceError as error:
        return f"which does not open it either ({error})"
    return f"try --set source.reader={reader}" if source.frames else without_frames(source)


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

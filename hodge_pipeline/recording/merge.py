"""Merge the parts of a run into one recording with its blueprint; damaged parts are repaired."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from subprocess import SubprocessError

import numpy as np
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from hodge_pipeline.recording import binary, layout
from hodge_pipeline.recording.blueprint import Contents, legend, make_blueprint
from hodge_pipeline.recording.eye import Eyes, look_at, look_from, points_of
from hodge_pipeline.recording.stream import log_markdown, log_notes, partial_path, writing


@dataclass(frozen=True)
class Merged:
    """The file that `merge` wrote, and notes of parts that were mended or lost."""

    path: Path
    notes: tuple[str, ...] = ()


def merge(parts: Iterable[Path], out: Path, recording_id: str, *, active_tab: int = 0) -> Merged:
    """One file of these parts, in the order of the run that their names say; it opens on a tab, the story.

    A damaged part is mended as far as it can be read; the others are not touched by it.
    """
    parts = sorted(parts, key=_place)
    contents = contents_of(parts)
    notes: list[str] = []
    with tempfile.TemporaryDirectory(prefix="hodge-recording-") as scratch:
        readers = [(part, reader) for part in parts if (reader := _open(part, Path(scratch), notes)) is not None]
        contents = with_entities(contents, readers)
        poses = layout.poses(contents.trajectory)
        blueprint = make_blueprint(contents, eyes(contents, readers), active_tab)
        with writing(out, recording_id, blueprint) as stream:
            for _, reader in readers:
                send(stream, reader, poses)
            log_notes(stream, 0, notes, level="WARN")
            log_markdown(stream, layout.LEGEND, legend(contents))
    return Merged(out, tuple(notes))


def find_parts(folder: Path) -> list[Path]:
    """The parts in the order of the run; what a killed writer left where there is no complete one."""
    complete = [path for path in folder.glob(f"*{layout.PART_SUFFIX}") if not path.name.startswith(".")]
    unfinished = set(folder.glob(f".*{layout.PARTIAL_SUFFIX}")) - {partial_path(path) for path in complete}
    parts = [path for path in (*complete, *unfinished) if layout.parse_part(path.name)[0]]
    return sorted(parts, key=_place)


def _place(part: Path) -> str:
    """Names begin with the number of their stage."""
    return part.name.lstrip(".")


def contents_of(parts: Iterable[Path]) -> Contents:
    """What the parts hold, by their names."""
    stages = [layout.parse_part(path.name) for path in parts]
    solved = [int(detail) for stage, detail in stages if stage == "solution" and detail.isdigit()]
    rounds = [int(detail) for stage, detail in stages if stage == "edges" and detail.isdigit()]
    named = [detail for stage, detail in stages if stage == "poses"]
    best = layout.round_name(max(solved)) if solved else next((n for n in named if n != "truth"), "truth")
    return Contents(
        stages=frozenset(stage for stage, _ in stages),
        trajectories=tuple(named),
        trajectory=best,
        last_graph=max(rounds, default=0),
        last_solution=max(solved, default=0),
        is_scanner=("frames", layout.SCANNER) in stages,
    )


def with_entities(contents: Contents, readers: Sequence[tuple[Path, RrdReader]]) -> Contents:
    """The contents with the paths of all entities."""
    return replace(contents, entities=frozenset(c.entity_path for _, reader in readers for c in reader.stream()))


def eyes(contents: Contents, readers: Sequence[tuple[Path, RrdReader]]) -> Eyes:
    """Where the views of these parts are looked at from."""
    poses, is_scanner = layout.poses(contents.trajectory), contents.is_scanner
    pairs = points_of(_chunks(readers, f"{layout.PAIRS}/**"))
    return Eyes(
        room=look_at(_chunks(readers, layout.MODEL), _chunks(readers, poses), is_scanner),
        graph=look_at((), _chunks(readers, poses), is_scanner),
        pair=look_from(np.eye(4)[None], pairs, is_scanner) if len(pairs) else None,
    )


def _open(part: Path, scratch: Path, notes: list[str]) -> RrdReader | None:
    """A reader of the part, of its mended copy where it is damaged, or None where it holds nothing."""
    with suppress(RuntimeError):
        reader = _reader(part)
        return reader if reader.recordings() else None
    mended = _mended(part, scratch)
    if mended is None or not mended.recordings():
        notes.append(f"recording: {part.name} is damaged and left out: record that stage again")
        return None
    notes.append(f"recording: {part.name} is cut off: what could be read of it is shown")
    return mended


def _mended(part: Path, scratch: Path) -> RrdReader | None:
    copy = scratch / part.name
    try:
        environment = binary.quiet_environment(scratch)
        binary.run(["rrd", "merge", "--continue-on-error", str(part), "-o", str(copy)], environment)
        return _reader(copy)
    except (RuntimeError, OSError, SubprocessError):
        return None


def _reader(part: Path) -> RrdReader:
    """A reader that has seen the entire file, so that damage shows here and not half-way into the merge."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = RrdReader(part)
        for _ in reader.stream() if reader.recordings() else ():
            pass
    return reader


def _chunks(readers: Iterable[tuple[Path, RrdReader]], entity: str) -> Iterator[Chunk]:
    for _, reader in readers:
        yield from reader.stream().filter(content=entity)


def send(stream: rr.RecordingStream, reader: RrdReader, poses: str) -> None:
    """The part's chunks; the best trajectory's poses also move the camera that holds images and clouds."""
    for chunk in reader.stream():
        stream.send_chunks(chunk)
        if chunk.entity_path == poses:
            stream.send_chunks(chunk.with_entity_path(layout.CAMERA))

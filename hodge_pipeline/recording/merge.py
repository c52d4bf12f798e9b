"""Merge the parts of a run into one recording with its blueprint."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
from rerun.chunk import Chunk, RrdReader

from hodge_pipeline.recording import layout
from hodge_pipeline.recording.blueprint import STORY_TAB, Contents, legend, make_blueprint
from hodge_pipeline.recording.eye import Eyes, look_at, look_from, points_of
from hodge_pipeline.recording.stream import log_markdown, writing


def merge(parts: Iterable[Path], out: Path, recording_id: str, opened: str = STORY_TAB) -> None:
    """One file of these parts, in the order of the run that their names say; it opens on the tab of this name."""
    parts = sorted(parts, key=lambda part: part.name)
    readers = readers_of(parts)
    contents = with_entities(contents_of(parts), readers.values())
    blueprint = make_blueprint(contents, eyes(contents, readers.values()), opened)
    with writing(out, recording_id, blueprint) as stream:
        for reader in readers.values():
            send(stream, reader, layout.poses(contents.trajectory))
        log_markdown(stream, layout.LEGEND, legend(contents))


def readers_of(parts: Iterable[Path]) -> dict[Path, RrdReader]:
    """A reader of each part that holds anything."""
    readers = {part: RrdReader(part) for part in parts}
    return {part: reader for part, reader in readers.items() if reader.recordings()}


def find_parts(folder: Path) -> list[Path]:
    """The parts in the order of the run; what a killed writer left is none."""
    return sorted(path for path in folder.glob(f"*{layout.PART_SUFFIX}") if layout.parse_part(path.name)[0])


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


def with_entities(contents: Contents, readers: Collection[RrdReader]) -> Contents:
    """The contents with the paths of all entities."""
    return replace(contents, entities=frozenset(c.entity_path for reader in readers for c in reader.stream()))


def eyes(contents: Contents, readers: Collection[RrdReader]) -> Eyes:
    """The initial viewpoints of these parts."""
    poses, is_scanner = layout.poses(contents.trajectory), contents.is_scanner
    pairs = points_of(_chunks(readers, f"{layout.PAIRS}/**"))
    return Eyes(
        room=look_at(_chunks(readers, layout.MODEL), _chunks(readers, poses), is_scanner),
        graph=look_at((), _chunks(readers, poses), is_scanner),
        pair=look_from(np.eye(4)[None], pairs, is_scanner) if len(pairs) else None,
    )


def _chunks(readers: Iterable[RrdReader], entity: str) -> Iterator[Chunk]:
    for reader in readers:
        yield from reader.stream().filter(content=entity)


def send(stream: rr.RecordingStream, reader: RrdReader, poses: str) -> None:
    """The part's chunks; the best trajectory's poses also move the camera that holds images and clouds."""
    for chunk in reader.stream():
        stream.send_chunks(chunk)
        if chunk.entity_path == poses:
            stream.send_chunks(chunk.with_entity_path(layout.CAMERA))

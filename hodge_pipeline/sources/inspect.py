"""What a path is, with no reading of more than needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hodge_pipeline import registry
from hodge_pipeline.errors import CameraError, HodgeError, SourceError
from hodge_pipeline.sources.frame_facts import METRES, OWN_UNIT, frame_facts, trajectory_facts
from hodge_pipeline.sources.graph_facts import graph_facts
from hodge_pipeline.sources.unknown import unknown
from hodge_pipeline.stages import FrameReader, Sniff
from hodge_pipeline.store.workspace import is_run_folder
from hodge_pipeline.types import Source


@dataclass(frozen=True)
class Guess:
    """A reader and how sure it is of a path."""

    name: str
    sniff: Sniff


def guesses(path: Path) -> list[Guess]:
    """Every reader that takes the path for its format, the surest first; a broken plugin is passed over."""
    found = []
    for name in registry.names("readers"):
        try:
            sniff = registry.load("readers", name)().sniff(path)
        except HodgeError:
            continue
        if sniff.confidence > 0:
            found.append(Guess(name, sniff))
    return sorted(found, key=lambda guess: (-guess.sniff.confidence, guess.name))


def guess_reader(path: Path, known: Sequence[Guess] | None = None) -> FrameReader:
    """The surest reader of a path, with its default options, of the guesses that are `known`, else of all.

    Raises `SourceError` where none knows it.
    """
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    if not path.is_file() and not path.is_dir():
        raise SourceError(f"{path}: neither a file nor a folder: give one that holds data")
    if is_run_folder(path):
        raise SourceError(
            f"{path}: the folder of a run, no source: give a file of it, such as poses.tum, graph.g2o or mesh.ply"
        )
    best = guesses(path) if known is None else known
    if not best:
        raise unknown(path)
    reader: FrameReader = registry.load("readers", best[0].name)()
    return reader


def _opened(reader: FrameReader, path: Path) -> tuple[Source, CameraError | None]:
    """The source and None; without known intrinsics, the source with a made-up camera and the `CameraError`."""
    try:
        return reader.open(path), None
    except CameraError as error:
        width, height = error.size
        any_reader: Any = reader
        return replace(any_reader, camera=(width, width, width / 2, height / 2)).open(path), error


def _require_some(path: Path, facts: dict[str, Any]) -> None:
    faults = facts["unreadable among them"]
    if faults and not facts["frames looked into"]:
        none = "" if len(faults) == 1 else f"{path}: none of the {len(faults)} frames looked into can be read: "
        raise SourceError(none + faults[0])


def inspect(path: Path, reader: FrameReader | None = None) -> dict[str, Any]:
    """Facts of a path as plain data: guesses, frames, stamps, cameras, depth, poses, graph, notes, oddities.

    The surest reader opens it where none is given; only the depth of a few frames is read. Facts without a value are
    left out. `missing` lists options that the reader needs.

    Raises `SourceError` where none of the frames looked into can be read.
    """
    known = guesses(path) if path.is_file() or path.is_dir() else []
    taken = reader or guess_reader(path, known)
    source, camera_error = _opened(taken, path)
    oddities = [*map(str, filter(None, [camera_error])), *map(str, source.doubts)]
    unit = METRES if source.in_metres else OWN_UNIT
    facts: dict[str, Any] = {
        "path": str(path),
        "formats": [{"reader": g.name, "confidence": g.sniff.confidence, "why": g.sniff.reason} for g in known],
        "frames": len(source.frames),
    }
    if source.frames:
        facts.update(frame_facts(source.frames, oddities, unit))
        _require_some(path, facts)
    if getattr(taken, "depth_scale", 0) is not None:  # a scale of the user's, or of another format than TUM's
        facts.pop("missing", None)
    if camera_error is not None:
        facts["cameras"] = ["{}x{}, intrinsics unknown".format(*camera_error.size)]
        facts["missing"] = [*facts.get("missing", ()), f"source.reader.camera={camera_error.camera}"]
    if source.trajectory is not None:
        facts["trajectory poses"] = len(source.trajectory)
        if not source.frames and len(source.trajectory):
            # The poses of a graph's vertices stand in no order of time: a step between them means nothing.
            facts.update(trajectory_facts(source.trajectory, oddities) if source.graph is None else {})
    if source.graph is not None and source.graph.vertex_count:
        facts["graph"] = graph_facts(source.graph, oddities, unit)
    if source.positions is not None:
        facts["positions"] = len(source.positions)
        facts["positions from"] = source.positions.origin
    facts["contents"] = list(source.contents) or None
    facts["notes"] = list(source.notes)
    facts["oddities"] = oddities
    return {name: value for name, value in facts.items() if value is not None}

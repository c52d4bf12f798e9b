"""What a path is, with no reading of more than needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.errors import HodgeError, SourceError
from hodge_pipeline.stages import FrameReader, Sniff
from hodge_pipeline.types import Frame, Source

SAMPLED_FRAMES = 8


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


def guess_reader(path: Path) -> FrameReader:
    """The surest reader of a path, with its default options. Raises `SourceError` where none knows it."""
    if not path.exists():
        raise SourceError(f"{path}: no such file or folder")
    best = guesses(path)
    if not best:
        known = ", ".join(registry.names("readers"))
        raise SourceError(f"{path}: no reader knows this format (readers: {known}): name one with --set source.reader=")
    reader: FrameReader = registry.load("readers", best[0].name)()
    return reader


def inspect(path: Path) -> dict[str, Any]:
    """Facts of a path as plain data: guesses, frames, stamps, sequences, cameras, depth, poses, notes."""
    reader = guess_reader(path)
    source = reader.open(path)
    facts: dict[str, Any] = {
        "path": str(path),
        "formats": [{"reader": g.name, "confidence": g.sniff.confidence, "why": g.sniff.reason} for g in guesses(path)],
        "frames": len(source.frames),
    }
    if source.frames:
        facts.update(_frame_facts(source))
    if source.trajectory is not None:
        facts["trajectory poses"] = len(source.trajectory)
    if source.graph is not None:
        facts["graph"] = {"vertices": source.graph.vertex_count, "edges": source.graph.edge_count}
    facts["notes"] = list(source.notes)
    return facts


def _frame_facts(source: Source) -> dict[str, Any]:
    frames = source.frames
    stamps = np.array([frame.stamp_s for frame in frames])
    sequences = list(dict.fromkeys(frame.sequence for frame in frames))
    cameras = {frame.camera for frame in frames if frame.camera is not None}
    gaps = np.diff(stamps)
    return {
        "sequences": sequences,
        "first stamp": float(stamps[0]),
        "last stamp": float(stamps[-1]),
        "median step": float(np.median(gaps)) if len(gaps) else None,
        "largest step": float(gaps.max()) if len(gaps) else None,
        "cameras": [
            f"{c.width}x{c.height} fx {c.fx:g} fy {c.fy:g} cx {c.cx:g} cy {c.cy:g}" for c in sorted(cameras, key=str)
        ],
        "frames with a pose": sum(frame.world_from_cam is not None for frame in frames),
        "frames with colour": sum(frame.read_colour is not None for frame in frames),
        **_depth_facts(frames[:: max(1, len(frames) // SAMPLED_FRAMES)][:SAMPLED_FRAMES]),
    }


def _depth_facts(frames: Any) -> dict[str, Any]:
    """Depth range and invalid share of a few frames, and those that cannot be read."""
    depths, faults = [], []
    for frame in frames:
        try:
            depths.append(_depth(frame))
        except SourceError as error:
            faults.append(str(error))
    values = np.concatenate([depth.ravel() for depth in depths]) if depths else np.zeros(0)
    valid = values[values > 0]
    return {
        "frames looked into": len(depths),
        "depth range in metres": [float(valid.min()), float(valid.max())] if len(valid) else None,
        "share without depth": float(1 - len(valid) / len(values)) if len(values) else None,
        "unreadable among them": faults,
    }


def _depth(frame: Frame) -> Any:
    if frame.read_depth is not None:
        return frame.read_depth()
    return frame.read_points().points_in_cam[:, 2] if frame.read_points is not None else np.zeros(0)

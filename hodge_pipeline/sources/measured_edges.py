"""Measured edges: a source's own graph, or files of them. They take part in a run without registration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.stages import OPTIONS, FrameReader
from hodge_pipeline.types import Bools, Edges, Frame, Ints, Source, ViewGraph, number_of
from hodge_pipeline.types.text import counted


@dataclass(frozen=True, config=OPTIONS)
class GraphFile:
    """A file of measured edges between the source's frames."""

    path: Path = Field(description="a graph of any format that a reader opens: g2o, Open3D JSON, .log of pairs")
    reader: FrameReader | None = Field(default=None, description="its format; none: the surest reader")
    first_frame: int = Field(
        default=0, description="added to its vertex numbers: a fragment's own graph counts from 0 again"
    )


@dataclass(frozen=True, config=OPTIONS)
class MeasuredOptions:
    """What becomes of edges that come measured."""

    use: bool = Field(
        default=True,
        description="whether a source's own measured edges take part in every round; their pairs are not registered",
    )
    files: tuple[GraphFile, ...] = Field(default=(), description="files of more measured edges")
    information_scale: float = Field(
        default=1.0,
        gt=0,
        description="factor of their information; Open3D's counts points with an error of 1 m each: 1 / (0.02 m)² = "
        "2500 would say 2 cm for each point, 250 the same with ten neighbours as one measurement",
    )


def measured_edges(source: Source, options: MeasuredOptions) -> tuple[ViewGraph, tuple[str, ...]]:
    """The measured edges between frames of the source, as a graph over its frames in their order, and notes.

    A vertex is the frame of the same id. Raises `SourceError` for a file without edges, or without one of two frames.
    """
    frames = source.frames
    parts: list[ViewGraph] = [_no_edges(frames)]
    notes: list[str] = []
    if options.use and source.graph is not None and source.graph.edge_count:
        parts.append(_between_frames(source.graph, frames, f"{source.path}", 0, notes))
    elif source.graph is not None and source.graph.edge_count:
        notes.append(f"{source.path}: its {source.graph.edge_count} measured edges are left out: measured.use is false")
    for file in options.files:
        graph = (file.reader or guess_reader(file.path)).open(file.path).graph
        if graph is None or not graph.edge_count:
            raise SourceError(f"{file.path}: has no measured edges: measured.files wants a pose graph")
        parts.append(_between_frames(graph, frames, f"{file.path}", file.first_frame, notes))
        if not parts[-1].edge_count:
            raise SourceError(
                f"{file.path}: no edge is between two frames of {source.path} (ids {frames[0].frame_id}, …): "
                "set first_frame, or name the vertices as the frames are"
            )
    found = ViewGraph.joined(parts)
    found = replace(found, information=found.information * options.information_scale)
    if found.edge_count:
        counts = ", ".join(f"{count} {name}" for name, count in sorted(Counter(found.source.tolist()).items()))
        notes.append(f"{found.edge_count} measured edges ({counts}) take part as they are, without registration")
    return found, tuple(notes)


def without_measured(candidates: Edges, measured: ViewGraph) -> Edges:
    """The candidates of pairs that are not measured already, in either direction."""
    known = {(min(i, j), max(i, j)) for i, j in measured.edges.tolist()}
    if not known:
        return candidates
    kept = np.array([(i, j) not in known for i, j in candidates.pairs.tolist()], bool)
    return candidates.select(kept)


def _no_edges(frames: Sequence[Frame]) -> ViewGraph:
    ids = np.array([frame.frame_id for frame in frames])
    return ViewGraph.from_edges(ids, np.zeros((0, 2), np.int64), np.zeros((0, 4, 4)))


def _between_frames(
    graph: ViewGraph, frames: Sequence[Frame], name: str, first_frame: int, notes: list[str]
) -> ViewGraph:
    """The edges of a graph whose ends are both frames, over the frames; the others are counted in the notes."""
    rows = _rows_of(graph, frames, first_frame)[graph.edges]
    good: Bools = (rows >= 0).all(axis=1) & (rows[:, 0] != rows[:, 1])
    lost = int((~good).sum())
    if lost:
        notes.append(f"{name}: {lost} of {graph.edge_count} measured edges left out: they are not between two frames")
    known = 0 if graph.priors is None else len(graph.priors.vertices)
    if known or len(graph.fixed):
        notes.append(
            f"{name}: its {len(graph.fixed)} fixed vertices and {counted(known, 'prior has|priors have')} no part in a "
            "run: hodge solve heeds them"
        )
    over_frames = replace(graph.select(good), edges=rows[good], vertex_ids=_no_edges(frames).vertex_ids)
    return replace(over_frames, dimension=3, fixed=np.zeros(0, np.int64))


def _rows_of(graph: ViewGraph, frames: Sequence[Frame], first_frame: int) -> Ints:
    """The row of the frame that each vertex is by its id, or its number; -1 for none, or where several have it."""
    numbered = graph.vertex_ids.dtype.kind in "iu"
    names = [number_of(frame) if numbered else frame.frame_id for frame in frames]
    counts = Counter(names)
    rows = {name: row for row, name in enumerate(names) if counts[name] == 1}
    ids = graph.vertex_ids.tolist()
    if first_frame:
        ids = [vertex + first_frame if isinstance(vertex, int) else vertex for vertex in ids]
    return np.array([rows.get(vertex, -1) for vertex in ids], np.int64)

"""The poses that a source gives, wherever it keeps them, for writers of trajectories."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Source, Trajectory, ViewGraph
from hodge_pipeline.types.text import counted

UNIT_TOLERANCE = 1e-3
"""Three decimals of a quaternion leave as much; more is another mistake."""


def length_notes(quats: Floats, what: str) -> list[str]:
    """A note where quaternions (N, 4) are not of length 1: they are normalised."""
    lengths = np.linalg.norm(quats, axis=1)
    wrong = np.abs(lengths - 1) > UNIT_TOLERANCE
    if not wrong.any():
        return []
    worst = lengths[np.argmax(np.abs(lengths - 1))]
    return [f"{int(wrong.sum())} of {len(quats)} {what} have a quaternion of another length than 1 (as {worst:.4g})"]


def trajectory_of(source: Source) -> Trajectory:
    """The source's trajectory, else the poses of its frames. Raises `SourceError` where it has neither."""
    if source.trajectory is not None:
        return source.trajectory
    found = Trajectory.of_frames(source.frames)
    if found is None:
        raise SourceError(f"{source.path}: has no poses to write: convert one that has a trajectory")
    return found


def graph_of(source: Source) -> tuple[ViewGraph, Floats | None]:
    """The source's measured graph, and the trajectory's poses (V, 4, 4) where it has one for each vertex.

    Raises `SourceError` where it has no graph.
    """
    if source.graph is None:
        raise SourceError(f"{source.path}: has no graph to write: convert one that has edges")
    poses = None if source.trajectory is None else source.trajectory.world_from_cam
    return source.graph, poses if poses is not None and len(poses) == source.graph.vertex_count else None


def written_graph(source: Source, graph: ViewGraph) -> tuple[str, ...]:
    """As `written`, of a graph."""
    what = f"{counted(graph.vertex_count, 'vertex|vertices')}, {counted(graph.edge_count, 'edge')}"
    return written(what, source, {"edges"})


def written(what: str, source: Source, keeps: Collection[str] = ()) -> tuple[str, ...]:
    """`what` was written, and what a source has that a format lost: all but what it `keeps`, a line each."""
    frames = source.frames
    stamps = np.array([frame.stamp_s for frame in frames]) if frames else _stamps(source.trajectory)
    counts = {
        "stamps": 0 if np.array_equal(stamps, np.arange(len(stamps))) else len(stamps),
        "names": sum(isinstance(frame.frame_id, str) for frame in frames) or _named_vertices(source.graph),
        "cameras": len({frame.camera for frame in frames if frame.camera}),
        "images": sum(frame.read_colour is not None for frame in frames),
        "depth images": sum(frame.read_depth is not None for frame in frames),
        "point clouds": sum(frame.read_points is not None for frame in frames),
        "edges": 0 if source.graph is None else source.graph.edge_count,
    }
    words = {name: name.removesuffix("s") if count == 1 else name for name, count in counts.items()}
    lost = [f"{count} {words[name]}" for name, count in counts.items() if count and name not in keeps]
    without = sum(frame.world_from_cam is None for frame in frames)
    return (
        what,
        *([f"{without} of {len(frames)} frames have no pose"] if without else []),
        *([f"not in this format, so lost: {', '.join(lost)}"] if lost else []),
    )


def left_out(no_numbers: int) -> tuple[str, ...]:
    """A line that says how many points the reader of the clouds left out, none where it kept all."""
    return (f"{counted(no_numbers, 'point that is|points that are')} not finite left out",) if no_numbers else ()


def _named_vertices(graph: ViewGraph | None) -> int:
    return graph.vertex_count if graph is not None and graph.vertex_ids.dtype.kind not in "iu" else 0


def _stamps(trajectory: Trajectory | None) -> Floats:
    return np.zeros(0) if trajectory is None else trajectory.stamps_s

"""Small data to record, and recordings read back."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rerun.chunk import Chunk, RrdReader

from hodge_pipeline import se3
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording.recorder import Recorder
from hodge_pipeline.types import (
    Camera,
    CloudSet,
    EncodedImage,
    Frame,
    Model,
    PointCloud,
    Solution,
    SolverIteration,
    ViewGraph,
)

CAMERA = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)


def circle(count: int = 12) -> np.ndarray:
    """Poses (N, 4, 4) on a circle of 1 m, looking outwards."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    turns = se3.exp(np.stack([0 * angles, angles, *(0 * angles for _ in range(4))], axis=1))
    ahead = se3.from_parts(np.eye(3), np.array([0.0, 0.0, 1.0]))
    return np.asarray(turns @ ahead)


def png(row: int, channels: int) -> bytes:
    buffer = io.BytesIO()
    rng = np.random.default_rng(row)
    pixels = rng.integers(0, 255, (6, 8, 3), np.uint8) if channels == 3 else np.full((6, 8), 1000 + row, np.uint16)
    Image.fromarray(pixels).save(buffer, "png")
    return buffer.getvalue()


def make_frames(count: int = 12, camera: Camera = CAMERA) -> list[Frame]:
    return [
        Frame(
            frame_id=4 * row,
            stamp_s=100.0 + row / 30,
            camera=camera,
            encoded_colour=lambda row=row: EncodedImage(png(row, 3), "image/png"),
            encoded_depth=lambda row=row: EncodedImage(png(row, 1), "image/png", 5000.0),
        )
        for row in range(count)
    ]


def ring_graph(poses: np.ndarray, noise: float = 0.01) -> ViewGraph:
    rng = np.random.default_rng(3)
    count = len(poses)
    edges = np.array([(i, (i + gap) % count) for gap in (1, 3) for i in range(count)])
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    return ViewGraph.from_edges(np.arange(count), edges, measured @ se3.exp(noise * rng.normal(size=(len(edges), 6))))


def make_solution(poses: np.ndarray, graph: ViewGraph) -> tuple[np.ndarray, Solution]:
    """A start off the circle, and a solution that comes back to it in three steps."""
    off = 0.2 * np.random.default_rng(4).normal(size=(len(poses), 6))
    states = [poses @ se3.exp(off * share) for share in (1.0, 0.3, 0.1, 0.0)]
    history = tuple(SolverIteration(state, 10.0 / k, {"deviation": 1.0 / k}) for k, state in enumerate(states[1:], 1))
    weights = np.ones(graph.edge_count)
    weights[2] = 0
    return states[0], Solution(states[-1], np.zeros(len(poses), int), weights, history)


def chunks(path: Path, entity: str) -> list[Chunk]:
    return list(RrdReader(path).stream().filter(content=entity).to_chunks())


def rows(path: Path, entity: str, column: str) -> list[Any]:
    """The values of a column, one for each row, in the order written."""
    found: list[Any] = []
    for chunk in chunks(path, entity):
        batch = chunk.to_record_batch()
        if column in batch.schema.names:
            found += batch.column(column).to_pylist()
    return found


def column_names(path: Path, entity: str) -> set[str]:
    return {name for chunk in chunks(path, entity) for name in chunk.to_record_batch().schema.names}


def rgb(packed: list[int]) -> np.ndarray:
    return np.array([[value >> 24 & 255, value >> 16 & 255, value >> 8 & 255] for value in packed], np.uint8)


def record(folder: Path, **options: Any) -> Recorder:
    return Recorder(folder, "run-1", RecordingOptions(**options))


def record_all(recorder: Recorder) -> None:
    frames, poses = make_frames(), circle()
    graph = ring_graph(poses)
    start, solution = make_solution(poses, graph)
    cloud = PointCloud(np.eye(3, dtype=np.float32), colours=np.full((3, 3), 9, np.uint8))
    recorder.frames("circle", frames, ["one note"])
    recorder.clouds(frames, CloudSet.from_clouds([cloud] * len(frames)))
    recorder.poses("truth", poses, frames)
    recorder.poses("odometry", start, frames)
    recorder.edges(1, graph, start)
    recorder.solution(1, graph, start, solution, frames)
    recorder.model(Model("m", np.float32(np.random.default_rng(0).uniform(-2, 2, (500, 3)))))
    recorder.evaluation(frames, per_frame={"ATE m": np.arange(12.0)}, tables={"t": "x"})
    recorder.text("a: 1", ["one", "warning: two"])

"""What a run leaves for people, but for its recording: poses, graph, edges, models, report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.refine.given_poses import Refined
from hodge_pipeline.report import known_positions
from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.run_report import make_report
from hodge_pipeline.report.write import write_report
from hodge_pipeline.scene import Round, Scene, sequences_of
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.edge_table import write_edges
from hodge_pipeline.store.store import Store
from hodge_pipeline.store.workspace import EDGES_FILE, GRAPH_FILE
from hodge_pipeline.types import Floats, Source, Trajectory
from hodge_pipeline.types.text import cell, csv_text, file_stems


def write_poses(folder: Path, source: Source, world_from_cam: Floats) -> None:
    """`poses.tum` and `poses.kitti`; of several sequences `poses-<sequence>.*` each, since their stamps may repeat.

    A sequence named by folders, as a rig's cameras are, becomes one name: no file lies outside the folder, and no two
    sequences have one file.
    """
    sequences = sequences_of(source)
    for stem, rows in zip(file_stems(list(sequences)), sequences.values(), strict=True):
        stamps = np.array([source.frames[row].stamp_s for row in rows])
        part = Source(source.name, source.path, trajectory=Trajectory(stamps, world_from_cam[rows]))
        name = "poses" if len(sequences) == 1 else f"poses-{stem}"
        for writer in ("tum", "kitti"):
            registry.load("writers", writer)().write(folder / f"{name}.{writer}", part)


def write_pose_table(folder: Path, source: Source, world_from_cam: Floats) -> None:
    """`poses.csv`: every frame by its name, and the 4x4 matrix world from camera (or scan), row by row."""
    header = ["name", *(f"m{row}{column}" for row in range(4) for column in range(4))]
    poses = zip(source.frames, (world_from_cam + 0.0).reshape(-1, 16).tolist(), strict=True)
    rows = ([cell(str(frame.frame_id)), *map(repr, numbers)] for frame, numbers in poses)
    artifacts.write_text(folder / "poses.csv", csv_text([header, *rows]))


def write_graph(folder: Path, source: Source, last: Round) -> None:
    """`graph.g2o` (vertices by frame number, or by row where frames have names) and `edges.csv`."""
    trajectory = Trajectory(np.arange(last.graph.vertex_count, dtype=float), last.world_from_cam)
    whole = Source(source.name, source.path, trajectory=trajectory, graph=last.graph)
    registry.load("writers", "g2o")().write(folder / GRAPH_FILE, whole)
    write_edges(folder / EDGES_FILE, last.edges, last.vertex_ids)


def write(
    folder: Path,
    recipe: Recipe,
    store: Store,
    scene: Scene,
    rounds: Sequence[Round],
    world_from_cam: Floats,
    models: Mapping[str, Path],
    scores: ScoreTable | None,
    refined: Refined | None = None,
) -> Report:
    """Write everything but the recording into the run folder; gives the report.

    Of a refinement the poses of all frames; where nothing could be refined the report alone.
    """
    if refined is None or refined.decision.outcome != "nothing":
        write_poses(folder, scene.whole, world_from_cam)
        write_pose_table(folder, scene.whole, world_from_cam)
        write_graph(folder, scene.source, rounds[-1])
        if (fit := rounds[-1].position_fit) is not None:
            artifacts.write_text(folder / "positions.csv", known_positions.as_csv(fit))
        for name, path in models.items():
            artifacts.link_or_copy(path, folder / f"{name}.ply")
    report = make_report(recipe, store, scene, rounds, world_from_cam, scores, refined)
    write_report(folder, report)
    return report

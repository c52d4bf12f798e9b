"""Edges that come measured: between which frames, not registered again, used or left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.open3d_json import Open3dPoseGraphWriter
from hodge_adapters.pose_graphs.g2o import G2oWriter
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.sources.measured_edges import GraphFile, MeasuredOptions, measured_edges, without_measured
from hodge_pipeline.types import Edges, Frame, Priors, Source, Trajectory, ViewGraph
from synthetic import tiny_sequence  # noqa: F401 - a fixture


def frames(*ids: int | str) -> tuple[Frame, ...]:
    return tuple(Frame(name, float(row)) for row, name in enumerate(ids))


def graph(vertex_ids: list[int] | list[str], edges: list[tuple[int, int]], seed: int = 0) -> ViewGraph:
    twists = np.random.default_rng(seed).normal(0, 0.2, (len(edges), 6))
    return ViewGraph.from_edges(np.array(vertex_ids), np.array(edges), se3.exp(twists), source="measured")


def test_a_vertex_is_the_frame_of_its_id() -> None:
    own = graph([30, 10, 20, 99], [(0, 1), (2, 0), (1, 3)])
    found, notes = measured_edges(Source("s", Path("s"), frames(10, 20, 30), graph=own), MeasuredOptions())
    assert found.vertex_ids.tolist() == [10, 20, 30]
    assert found.edges.tolist() == [[2, 0], [1, 2]]
    np.testing.assert_array_equal(found.i_from_j, own.i_from_j[:2])
    assert notes == (
        "s: 1 of 3 measured edges left out: they are not between two frames",
        "2 measured edges (2 measured) take part as they are, without registration",
    )


def test_frames_with_one_id_twice_are_nobodys_vertex() -> None:
    own = graph(["a", "b"], [(0, 1)])
    found, notes = measured_edges(Source("s", Path("s"), frames("a", "b", "b"), graph=own), MeasuredOptions())
    assert found.edge_count == 0 and len(notes) == 1


def test_they_can_be_left_out_and_weighed() -> None:
    source = Source("s", Path("s"), frames(0, 1), graph=graph([0, 1], [(0, 1)]))
    left, notes = measured_edges(source, MeasuredOptions(use=False))
    assert left.edge_count == 0 and "measured.use is false" in notes[0]
    weighed, _ = measured_edges(source, MeasuredOptions(information_scale=4.0))
    np.testing.assert_array_equal(weighed.information, 4 * np.eye(6)[None])


def test_fixed_vertices_and_priors_have_no_part_in_a_run_and_a_note_says_so() -> None:
    priors = Priors(np.array([0]), np.eye(4)[None], np.eye(6)[None])
    own = replace(graph([0, 1], [(0, 1)]), fixed=np.array([0, 1]), priors=priors)
    found, notes = measured_edges(Source("s", Path("s"), frames(0, 1), graph=own), MeasuredOptions())
    assert not len(found.fixed) and found.priors is None
    assert notes[0] == "s: its 2 fixed vertices and 1 prior has no part in a run: hodge solve heeds them"


def test_files_of_fragments_begin_at_their_first_frame(tmp_path: Path) -> None:
    part = Source("part", tmp_path, graph=graph([0, 1, 2], [(0, 1), (1, 2), (0, 2)]))
    Open3dPoseGraphWriter().write(tmp_path / "part.json", part)
    files = (GraphFile(tmp_path / "part.json"), GraphFile(tmp_path / "part.json", first_frame=3))
    source = Source("s", Path("s"), frames(*range(6)))
    found, _ = measured_edges(source, MeasuredOptions(files=files))
    assert found.edges.tolist() == [[0, 1], [1, 2], [0, 2], [3, 4], [4, 5], [3, 5]]
    assert set(found.source.tolist()) == {"open3d", "open3d_uncertain"}
    with pytest.raises(SourceError, match="no edge is between two frames"):
        measured_edges(source, MeasuredOptions(files=(GraphFile(tmp_path / "part.json", first_frame=50),)))


def test_a_file_without_edges_is_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match="has no measured edges"):
        measured_edges(
            Source("s", Path("s"), frames(0, 1)), MeasuredOptions(files=(GraphFile(tmp_path / "poses.txt"),))
        )


def test_measured_pairs_are_no_candidates_in_either_direction() -> None:
    candidates = Edges.of([[0, 1], [0, 2], [1, 2]], np.array(["a", "b", "c"]))
    left = without_measured(candidates, graph([0, 1, 2], [(1, 0), (1, 2)]))
    assert left.pairs.tolist() == [[0, 2]] and left.proposed_by.tolist() == ["b"]
    both = ViewGraph.joined([graph([0, 1, 2], [(0, 1)]), graph([0, 1, 2], [(1, 2), (0, 2)], seed=1)])
    assert both.edges.tolist() == [[0, 1], [1, 2], [0, 2]] and both.i_from_j.shape == (3, 4, 4)


LIGHT = ("clouds.voxel_m=0.06", "executor.workers=0", "recording.level=off", "evaluation.tables=false", "fusion=[]")


def test_a_run_takes_them_as_they_are(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    """True edges from the first frame to all others, with much information, hold the poses at the truth."""
    seen = TumReader(every=3).open(tiny_sequence).frames
    poses = np.array([frame.world_from_cam for frame in seen])
    edges = np.array([(0, row) for row in range(1, len(seen))])
    true = ViewGraph.from_edges(
        np.array([frame.frame_id for frame in seen]),
        edges,
        se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]],
        1e9 * np.broadcast_to(np.eye(6), (len(edges), 6, 6)),
    )
    trajectory = Trajectory(np.arange(len(seen), dtype=float), poses)
    G2oWriter().write(tmp_path / "true.g2o", Source("t", tmp_path, trajectory=trajectory, graph=true))
    recipe = load_recipe("tum", [*LIGHT, "source.reader.every=3"], tiny_sequence)
    files = (GraphFile(tmp_path / "true.g2o"),)
    run = hodge_pipeline.run(replace(recipe, measured=MeasuredOptions(files=files)), tmp_path / "run")
    measured = run.result.graph.source == "g2o"
    np.testing.assert_array_equal(run.result.graph.edges[measured], edges)
    registered = run.result.edges.select(run.result.edges.proposed_by != "g2o")
    assert (registered.pairs[:, 0] > 0).all()
    assert (~measured).any() and run.report.trajectories[-1].ate_rmse_m < 1e-4
    assert (tmp_path / "run/edges.csv").read_text().count(",g2o,used,") == len(edges)

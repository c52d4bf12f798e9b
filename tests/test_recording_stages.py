"""Registration, complex, diagnosis and growth in a recording: read back, and by hand."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.blueprint import Contents
from hodge_pipeline.recording.curl import triangle_curl_m
from hodge_pipeline.recording.growth import first_frame
from hodge_pipeline.recording.merge import contents_of, eyes, find_parts, readers_of, with_entities
from hodge_pipeline.recording.recorder import Recorder
from hodge_pipeline.recording.registration import chosen_pairs, moved_m
from hodge_pipeline.types import CloudSet, Edges, Frame, Model, PointCloud, ViewGraph
from recording_data import circle, make_solution, record, rgb, ring_graph, rows


def registered(count: int = 4) -> tuple[Edges, np.ndarray]:
    """Pairs (0, k), guessed at the identity, moved by 0.1 k m; the last has least fitness."""
    motions = np.tile(np.eye(4), (count, 1, 1))
    motions[:, 0, 3] = 0.1 * np.arange(count)
    pairs = np.stack([np.zeros(count, int), np.arange(1, count + 1)], axis=1)
    columns: dict[str, Any] = {
        "i_from_j": motions,
        "information": np.tile(np.eye(6), (count, 1, 1)),
        "fitness": np.linspace(0.9, 0.2, count),
        "rmse_m": np.linspace(0.01, 0.03, count),
        "correspondences": np.arange(count) + 100,
        "iterations": np.arange(count) + 5,
        "converged": np.ones(count, bool),
    }
    return replace(Edges.of(pairs), status=np.full(count, "used"), **columns), np.tile(np.eye(4), (count, 1, 1))


def clouds(count: int = 5) -> CloudSet:
    rng = np.random.default_rng(0)
    return CloudSet.from_clouds([PointCloud(rng.normal(size=(20, 3)).astype(np.float32)) for _ in range(count)])


def test_registration_reads_back_with_the_clouds_of_chosen_pairs(tmp_path: Path) -> None:
    found, guesses = registered()
    found = found.put([3], status="rejected", why="too little overlap")
    assert chosen_pairs(found, guesses) == {"moved_most": 2, "least_fitness": 2, "rejected": 3}
    np.testing.assert_allclose(moved_m(found, guesses), [0, 0.1, 0.2, 0.3])
    seen = clouds()
    record(tmp_path).registration(1, found, guesses, seen)
    part = tmp_path / "012-registration-1.rrd"
    columns = layout.registration(1)
    np.testing.assert_array_equal(np.float32(rows(part, columns, "fitness")[0]), np.float32(found.fitness))
    np.testing.assert_array_equal(np.float32(rows(part, columns, "rmse_m")[0]), np.float32(found.rmse_m))
    assert rows(part, columns, "iterations")[0] == found.iterations.tolist()
    assert rows(part, columns, "rejected")[0] == found.why.tolist()
    judged = found.put(np.array([0]), why="3 of 3 cycles close")
    record(tmp_path / "judged").registration(1, judged, guesses, seen)
    (told,) = rows(tmp_path / "judged" / part.name, columns, "rejected")
    assert told == found.why.tolist(), "an edge is not rejected for what the diagnosis says"
    pair = layout.pair("rejected")
    (after,) = rows(part, f"{pair}/after", "Points3D:positions")
    moved = np.asarray(seen[4].points_in_cam, float) + [0.3, 0, 0]
    np.testing.assert_array_equal(np.float32(after), np.float32(moved))
    (before,) = rows(part, f"{pair}/before", "Points3D:positions")
    np.testing.assert_array_equal(np.float32(before), seen[4].points_in_cam)
    readers = readers_of(find_parts(tmp_path)).values()
    assert with_entities(Contents(), readers).pairs == ("least_fitness", "moved_most", "rejected")


def test_no_pairs_at_all(tmp_path: Path) -> None:
    record(tmp_path).registration(1, Edges.of([]), np.zeros((0, 4, 4)), clouds())
    assert not rows(tmp_path / "012-registration-1.rrd", layout.registration(1), "fitness")


def test_curl_of_a_triangle_by_hand() -> None:
    """Three exact motions, one of them measured backwards; then 0.2 m are added to one.

    0 -- 1
     \\  |
       2
    """
    poses = circle(12)[:3]
    edges = np.array([[0, 1], [2, 1], [0, 2]])
    exact = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    triangle = np.array([[0, 1, 2]])
    graph = ViewGraph.from_edges(np.arange(3), edges, exact)
    np.testing.assert_allclose(triangle_curl_m(graph, triangle), [0], atol=1e-7)
    exact[2] = exact[2] @ se3.from_parts(np.eye(3), np.array([0.2, 0, 0]))
    np.testing.assert_allclose(triangle_curl_m(graph, triangle), [0.2], atol=1e-9)


def test_triangles_read_back(tmp_path: Path) -> None:
    poses = circle(6)
    edges = np.array([[0, 1], [1, 2], [0, 2], [2, 3], [3, 4], [4, 5]])
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    graph = ViewGraph.from_edges(np.arange(6), edges, measured)
    start, solution = make_solution(poses, graph)
    record(tmp_path).solution(1, graph, start, solution)
    part = tmp_path / "011-solution-1.rrd"
    (corners,) = rows(part, layout.complex_mesh(1), "Mesh3D:vertex_positions")
    np.testing.assert_array_equal(np.float32(corners), np.float32(solution.world_from_cam[:3, :3, 3]))
    (text,) = rows(part, layout.complex_text(1), "TextDocument:text")
    assert "| triangles | 1 |" in text[0] and "| after | exact |" in text[0]


def test_verdicts_have_entities_of_their_own(tmp_path: Path) -> None:
    poses = circle()
    graph = ring_graph(poses)
    verdict = np.array(["consistent"] * (graph.edge_count - 2) + ["wrong", "untestable"])
    probability = np.where(verdict == "untestable", np.nan, 0.5)
    judged = Edges.measured(graph).put(slice(None), verdict=verdict, probability=probability, why="so it is")
    record(tmp_path).diagnosis(graph, poses, judged)
    part = tmp_path / "890-diagnosis.rrd"
    (lines,) = rows(part, layout.verdict("wrong"), "LineStrips3D:strips")
    np.testing.assert_array_equal(np.float32(lines), np.float32(poses[graph.edges[-2:-1], :3, 3]))
    (labels,) = rows(part, layout.verdict("wrong"), "LineStrips3D:labels")
    assert labels == ["10 – 1: given, wrong, 50 %: so it is"]
    assert len(rows(part, layout.verdict("consistent"), "LineStrips3D:strips")[0]) == graph.edge_count - 2
    (text,) = rows(part, layout.DIAGNOSIS, "TextDocument:text")
    assert "| untestable | 1 |" in text[0]


def test_a_point_grows_with_the_frame_that_saw_it_first(tmp_path: Path) -> None:
    """Two frames 1 m apart that see one point each, ahead; a third that no cloud saw goes to the last."""
    ahead = PointCloud(np.float32([[0, 0, 1]]))
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.0
    points = np.float32([[1, 0, 1], [0, 0, 1], [0.02, 0, 1.01], [9, 9, 9]])
    seen = CloudSet.from_clouds([ahead, ahead])
    assert first_frame(points, seen, poses).tolist() == [1, 0, 0, 1]
    poses[0] = np.nan
    assert first_frame(points, seen, poses).tolist() == [1, 1, 1, 1]
    poses[0] = np.eye(4)
    colours = np.uint8([[1, 2, 3], [4, 5, 6], [7, 8, 9], [0, 0, 0]])
    record(tmp_path).model(Model("m", points, colours=colours), seen, poses)
    part = tmp_path / "900-model.rrd"
    (first,) = rows(part, layout.growth(0), "Points3D:positions")[:1]
    np.testing.assert_array_equal(np.float32(first), points[[1, 2]])
    np.testing.assert_array_equal(rgb(rows(part, layout.growth(0), "Points3D:colors")[0]), colours[[1, 2]])


def test_a_street_grows_as_a_room_does() -> None:
    """Clouds on a grid of 0.5 m: a fused point lies up to half of it beside the measured ones."""
    x = np.arange(0, 10, 0.5)
    wall = PointCloud(np.column_stack([x, np.zeros(20), np.full(20, 5.0)]).astype(np.float32))
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 20.0, 40.0]
    points = np.float32([[2.25, 0.2, 5.1], [22.25, 0.2, 5.1], [45.2, 0.2, 5.2]])
    assert first_frame(points, CloudSet.from_clouds([wall] * 3), poses).tolist() == [0, 1, 2]


def test_what_is_not_there_has_no_view_and_a_scanner_is_no_camera(tmp_path: Path) -> None:
    """Scans have no images and, here, no truth: no panel stays empty, and no pose is drawn as a frustum."""
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4) * 10.0
    for scanner in (False, True):
        folder = tmp_path / str(scanner)
        recorder = Recorder(folder, "run-1", is_scanner=scanner)
        recorder.frames("scans", [Frame(row, float(row)) for row in range(4)])
        recorder.poses("odometry", poses)
        readers = readers_of(find_parts(folder)).values()
        contents = with_entities(contents_of(find_parts(folder)), readers)
        assert contents.is_scanner == scanner and contents.holds(layout.CAMERA) and not contents.holds(layout.COLOUR)
        eye = eyes(contents, readers).graph
        assert eye is not None
        np.testing.assert_allclose(eye.up, [0, 0, 1] if scanner else [0, -1, 0], atol=1e-9)
        (line, *_) = rows(find_parts(folder)[1], layout.frusta("odometry"), "LineStrips3D:strips")[0]
        size_m = 0.6 * np.array([1, 0.4, 0.5] if scanner else [1.6, 1.2, 1])  # of 30 m a fiftieth, times the shape
        np.testing.assert_allclose(np.ptp(np.array(line), axis=0), size_m, rtol=1e-5)


def test_points_without_a_colour_are_grey(tmp_path: Path) -> None:
    points = np.float32([[1, 0, 1], [0, 0, 1]])
    seen = CloudSet.from_clouds([PointCloud(points)])
    record(tmp_path).clouds([Frame(0, 0.0)], seen)
    record(tmp_path).model(Model("m", points), seen, np.eye(4)[None])
    for part, path in (("001-clouds", layout.CLOUD), ("900-model", layout.MODEL), ("900-model", layout.growth(0))):
        assert (rgb(rows(tmp_path / f"{part}.rrd", path, "Points3D:colors")[0]) == 190).all()


def test_growth_holds_one_cloud_at_a_time() -> None:
    """Two million points of 40 frames that walk on: what is held grows with the model's points alone."""
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.uniform(-1, 1, (50_000, 3)).astype(np.float32))
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, 0, 3] = np.arange(40)
    seen = CloudSet.from_clouds([cloud] * 40)
    tracemalloc.start()
    try:
        first = first_frame(poses[:, :3, 3].astype(np.float32), seen, poses)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert first.tolist() == [0, 0, *range(1, 39)]
    assert peak < 10 * cloud.points_in_cam.nbytes

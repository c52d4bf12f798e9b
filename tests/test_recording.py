"""Recordings read back: every array as it went in, on the shared timeline, within the size asked for."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from hypothesis import given, settings
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline import se3
from hodge_pipeline.recipe.recording_options import SHARES, RecordingOptions
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.frames import image_rows
from hodge_pipeline.recording.results import level_of
from hodge_pipeline.types import (
    Camera,
    CloudSet,
    Edges,
    EncodedImage,
    Frame,
    Model,
    PointCloud,
    Solution,
    ViewGraph,
)
from hodge_pipeline.types.arrays import evenly
from recording_data import (
    CAMERA,
    chunks,
    circle,
    column_names,
    make_frames,
    make_solution,
    png,
    record,
    record_all,
    rgb,
    ring_graph,
    rows,
)


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    """Malformed data raises instead of warning."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def test_images_pass_through_unchanged(tmp_path: Path) -> None:
    record(tmp_path).frames("circle", make_frames())
    part = tmp_path / "000-frames.rrd"
    colour = [bytes(row[0]) for row in rows(part, layout.COLOUR, "EncodedImage:blob")]
    depth = [bytes(row[0]) for row in rows(part, layout.DEPTH, "EncodedDepthImage:blob")]
    assert colour == [png(row, 3) for row in range(12)]
    assert depth == [png(row, 1) for row in range(12)]
    assert rows(part, layout.DEPTH, "EncodedDepthImage:meter") == [[5000.0]] * 12
    assert rows(part, layout.COLOUR, layout.FRAME) == list(range(12))


def test_camera_keeps_its_matrix_and_frames_their_ids(tmp_path: Path) -> None:
    record(tmp_path).frames("circle", make_frames())
    part = tmp_path / "000-frames.rrd"
    (matrix,) = rows(part, layout.PINHOLE, "Pinhole:image_from_camera")
    np.testing.assert_array_equal(np.reshape(matrix[0], (3, 3)).T, CAMERA.matrix)
    assert rows(part, layout.PINHOLE, "Pinhole:resolution") == [[[8.0, 6.0]]]
    assert rows(part, layout.CAMERA, "frame_id") == [[str(4 * row)] for row in range(12)]


def test_camera_with_y_up_is_turned_not_mirrored(tmp_path: Path) -> None:
    record(tmp_path).frames("up", make_frames(2, Camera(8, 6, 10.0, -10.0, 4.0, 3.0)))
    part = tmp_path / "000-frames.rrd"
    (matrix,) = rows(part, layout.PINHOLE, "Pinhole:image_from_camera")
    assert np.reshape(matrix[0], (3, 3))[1, 1] == 10.0
    assert rows(part, layout.PINHOLE, "Pinhole:camera_xyz") == [[[3, 1, 5]]]


def test_frames_with_their_own_cameras(tmp_path: Path) -> None:
    frames = make_frames(1) + make_frames(2, Camera(4, 4, 5.0, 5.0, 2.0, 2.0))[1:]
    record(tmp_path).frames("two cameras", frames)
    assert rows(tmp_path / "000-frames.rrd", layout.PINHOLE, "Pinhole:resolution") == [[[8.0, 6.0]], [[4.0, 4.0]]]


def test_sensor_time_only_where_stamps_are_a_clock(tmp_path: Path) -> None:
    numbers = [Frame(frame_id=row, stamp_s=float(row), camera=CAMERA) for row in range(3)]
    record(tmp_path / "a").frames("numbers", numbers)
    record(tmp_path / "b").frames("clock", make_frames())
    assert layout.TIME not in column_names(tmp_path / "a/000-frames.rrd", layout.CAMERA)
    assert layout.TIME in column_names(tmp_path / "b/000-frames.rrd", layout.COLOUR)


def test_clouds_exact(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    clouds = [
        PointCloud(rng.normal(size=(n, 3)).astype(np.float32), colours=rng.integers(0, 255, (n, 3), np.uint8))
        for n in (3, 0, 5)
    ]
    record(tmp_path).clouds(make_frames(3), CloudSet.from_clouds(clouds))
    part = tmp_path / "001-clouds.rrd"
    for cloud, points, colours in zip(
        clouds,
        rows(part, layout.CLOUD, "Points3D:positions"),
        rows(part, layout.CLOUD, "Points3D:colors"),
        strict=True,
    ):
        np.testing.assert_array_equal(np.float32(points).reshape(-1, 3), cloud.points_in_cam)
        np.testing.assert_array_equal(rgb(colours).reshape(-1, 3), cloud.colours)


def test_clouds_thinned_to_their_budget(tmp_path: Path) -> None:
    """4 % of 0.016 MB, 16 bytes a point: 40 points."""
    clouds = CloudSet.from_clouds([PointCloud(np.ones((n, 3), np.float32)) for n in (100, 300)])
    notes = record(tmp_path, max_megabytes=0.016).clouds(make_frames(2), clouds)
    assert [len(row) for row in rows(tmp_path / "001-clouds.rrd", layout.CLOUD, "Points3D:positions")] == [10, 30]
    assert notes == ("recording: 40 of 400 cloud points",)


def test_poses_exact_and_unknown_ones_counted(tmp_path: Path) -> None:
    poses = circle()
    poses[5] = np.nan
    notes = record(tmp_path).poses("truth", poses, make_frames())
    part = tmp_path / "002-poses-truth.rrd"
    known = np.delete(np.arange(12), 5)
    centres = np.squeeze(rows(part, layout.poses("truth"), "Transform3D:translation"))
    turns = np.squeeze(rows(part, layout.poses("truth"), "Transform3D:quaternion"))
    np.testing.assert_array_equal(np.float32(centres), np.float32(poses[known, :3, 3]))
    np.testing.assert_array_equal(np.float32(turns), np.float32(se3.to_quat_xyzw(poses[known])))
    (lines,) = rows(part, layout.trajectory("truth"), "LineStrips3D:strips")
    assert [len(line) for line in lines] == [5, 6]
    assert len(rows(part, layout.frusta("truth"), "LineStrips3D:strips")[0]) == 11
    assert notes == ("recording: 1 of 12 poses of truth are unknown and not drawn",)


def test_a_trajectory_breaks_between_sequences() -> None:
    lines = shapes.strips(circle(4), np.array(["a", "a", "b", "b"]))
    assert [len(line) for line in lines] == [2, 2]


def test_edges_coloured_by_residual(tmp_path: Path) -> None:
    poses = circle()
    graph = ring_graph(poses)
    failed = Edges.of([[0, 5], [1, 6]]).put(slice(None), why="too little overlap")
    record(tmp_path).edges(1, graph, poses, failed)
    part = tmp_path / "010-edges-1.rrd"
    (lines,) = rows(part, layout.edges(1), "LineStrips3D:strips")
    (colours,) = rows(part, layout.edges(1), "LineStrips3D:colors")
    (labels,) = rows(part, layout.edges(1), "LineStrips3D:labels")
    np.testing.assert_array_equal(np.float32(lines), np.float32(poses[graph.edges, :3, 3]))
    expected = shapes.residual_colours(shapes.residuals_m(graph, poses))
    np.testing.assert_array_equal(rgb(colours), expected)
    assert labels[0].startswith("0 – 1: given, ") and labels[0].endswith(" mm")
    (grey,) = rows(part, layout.rejected(1), "LineStrips3D:strips")
    np.testing.assert_array_equal(np.float32(grey), np.float32(poses[failed.pairs, :3, 3]))
    (text,) = rows(part, layout.graph_text(1), "TextDocument:text")
    assert "| edges | 24 |" in text[0] and "| candidates that became no edge | 2 |" in text[0]


def test_edges_at_unknown_poses_are_not_drawn(tmp_path: Path) -> None:
    poses = circle()
    graph = ring_graph(poses)
    poses[0] = np.nan
    record(tmp_path).edges(1, graph, poses)
    (lines,) = rows(tmp_path / "010-edges-1.rrd", layout.edges(1), "LineStrips3D:strips")
    assert len(lines) == np.count_nonzero((graph.edges != 0).all(axis=1)) == 20


def test_residual_by_hand() -> None:
    """One edge, 3 m and no turn off in one, a turn of 0.1 rad in the other."""
    poses = np.stack([np.eye(4)] * 2)
    off = se3.exp(np.array([[0, 0, 0, 0, 0, 3.0], [0.1, 0, 0, 0, 0, 0]]))
    graph = ViewGraph.from_edges(np.arange(2), np.array([[0, 1], [0, 1]]), off)
    np.testing.assert_allclose(shapes.residuals_m(graph, poses), [3.0, 0.1], atol=1e-9)


def test_residual_colours_grow_brighter() -> None:
    colours = shapes.residual_colours(np.linspace(0, 0.05, 50), 0.05) @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(colours) > 0).all()
    np.testing.assert_array_equal(shapes.residual_colours(np.array([9.0, np.nan]), 0.05), [[255, 225, 50]] * 2)


def test_solution_film_and_scalars(tmp_path: Path) -> None:
    poses = circle()
    graph = ring_graph(poses)
    start, solution = make_solution(poses, graph)
    record(tmp_path).solution(2, graph, start, solution, make_frames(), first_iteration=7)
    part = tmp_path / "021-solution-2.rrd"
    states = [start, *(step.world_from_cam for step in solution.history)]
    film = [row for row in rows(part, layout.FILM_EDGES, "LineStrips3D:strips") if row]
    colours = [row for row in rows(part, layout.FILM_EDGES, "LineStrips3D:colors") if row]
    for state, lines, packed in zip(states, film, colours, strict=True):
        np.testing.assert_array_equal(np.float32(lines), np.float32(state[graph.edges, :3, 3]))
        np.testing.assert_array_equal(rgb(packed), shapes.residual_colours(shapes.residuals_m(graph, state), 0.05))
    assert rows(part, layout.FILM_EDGES, layout.ITERATION) == [7, 8, 9, 10]
    objective = layout.under(layout.SOLVER_PLOTS, "objective")
    assert rows(part, objective, "Scalars:scalars") == [[10.0], [5.0], [10.0 / 3]]
    assert rows(part, objective, layout.ITERATION) == [8, 9, 10]
    means = np.squeeze(rows(part, layout.under(layout.SOLVER_PLOTS, "residual_mean_m"), "Scalars:scalars"))
    np.testing.assert_allclose(means, [shapes.residuals_m(graph, state).mean() for state in states])
    (final,) = rows(part, layout.solved_edges(2), "LineStrips3D:colors")
    assert tuple(rgb(final)[2]) == shapes.IGNORED_COLOUR
    centres = np.squeeze(rows(part, layout.poses("round_2"), "Transform3D:translation"))
    np.testing.assert_array_equal(np.float32(centres), np.float32(solution.world_from_cam[:, :3, 3]))


def test_film_keeps_first_and_last_iteration(tmp_path: Path) -> None:
    poses = circle()
    graph = ring_graph(poses)
    start, solution = make_solution(poses, graph)
    notes = record(tmp_path, max_megabytes=0.04).solution(1, graph, start, solution)
    part = tmp_path / "011-solution-1.rrd"
    film = [row for row in rows(part, layout.FILM_EDGES, "LineStrips3D:strips") if row]
    assert [len(row) for row in film] == [10, 10]
    assert rows(part, layout.FILM_EDGES, layout.ITERATION) == [0, 3]
    assert "recording: film of round 1 shows 2 of 4 iterations" in notes
    assert "recording: 10 of 24 film edges of round 1 drawn" in notes


def test_graph_without_edges_or_history(tmp_path: Path) -> None:
    poses = circle(3)
    graph = ViewGraph.from_edges(np.arange(3), np.zeros((0, 2)), np.zeros((0, 4, 4)))
    recorder = record(tmp_path)
    assert recorder.edges(1, graph, poses) == ()
    assert recorder.solution(1, graph, poses, Solution(poses, np.arange(3), np.zeros(0))) == ()
    recorder.finish(tmp_path / "out.rrd")


def test_mesh_exact(tmp_path: Path) -> None:
    points = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    colours = np.uint8([[1, 2, 3]] * 3)
    record(tmp_path).model(Model("m", points, points, colours, np.int32([[0, 1, 2]])))
    part = tmp_path / "900-model.rrd"
    np.testing.assert_array_equal(np.float32(rows(part, layout.MODEL, "Mesh3D:vertex_positions")[0]), points)
    assert rows(part, layout.MODEL, "Mesh3D:triangle_indices") == [[[0, 1, 2]]]
    np.testing.assert_array_equal(rgb(rows(part, layout.MODEL, "Mesh3D:vertex_colors")[0]), colours)


def test_mesh_thinned_by_clustering() -> None:
    """A flat grid of 40 x 40 squares: what is left still covers it, and every triangle has three corners."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(41), np.arange(41)))
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    triangles = np.concatenate([corner[:, None] + [0, 1, 41], corner[:, None] + [1, 42, 41]]).astype(np.int32)
    thin = shapes.thin_model(Model("m", np.stack([x, y, 0 * x], axis=1).astype(np.float32), triangles=triangles), 200)
    assert 50 < len(thin.points_in_world) <= 200 and thin.triangles is not None
    assert thin.triangles.max() < len(thin.points_in_world)
    a, b, c = (thin.points_in_world[thin.triangles[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert 0.7 * 1600 < areas.sum() <= 1600


@given(st.integers(0, 500), st.integers(0, 500))
def test_evenly_spread(available: int, kept: int) -> None:
    picked = evenly(available, kept)
    assert len(picked) == min(available, kept)
    if len(picked) > 1:
        assert picked[0] == 0 and picked[-1] == available - 1
        assert np.ptp(np.diff(picked)) <= 1


@settings(max_examples=30, deadline=None)
@given(st.floats(0.0005, 0.01))
def test_images_stay_in_their_share(megabytes: float) -> None:
    frames = make_frames(20)
    picked, notes = image_rows(frames, RecordingOptions(max_megabytes=megabytes))
    total = sum(len(png(int(row), 3)) + len(png(int(row), 1)) for row in picked)
    assert total <= SHARES["images"] * megabytes * 1e6
    assert len(np.unique(np.diff(picked))) <= 1
    assert bool(notes) == (len(picked) < 20)


def test_of_many_frames_few_images_are_read_to_know_their_size() -> None:
    read: list[int] = []

    def image(row: int) -> EncodedImage:
        read.append(row)
        return EncodedImage(bytes(1000 + row % 7 * 50), "image/png")

    frames = [Frame(row, float(row), encoded_colour=partial(image, row)) for row in range(3000)]
    picked, _ = image_rows(frames, RecordingOptions(max_megabytes=1.0))
    assert len(read) <= 64
    assert 0.7 * 0.85e6 < sum(1000 + row % 7 * 50 for row in picked.tolist()) <= 0.85e6


def test_images_that_told_the_sizes_are_not_encoded_again(tmp_path: Path) -> None:
    read: list[str] = []

    def image(name: str) -> EncodedImage:
        read.append(name)
        return EncodedImage(png(0, 3), "image/png")

    frames = [
        replace(frame, encoded_colour=partial(image, f"c{row}"), encoded_depth=partial(image, f"d{row}"))
        for row, frame in enumerate(make_frames(12))
    ]
    recording = record(tmp_path)
    recording.frames("test", frames, [])
    assert len(read) == len(set(read)) == 24


def test_levels(tmp_path: Path) -> None:
    for level in ("summary", "full"):
        record_all(record(tmp_path / level, level=level))
    assert not chunks(tmp_path / "summary/000-frames.rrd", layout.COLOUR)
    assert not chunks(tmp_path / "summary/011-solution-1.rrd", layout.FILM_EDGES)
    assert chunks(tmp_path / "summary/011-solution-1.rrd", layout.solved_edges(1))
    assert len(rows(tmp_path / "full/000-frames.rrd", layout.COLOUR, layout.FRAME)) == 12


def test_everything_shares_the_story_timeline(tmp_path: Path) -> None:
    recorder = record(tmp_path)
    record_all(recorder)
    out = tmp_path / "recording.rrd"
    recorder.finish(out)
    found = list(RrdReader(out).stream().to_chunks())
    assert {chunk.entity_path for chunk in found} >= {layout.MODEL, layout.CLOUD, layout.COLOUR, layout.FILM_EDGES}
    assert [
        chunk.entity_path for chunk in found if not chunk.is_static and layout.STORY not in chunk.timeline_names
    ] == []
    for entity in (layout.MODEL, layout.trajectory("truth"), layout.solved_edges(1)):
        assert all(chunk.is_static for chunk in chunks(out, entity)), entity


def test_real_frames_in_a_few_megabytes(data_dir: Path, tmp_path: Path) -> None:
    frames = SevenScenesReader().open(data_dir / "seven_scenes/redkitchen").frames
    recorder = record(tmp_path, max_megabytes=5)
    (note,) = recorder.frames("red kitchen", frames)
    merged = tmp_path / "recording.rrd"
    recorder.finish(merged)
    assert 3e6 < merged.stat().st_size < 5e6
    shown = rows(merged, layout.COLOUR, layout.FRAME)
    assert note.startswith(f"recording: images of {len(shown)} of 250 frames") and len(set(np.diff(shown))) == 1
    first = frames[0].encoded_colour
    assert first is not None
    assert bytes(rows(merged, layout.COLOUR, "EncodedImage:blob")[0][0]) == first().contents


@pytest.mark.parametrize(("flushes", "room"), [(False, 200_000), (True, 200_000), (False, 0)])
def test_a_recording_without_room_is_one_line_and_never_waits_for_ever(
    tmp_path: Path, flushes: bool, room: int
) -> None:
    pytest.importorskip("resource", reason="this system has no limit on the size of a file")
    script = textwrap.dedent(f"""
        import resource, sys
        from pathlib import Path
        import numpy as np
        import rerun as rr
        from hodge_pipeline.errors import WorkspaceError
        from hodge_pipeline.recording import stream as streams
        streams.TURN_S, streams.STALLED_S = 0.2, 0.6
        resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room}))
        try:
            with streams.writing(Path(sys.argv[1]) / "000-frames.rrd", "test") as stream:
                for _ in range(10):
                    stream.log("points", rr.Points3D(np.random.default_rng(0).random((20_000, 3))))
                    if {flushes}:
                        try:
                            stream.flush(timeout_sec=0.2)
                        except RuntimeError:
                            break
        except WorkspaceError as error:
            print(error)
    """)
    done = subprocess.run([sys.executable, "-c", script, str(tmp_path)], capture_output=True, text=True, timeout=300)
    assert "the recording cannot be written" in done.stdout and done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_line_of_the_log_has_the_level_that_it_was_logged_with() -> None:
    lines = ("the error of the trajectory is 2 cm", "a warning is no ERROR", "stopped")
    levels = [
        level_of(f"2026-01-01 10:00:00,000 {name} {line}")
        for name, line in zip(("INFO", "WARNING", "ERROR"), lines, strict=True)
    ]
    assert levels == ["INFO", "WARN", "ERROR"] and level_of("") == level_of("an error on its own") == "INFO"

"""A start from nothing: pieces joined where the evidence joins them, left apart and said where it does not."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from hodge_adapters.clouds.ply import write_ply
from hodge_pipeline import se3
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.registration.colour_evidence import hue_conflicts
from hodge_pipeline.registration.global_evidence import DepthView
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.start.clouds import clouds as make_clouds
from hodge_pipeline.start.unordered.folds import Pieces, contradictions, laid_apart, unfolded, within_parts
from hodge_pipeline.start.unordered.hypotheses import (
    AMBIGUOUS,
    LEAST_HUE_CONFLICT,
    LEAST_VIOLATION,
    MOST_VIOLATION,
    _ambiguous,
    _Evidence,
    allowed_hue_conflict,
    allowed_violation,
)
from hodge_pipeline.start.unordered.options import GlobalStart, HypothesisLimits
from hodge_pipeline.start.unordered.scan_checks import check_scans, mirrored_scans, unregistrable, within_their_frame
from hodge_pipeline.start.unordered.start import Frames, Start, _ambiguous_pairs, _none_joined, find_start
from hodge_pipeline.start.unordered.tour import propose_along_tour, tour
from hodge_pipeline.types import Camera, CloudSet, Edges, Floats, Frame, PointCloud, Registration, Source, ViewGraph
from hodge_pipeline.types.edges import REJECTED, USED
from hodge_pipeline.types.notes import Note
from scan_data import write_e57
from test_global_registration import furnished_corner

OPTIONS = CloudOptions(voxel_m=0.05, min_range_m=0.0, max_range_m=100.0)


def read(points: Floats) -> PointCloud:
    return PointCloud(points.astype(np.float32))


def scan(name: int, points: Floats) -> Frame:
    return Frame(name, float(name), read_points=partial(read, points))


def started(folder: Path, frames: list[Frame]) -> Start:
    clouds = folder / "clouds"
    clouds.mkdir()
    CloudSet.from_clouds([make_cloud(frame, OPTIONS)[0] for frame in frames]).save(clouds)
    scene = Frames(frames, clouds, np.array([frame.frame_id for frame in frames]))
    with LocalExecutor(workers=0).open() as workers:
        return find_start(scene, GlobalStart(use="geometry"), folder / "scratch", workers, no_progress)


def seen_from(pose: Floats, points: Floats) -> Floats:
    return se3.transform(se3.inverse(pose), points)


POSES = se3.exp(
    np.array([[0.1, 0.2, 0.1, 1.0, 1.0, 1.0], [0.5, -0.7, 1.9, 1.2, 0.8, 1.1], [-0.5, 0.3, -1.2, 0.9, 1.2, 0.9]])
)


def test_scans_of_one_place_are_joined_and_a_stranger_and_a_wall_are_left_apart(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    stranger = rng.uniform(-1, 1, (6, 1, 3)) + 0.25 * unit(rng.normal(size=(6, 3000, 3)))
    wall = rng.uniform(-1, 1, (20_000, 3)) * [1.5, 1.0, 0.002] + [0, 0, 2.0]
    frames = [scan(k, seen_from(pose, furnished_corner(k))) for k, pose in enumerate(POSES)]
    found = started(tmp_path, [*frames, scan(3, stranger.reshape(-1, 3)), scan(4, wall)])
    assert found.piece.tolist()[:3] == [0, 0, 0]
    assert len(set(found.piece.tolist())) == 3
    for i, j in ((0, 1), (0, 2), (1, 2)):
        error = se3.log(
            se3.inverse(se3.inverse(POSES[i]) @ POSES[j])
            @ se3.inverse(found.world_from_cam[i])
            @ found.world_from_cam[j]
        )
        assert np.abs(error).max() < 0.02
    said = "\n".join(map(str, found.notes))
    assert "scan 4: cannot be registered by its shape: its surfaces leave open" in said
    assert "falls into 3 pieces" in said


def test_scans_that_were_registered_before_stay_where_they_lie_and_no_free_space_tests_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [scan(k, furnished_corner(k) - [1.0, 1.0, 1.0]) for k in range(3)]
    frames.append(scan(3, furnished_corner(3)[:90_000] - [1.0, 1.0, 1.0]))  # its scanner saw no box and no ball
    stranger = rng.uniform(-1, 1, (6, 1, 3)) + 0.25 * unit(rng.normal(size=(6, 3000, 3)))
    found = started(tmp_path, [*frames, scan(4, stranger.reshape(-1, 3))])
    assert found.piece.tolist() == [0, 0, 0, 0, 1]
    assert np.abs(se3.log(found.world_from_cam)).max() < 0.02, "neither moved nor laid apart"
    assert any(note.kind == "one frame" for note in found.notes)


def test_rooms_alike_of_one_frame_are_not_laid_on_each_other_and_a_scan_of_another_frame_is_joined() -> None:
    along = se3.exp(np.array([0, 0, 0, 8.0, 0, 0]))
    pairs = np.array([[0, 1], [2, 3], [0, 2], [1, 4]])  # 0 and 1 in a room, 2 and 3 in one like it, 4 of another frame
    found = Registration(np.eye(4), np.eye(6), 0.9, 0.01, 500, 5, True)
    elsewhere = replace(found, i_from_j=along)
    edges = Edges.of(pairs).with_registrations([found, found, elsewhere, elsewhere])
    assert within_their_frame(edges.put(slice(None), status=USED), 1.0).counts.tolist() == [True, True, False, True]


def test_a_single_scan_gives_no_pair_along_its_tour() -> None:
    none = propose_along_tour(
        SequentialEdges(), [scan(0, np.eye(3))], CloudSet.from_clouds([read(np.eye(3))]), np.eye(4)[None]
    )
    assert len(none) == 0


@pytest.mark.parametrize(("turned", "is_kept"), [(False, True), (True, False)])
def test_a_motion_with_a_rival_that_fits_as_well_is_refused(turned: bool, is_kept: bool) -> None:
    motions = se3.exp(np.array([[0.0] * 6, [0, 0, np.pi / 2 * turned, 0, 0, 0]]))
    edges = Edges.of([[0, 1], [0, 1]]).put(slice(None), status=USED, overlap=np.array([0.8, 0.7]), i_from_j=motions)
    told, one = np.array([0.02, 0.02]), np.zeros(1, np.int64)
    found = _ambiguous(edges, np.zeros(2, np.int64), one, told, np.array([90, 30]), HypothesisLimits())
    assert found.tolist() == [not is_kept]


def test_how_much_two_scans_must_share_is_the_recipes_to_say() -> None:
    told = _Evidence(*(np.array([share]) for share in (0.15, 0.0, 0.0, 0.01)), np.array([False]))
    reasons = [told.reasons(np.zeros(1, np.int64), HypothesisLimits(min_overlap=least)).item() for least in (0.2, 0.1)]
    assert reasons == ["too little overlap", ""]


def unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def cloud(points: Floats) -> PointCloud:
    return make_cloud(scan(0, points), OPTIONS)[0]


def test_a_plane_names_its_free_directions() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (20_000, 3)) * [1.5, 1.0, 0.005] + [0, 0, 2.0]
    reason = unregistrable(cloud(points))
    assert reason.count("sliding along") == 2 and "turning about (0.00, -0.00, 1.00)".replace("-", "") in reason


def test_a_blob_and_five_points_are_said_to_be_so() -> None:
    rng = np.random.default_rng(0)
    assert "no surface" in unregistrable(cloud(rng.normal(size=(40_000, 3)) * 0.3))
    assert "only 5 points" in unregistrable(cloud(rng.normal(size=(5, 3))))
    assert unregistrable(cloud(furnished_corner(0))) == ""


def test_copies_are_noticed() -> None:
    corner = furnished_corner(0)
    clouds = CloudSet.from_clouds([read(corner), read(corner), read(furnished_corner(1))])
    assert any("scan 8: holds the same points as scan 7" in note for note in check_scans(clouds, np.array([7, 8, 9])))


def test_a_scan_in_millimetres_is_named_though_few_of_its_points_are_in_range(tmp_path: Path) -> None:
    corner = furnished_corner(0)
    scans = [read(corner), read(furnished_corner(1)), read(1000 * corner)]
    frames = [Frame(f"{row}.ply", float(row), read_points=partial(scans.__getitem__, row)) for row in range(3)]
    said: list[Note] = []
    step = Step(tmp_path, no_progress, lambda *notes: said.extend(notes))
    source = Source("corners", tmp_path, tuple(frames))
    with LocalExecutor(workers=0).open() as workers:
        make_clouds(source, CloudOptions(max_range_m=20.0), workers=workers, step=step)
    told = [str(note) for note in said if note.kind == "other units"]
    assert len(told) == 1 and "2.ply: it seems to have other units" in told[0] and "units_per_metre" in told[0]


def test_pieces_lie_beside_each_other() -> None:
    clouds = CloudSet.from_clouds([read(furnished_corner(k)) for k in range(3)])
    in_pieces = POSES[::-1]
    poses = laid_apart(np.array([0, 1, 0]), in_pieces, clouds)
    assert np.allclose(poses[0], np.eye(4)) and poses[2, 0, 3] < 0  # the world is that of the first frame
    relative = se3.inverse(poses[0]) @ poses[2]
    assert np.allclose(relative, se3.inverse(in_pieces[0]) @ in_pieces[2])
    assert poses[1, 0, 3] - max(poses[0, 0, 3], poses[2, 0, 3]) > 3 * clouds.reach_m


def test_six_real_fragments_in_no_order(data_dir: Path, tmp_path: Path) -> None:
    from hodge_adapters.clouds.reader import CloudFolderReader
    from hodge_adapters.trajectories.log import read_log_file

    fragments = data_dir / "fragments"
    frames = CloudFolderReader(log="").open(fragments / "redkitchen_3dmatch").frames
    order = [3, 5, 0, 2, 4, 1]
    found = started(tmp_path, [frames[k] for k in order])
    truth = read_log_file(fragments / "pair_estimates/7-scenes-redkitchen-evaluation/gt.log")
    poses = dict(zip(order, found.world_from_cam, strict=True))
    assert (found.piece == 0).all()
    for (i, j), wanted in zip(truth.pairs.tolist(), truth.i_from_j, strict=True):
        if i in poses and j in poses:
            error = se3.inverse(wanted) @ se3.inverse(poses[i]) @ poses[j]
            assert np.linalg.norm(error[:3, 3]) < 0.07
            assert np.degrees(np.linalg.norm(se3.so3_log(error[:3, :3]))) < 2.2


def test_the_recipe_scans_from_files_to_a_report(tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    for name, (k, pose) in zip(("b", "a"), enumerate(POSES[:2]), strict=True):
        write_ply(folder / f"{name}.ply", read(seen_from(pose, furnished_corner(k, 10_000))))
    plain = [
        "recording.level=off",
        "evaluation.tables=false",
        "executor={stage: local, workers: 0}",
        "outer_iterations=1",
    ]
    run = hodge_pipeline.run(load_recipe("scans", plain, folder), tmp_path / "run")
    first, second = POSES[1], POSES[0]
    moved = se3.inverse(run.result.world_from_cam[0]) @ run.result.world_from_cam[1]
    assert np.abs(se3.log(se3.inverse(se3.inverse(first) @ second) @ moved)).max() < 0.01
    assert run.report.before == "start"
    assert (tmp_path / "run" / "report.html").is_file() and (tmp_path / "run" / "cloud.ply").is_file()


def test_stations_of_an_e57_are_refined_from_the_poses_that_it_holds(tmp_path: Path) -> None:
    wrong = np.array([[0, 0, 0, 0, 0, 0], [0.01, -0.008, 0.012, 0.02, -0.015, 0.01], [-0.006, 0.01, -0.01, 0, 0.02, 0]])
    given = POSES @ se3.exp(wrong)
    stations = [seen_from(pose, furnished_corner(k, 10_000)) for k, pose in enumerate(POSES)]
    path = write_e57(tmp_path / "hall.e57", given, stations)
    options = ["start=given", "recording.level=off", "executor={stage: local, workers: 0}"]
    done = hodge_pipeline.run(load_recipe("scans", options, path), tmp_path / "run")
    assert done.report.before == "start" and "3 of 3 frames have a given pose" in " ".join(map(str, done.report.notes))
    assert absolute_error(given, POSES).max_m > 0.01  # what is to be mended
    assert absolute_error(done.result.world_from_cam, POSES).max_m < 0.002
    # The result lies in the world of the poses given, a building's or a map's.
    assert np.linalg.norm(done.result.world_from_cam[:, :3, 3] - given[:, :3, 3], axis=1).max() < 0.04
    assert (tmp_path / "run" / "report.html").is_file() and (tmp_path / "run" / "cloud.ply").is_file()


def test_a_tour_takes_the_nearest_and_pairs_come_back_to_their_rows() -> None:
    shuffled = np.random.default_rng(0).permutation(12)
    poses = se3.exp(np.array([0.0, 0, 0, 0.1, 0, 0]) * shuffled[:, None])
    order = tour(poses)
    steps = np.abs(np.diff(shuffled[order]))
    assert sorted(order.tolist()) == list(range(12)) and (steps == 1).sum() >= 10  # one jump, from an end to the rest
    frames = [scan(int(k), np.zeros((1, 3))) for k in shuffled]
    clouds = CloudSet.from_clouds([read(np.ones((20, 3)))] * 12)
    found = propose_along_tour(SequentialEdges(), frames, clouds, poses)
    assert (found.pairs[:, 0] < found.pairs[:, 1]).all() and set(found.proposed_by.tolist()) == {"nearest"}
    assert sorted(np.abs(shuffled[found.pairs[:, 0]] - shuffled[found.pairs[:, 1]]).tolist()) == sorted(steps.tolist())


def test_what_a_run_allows_its_pairs_to_see_through_follows_its_camera() -> None:
    assert allowed_violation(np.array([0.0, 0.0, 0.001, 0.1])) == LEAST_VIOLATION
    assert allowed_violation(np.array([0.01, 0.01, np.nan, 0.3])) == pytest.approx(0.12)
    assert allowed_violation(np.full(5, 0.2)) == MOST_VIOLATION
    assert allowed_violation(np.repeat([0.0, 0.1], [12, 16])) == LEAST_VIOLATION  # two rooms, most pairs are of both
    assert allowed_violation(np.full(2, np.nan)) == LEAST_VIOLATION


def test_parts_grow_from_the_strongest_edges_and_hold_no_forbidden_pair() -> None:
    #  0 -9- 1 -2- 2 -8- 3 -1- 0     0 and 3 exclude each other
    edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    strength = np.array([9.0, 2.0, 8.0, 1.0])
    assert within_parts(edges, strength, np.array([[0, 3]]), 4).tolist() == [True, False, True, False]
    assert within_parts(edges, strength, np.zeros((0, 2), np.int64), 4).all()
    given = np.array([9.0, np.inf, 8.0, 1.0])
    assert within_parts(edges, given, np.array([[0, 3]]), 4).tolist() == [True, True, False, False]


def wall_at(depth_m: float) -> tuple[PointCloud, DepthView]:
    camera = Camera(80, 60, 60.0, 60.0, 39.5, 29.5)
    column, row = np.meshgrid(np.arange(80), np.arange(60))
    rays = np.stack([(column - 39.5) / 60, (row - 29.5) / 60, np.ones((60, 80))], axis=-1).reshape(-1, 3)
    return read(depth_m * rays), DepthView(np.full((60, 80), depth_m, np.float32), 1, camera)


@pytest.mark.parametrize("far_m", [4.0, 2.0])
def test_frames_that_see_through_each_other_are_cut_apart_although_their_edges_agree(far_m: float) -> None:
    seen = [wall_at(2.0), wall_at(2.0), wall_at(far_m), wall_at(far_m)]
    clouds, views = CloudSet.from_clouds([cloud for cloud, _ in seen]), [view for _, view in seen]
    graph = ViewGraph.from_edges(np.arange(4), np.array([[0, 1], [2, 3], [1, 2]]), np.tile(np.eye(4), (3, 1, 1)))
    graph.correspondences[:] = [900, 900, 100]
    pieces = Pieces(graph, np.zeros(4, np.int64), np.tile(np.eye(4), (4, 1, 1)))
    options = GlobalStart().diagnosis
    assert contradictions(clouds, pieces, np.arange(len(pieces.piece)), views.__getitem__).folded == (far_m > 2)
    found = unfolded(clouds, pieces, 0, views.__getitem__, options)
    if far_m == 2:
        assert found is pieces
    else:
        assert found.graph.edges.tolist() == [[0, 1], [2, 3]]
        assert found.piece[0] == found.piece[1] != found.piece[2] == found.piece[3]
        assert "4 contradict each other" in found.notes[0]


def test_margins_of_free_space_are_of_the_scene_not_of_a_room() -> None:
    room_m = 0.02
    seen = [wall_at(2.0 * room_m), wall_at(2.0 * room_m), wall_at(4.0 * room_m), wall_at(4.0 * room_m)]
    clouds, views = CloudSet.from_clouds([cloud for cloud, _ in seen]), [view for _, view in seen]
    graph = ViewGraph.from_edges(np.arange(4), np.array([[0, 1], [2, 3], [1, 2]]), np.tile(np.eye(4), (3, 1, 1)))
    pieces = Pieces(graph, np.zeros(4, np.int64), np.tile(np.eye(4), (4, 1, 1)))
    found = unfolded(clouds, pieces, 0, views.__getitem__, GlobalStart().diagnosis, room_m)
    assert found.piece[0] == found.piece[1] != found.piece[2] == found.piece[3]
    assert unfolded(clouds, pieces, 0, views.__getitem__, GlobalStart().diagnosis, 1.0) is pieces


def test_a_wall_seen_from_farther_off_contradicts_nothing() -> None:
    seen = [wall_at(2.0), wall_at(2.0), wall_at(4.0), wall_at(4.0)]
    clouds, views = CloudSet.from_clouds([cloud for cloud, _ in seen]), [view for _, view in seen]
    poses = np.tile(np.eye(4), (4, 1, 1))
    graph = ViewGraph.from_edges(np.arange(4), np.zeros((0, 2), int), np.zeros((0, 4, 4)))
    rows = np.arange(4)
    together = Pieces(graph, np.zeros(4, np.int64), poses)
    assert len(contradictions(clouds, together, rows, views.__getitem__).pairs) == 4
    poses = poses.copy()
    poses[2:, 2, 3] = -2.0
    apart = contradictions(clouds, Pieces(graph, np.zeros(4, np.int64), poses), rows, views.__getitem__)
    assert apart.looked_at == 6 and not len(apart.pairs)


def test_what_odometry_holds_is_not_cut_where_it_drifts() -> None:
    seen = [wall_at(2.0), wall_at(2.0), wall_at(4.0), wall_at(4.0)]
    clouds, views = CloudSet.from_clouds([cloud for cloud, _ in seen]), [view for _, view in seen]
    chain = ViewGraph.from_edges(np.arange(4), np.array([[0, 1], [1, 2], [2, 3]]), np.tile(np.eye(4), (3, 1, 1)))
    pieces = Pieces(chain, np.zeros(4, np.int64), np.tile(np.eye(4), (4, 1, 1)))
    options = GlobalStart().diagnosis
    assert unfolded(clouds, pieces, 3, views.__getitem__, options) is pieces
    assert unfolded(clouds, pieces, 0, views.__getitem__, options) is not pieces


def painted(poster: tuple[int, int, int]) -> PointCloud:
    flat = np.random.default_rng(5).uniform(-1, 1, (4000, 2))
    colours = np.full((4000, 3), 180, np.uint8)
    colours[(np.abs(flat) < 0.3).all(axis=1)] = poster
    return PointCloud(np.column_stack([flat, np.full(4000, 2.0)]).astype(np.float32), None, colours)


def test_colours_tell_two_places_of_one_shape_apart_in_any_light() -> None:
    red = painted((200, 40, 40))
    assert red.colours is not None
    darker = PointCloud(red.points_in_cam, None, (0.6 * red.colours).astype(np.uint8))
    bare = PointCloud(red.points_in_cam)
    clouds = CloudSet.from_clouds([red, darker, painted((40, 60, 200)), bare])
    conflicts = hue_conflicts(clouds, np.array([[0, 1], [0, 2], [1, 2]]), np.tile(np.eye(4), (3, 1, 1)))
    assert conflicts[0] < 0.01
    assert (conflicts[1:] > 0.05).all()
    assert np.isnan(hue_conflicts(CloudSet.from_clouds([bare, bare]), np.array([[0, 1]]), np.eye(4)[None])).all()


def test_what_hues_may_differ_by_follows_the_best_pairs_of_a_run() -> None:
    assert allowed_hue_conflict(np.array([])) == LEAST_HUE_CONFLICT
    assert allowed_hue_conflict(np.array([0.0, 0.0, 0.1, np.nan])) == LEAST_HUE_CONFLICT
    assert np.isclose(allowed_hue_conflict(np.full(5, 0.01)), 0.12)


def test_pairs_that_fit_in_several_ways_are_told_unless_others_join_their_scans() -> None:
    edges = Edges.of([[0, 1], [0, 2], [1, 2]])
    edges = edges.put(slice(None), status=REJECTED, why=np.array([AMBIGUOUS, AMBIGUOUS, "too little overlap"]))
    assert [(note.kind, note.count, note.detail) for note in _ambiguous_pairs(edges, np.array([0, 0, 1]))] == [
        ("ambiguous", 1, "3")
    ]
    assert _ambiguous_pairs(edges, np.array([0, 0, 0])) == ()


@pytest.mark.parametrize(("pose", "todo"), [(np.eye(4), "start=given"), (None, "2 of 3 pairs: too little overlap")])
def test_where_no_two_scans_are_joined_the_report_says_what_to_do(pose: Floats | None, todo: str) -> None:
    edges = Edges.of([[0, 1], [0, 2], [1, 2]])
    edges = edges.put(
        slice(None), status=REJECTED, why=np.array([AMBIGUOUS, "too little overlap", "too little overlap"])
    )
    frames = [Frame(row, float(row), world_from_cam=pose) for row in range(3)]
    scene = Frames(frames, Path(), np.arange(3))
    (note,) = _none_joined(scene, edges, np.arange(3))
    assert note.kind == "none joined" and todo in note.detail
    assert _none_joined(scene, edges, np.array([0, 0, 1])) == ()


def test_where_no_pair_was_tried_nobody_is_asked_for_more_scans() -> None:
    scene = Frames([Frame(row, float(row)) for row in range(3)], Path(), np.arange(3))
    (note,) = _none_joined(scene, Edges.of(np.zeros((0, 2), int)), np.arange(3))
    assert note.detail == "no pair was tried"


@pytest.mark.parametrize("of_reflection, found", [(0.6, [2]), (0.12, [])], ids=["mirrored", "far off"])
def test_a_scan_whose_reflection_fits_clearly_better_is_mirrored(
    of_reflection: float, found: list[int], tmp_path: Path
) -> None:
    corner = furnished_corner(0)
    clouds = CloudSet.from_clouds([read(corner)] * 4)
    pairs = np.array([[0, 1], [0, 3], [1, 3], [0, 2], [2, 3]])
    overlap = np.array([0.6, 0.5, 0.6, 0.15, 0.12])
    edges = Edges.of(pairs).put(slice(None), status=USED, overlap=overlap, i_from_j=np.eye(4))

    def match(alone: CloudSet, _folder: Path) -> Edges:
        np.testing.assert_allclose(alone[0].points_in_cam, corner * [-1, 1, 1], atol=1e-6)
        at = np.stack([np.zeros(2, int), [1, 2]], axis=1)
        return Edges.of(at).put(slice(None), status=USED, overlap=np.full(2, of_reflection), i_from_j=np.eye(4))

    assert mirrored_scans(clouds, edges, match, tmp_path).tolist() == found

"""Refinement from Python: arrays and Open3D objects in and out; the correction spread; the file forms."""

import codecs
import json
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hodge_pipeline
from hodge_adapters.icl_nuim.reader import IclNuimReader
from hodge_adapters.nerfstudio import NerfstudioReader
from hodge_adapters.trajectories.log import read_log_file
from hodge_adapters.trajectories.rewriting import (
    EurocRewriter,
    KittiRewriter,
    LogRewriter,
    NerfstudioRewriter,
    SevenScenesRewriter,
    TumRewriter,
)
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import registry, se3
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.errors import GraphError, SourceError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.scene import choose_key_frames
from hodge_pipeline.se3 import spread_correction
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.start.match_poses import match_poses
from hodge_pipeline.types import Floats, Frame, Source, Trajectory

OFF = ("executor.workers=0", "recording.level=off", "evaluation.tables=false")
SMALL = ("clouds.voxel_m=0.06", "outer_iterations=1", *OFF)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> tuple[Frame, ...]:
    room = DemoOptions(frames=12, width=160, height=120, noise=0.3)
    return TumReader().open(make_sequence(tmp_path_factory.mktemp("room") / "s", room)).frames


def drifted(frames: tuple[Frame, ...]) -> tuple[Floats, Floats]:
    truth = np.array([frame.world_from_cam for frame in frames])
    share = np.clip((np.arange(len(frames)) - 3) / 5, 0, 1)[:, None]
    return truth, truth @ se3.exp(share * np.array([0, 0.05, 0, 0.06, 0, 0]))


def error_m(poses: Floats, truth: Floats) -> float:
    found, true = (se3.inverse(p[0]) @ p for p in (poses, truth))
    return float(np.abs((se3.inverse(true) @ found)[:, :3, 3]).max())


def test_arrays_in_and_out(frames: tuple[Frame, ...]) -> None:
    truth, start = drifted(frames)
    depths = [frame.read_depth() for frame in frames if frame.read_depth]
    camera = frames[0].camera
    assert camera is not None
    made = hodge_pipeline.frames_from_images(depths, camera.matrix)
    better = hodge_pipeline.refine_trajectory(start, made, overrides=SMALL)
    assert better.decision.outcome == "refined" and better.poses.shape == (12, 4, 4)
    assert error_m(better.poses, truth) < 0.4 * error_m(start, truth)
    again = hodge_pipeline.refine_trajectory(better.poses, made, overrides=SMALL)
    assert again.decision.outcome == "optimal" and again.poses is better.poses


def test_an_open3d_trajectory_in_and_out(frames: tuple[Frame, ...]) -> None:
    truth, start = drifted(frames)
    trajectory = o3d.camera.PinholeCameraTrajectory()
    parameters = []
    for pose in start:
        one = o3d.camera.PinholeCameraParameters()
        one.extrinsic, one.intrinsic = se3.inverse(pose), o3d.camera.PinholeCameraIntrinsic(160, 120, 1, 2, 3, 4)
        parameters.append(one)
    trajectory.parameters = parameters
    better = hodge_pipeline.refine_trajectory(trajectory, frames, overrides=SMALL).poses
    assert isinstance(better, o3d.camera.PinholeCameraTrajectory)
    assert better.parameters[3].intrinsic.intrinsic_matrix[1, 1] == 2
    poses = se3.inverse(np.array([one.extrinsic for one in better.parameters]))
    assert error_m(poses, truth) < 0.4 * error_m(start, truth)
    np.testing.assert_array_equal(trajectory.parameters[5].extrinsic, se3.inverse(start[5]))


def test_poses_of_other_frames_refine_nothing(frames: tuple[Frame, ...]) -> None:
    poses = np.array([frame.world_from_cam for frame in frames])
    poses[2:, :3, 3] += 100.0 * np.arange(2, len(poses))[:, None]
    decision = hodge_pipeline.refine_trajectory(poses, frames, overrides=SMALL).decision
    assert decision.outcome == "nothing" and "only 2 of 12 key frames" in decision.reason


def test_poses_of_opengls_camera_are_named_and_given_back(frames: tuple[Frame, ...]) -> None:
    """They were rewritten into poses of our camera, as better ones."""
    given = drifted(frames)[0] @ np.diag([1.0, -1.0, -1.0, 1.0])
    found = hodge_pipeline.refine_trajectory(given, frames, overrides=SMALL)
    assert found.decision.outcome == "convention" and found.decision.exit_code == 3 and found.poses is given
    assert "OpenGL" in found.decision.reason and found.report.refinement is not None
    assert found.report.refinement.headline == "The poses given look to be of another convention: they are given back"
    forced = hodge_pipeline.refine_trajectory(given, frames, overrides=SMALL, force=True)
    assert forced.decision.outcome == "forced" and "OpenGL" in forced.decision.reason


@pytest.mark.parametrize("shape", [(3, 4, 4), (12, 3, 4)])
def test_poses_that_are_not_one_for_each_frame_are_refused(frames: tuple[Frame, ...], shape: tuple[int, ...]) -> None:
    with pytest.raises(SourceError, match="one 4x4 matrix for each frame"):
        hodge_pipeline.refine_trajectory(np.zeros(shape), frames)


def test_an_open3d_pose_graph_is_solved_and_its_wrong_edge_found() -> None:
    """A square 0-1-2-3 with both diagonals and its closing edge, and one false loop.

    3---2
    | X |
    0---1
    """
    reg = o3d.pipelines.registration
    rng = np.random.default_rng(0)
    truth = se3.exp(rng.normal(0, 0.5, (4, 6)))
    graph = reg.PoseGraph()
    for row, pose in enumerate(truth):
        graph.nodes.append(reg.PoseGraphNode(pose @ se3.exp(rng.normal(0, 0.05, 6) * (row > 0))))
    for i, j in [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)]:
        graph.edges.append(reg.PoseGraphEdge(i, j, se3.inverse(truth[j]) @ truth[i], np.eye(6) * 1e4, False))
    graph.edges.append(reg.PoseGraphEdge(0, 2, se3.exp(np.array([0, 0, 1.0, 0.5, 0, 0])), np.eye(6) * 1e4, True))
    solved = hodge_pipeline.solve_pose_graph(graph)
    assert isinstance(solved, reg.PoseGraph) and [edge.confidence for edge in solved.edges] == [1.0] * 6 + [0.0]
    np.testing.assert_allclose([node.pose for node in solved.nodes], truth, atol=1e-6)
    graph.edges.append(reg.PoseGraphEdge(0, 9, np.eye(4), np.eye(6), True))
    with pytest.raises(GraphError, match="not among the 4"):
        hodge_pipeline.solve_pose_graph(graph)


finite = st.lists(st.floats(-1, 1), min_size=6, max_size=6).map(lambda xi: se3.exp(np.array(xi)))


@given(finite, finite, st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_a_spread_correction_meets_its_keys_wherever_the_world_and_the_body_are(
    w: Floats, b: Floats, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    poses = se3.exp(rng.normal(0, 0.5, (7, 6)))
    times, keys = np.arange(7.0), np.array([1, 4])
    after = se3.exp(rng.normal(0, 0.1, (2, 6))) @ poses[keys]
    found = spread_correction(times, poses, times[keys], poses[keys], after)
    np.testing.assert_allclose(found[keys], after, atol=1e-9)
    moved = spread_correction(times, w @ poses, times[keys], w @ poses[keys], w @ after)
    np.testing.assert_allclose(moved, w @ found, atol=1e-9)
    rigid = spread_correction(times, poses, times[keys], poses[keys], b @ poses[keys])
    np.testing.assert_allclose(rigid, b @ poses, atol=1e-9)


def test_a_correction_needs_a_key_pose() -> None:
    with pytest.raises(GraphError, match="at least one"):
        spread_correction(np.zeros(1), np.eye(4)[None], np.zeros(0), np.zeros((0, 4, 4)), np.zeros((0, 4, 4)))


def test_key_frames_are_the_ends_every_nth_and_where_it_moved() -> None:
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[3:, 0, 3] = 0.2
    poses[8:] = poses[8:] @ se3.exp(np.array([0, 0, 0.3, 0, 0, 0]))
    rows = [np.arange(10), np.arange(10, 12)]
    assert choose_key_frames(poses, rows, 0.1, 8.0, 0).tolist() == [0, 3, 8, 9, 10, 11]
    assert choose_key_frames(poses, rows, 0.1, 8.0, 4).tolist() == [0, 3, 4, 8, 9, 10, 11]


def numbered(stamps: list[float]) -> list[Frame]:
    return [Frame(row, stamp) for row, stamp in enumerate(stamps)]


def test_poses_find_their_frames_by_stamp_number_or_row() -> None:
    poses = se3.exp(np.arange(24).reshape(4, 6) / 100)
    clock = Trajectory(np.array([10.0, 10.1, 10.2, 11.0]), poses)
    found = match_poses(clock, numbered([10.05, 10.2, 10.6]), "auto", 0.1, "x")
    assert found.how == "stamp" and np.isfinite(found.world_from_cam[:, 0, 0]).tolist() == [True, True, False]
    rows = Trajectory(np.arange(4.0), poses)
    assert match_poses(rows, numbered([7.0, 8.0, 9.0, 9.5]), "auto", 0.1, "x").how == "row"
    halves = Trajectory(np.array([0.0, 2.0]), poses[:2])
    assert match_poses(halves, numbered([7.0, 8.0, 9.0, 9.5]), "auto", 0.1, "x").how == "number"
    with pytest.raises(SourceError, match="4 poses at 10 to 11, 3 frames at 70 to 90"):
        match_poses(clock, numbered([70.0, 80.0, 90.0]), "auto", 0.1, "x")
    with pytest.raises(SourceError, match="by row"):
        match_poses(clock, numbered([10.0, 11.0]), "row", 0.1, "x")


def test_poses_without_stamps_for_another_number_of_frames_are_matched_by_request_alone(tmp_path: Path) -> None:
    """Four rows of KITTI for three frames went to the frames of their row numbers."""
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 4)
    rows = guess_reader(tmp_path / "poses.txt").open(tmp_path / "poses.txt").trajectory
    assert rows is not None
    frames = numbered([0.0, 1.0, 2.0])
    with pytest.raises(SourceError, match="4 poses without stamps for 3 frames: .*--match number"):
        match_poses(rows, frames, "auto", 0.1, "x")
    assert match_poses(rows, frames, "number", 0.1, "x").how == "number"
    assert match_poses(rows, numbered([0.0, 1.0, 2.0, 3.0]), "auto", 0.1, "x").how == "row"


def test_poses_have_a_frame_where_they_lie_among_the_frames() -> None:
    """Frames 0.2 s apart with a hole; poses before, between, half a frame after the end, in the hole, and later."""
    stamps = np.array([-0.15, 0.05, 0.31, 0.75, 0.8, 2.0, 3.05, 3.2, 3.3, 4.0])
    trajectory = Trajectory(stamps, np.broadcast_to(np.eye(4), (len(stamps), 4, 4)))
    frames = numbered([-2.0, 0.0, 0.2, 0.4, 0.6, 2.8, 3.0, 3.2])
    matched = match_poses(trajectory, frames[1:], "auto", 0.1, "x")
    assert matched.has_frame(0.1).tolist() == [False, True, True, True, True, False, True, True, True, False]
    assert matched.outside() == 0 and match_poses(trajectory, frames, "auto", 0.1, "x").outside() == 1


FILES = {
    "kept.txt": (TumRewriter, "# mine\n1.50 0 0 0 0 0 0 1 # end\n\n2.50\t1 0 0 0 0 0 1\n"),
    "kept.kitti": (KittiRewriter, "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n"),
    "data.csv": (EurocRewriter, "#timestamp, p_RS_R_x, q_RS_w\n1403636580838555648,0,0,0,1,0,0,0,.5\n"
                 "1403636580843555648,1,0,0,1,0,0,0,.25\n"),
    "kept.log": (LogRewriter, "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n3 3 4\n1 0 0 1\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_only_the_poses_change_in_a_file(name: str, tmp_path: Path) -> None:
    rewriter, text = FILES[name]
    (tmp_path / name).write_text(text)
    trajectory = guess_reader(tmp_path / name).open(tmp_path / name).trajectory
    assert trajectory is not None and len(trajectory) == 2
    same = rewriter().copy(tmp_path, tmp_path / name)
    assert same.name == f"refined{Path(name).suffix}" and same.read_bytes() == (tmp_path / name).read_bytes()
    moved = Trajectory(trajectory.stamps_s, se3.exp(np.full(6, 0.1)) @ trajectory.world_from_cam)
    written = rewriter().rewrite(tmp_path, tmp_path / name, moved)
    again = guess_reader(written).open(written).trajectory
    assert again is not None
    np.testing.assert_array_equal(again.stamps_s, trajectory.stamps_s)
    np.testing.assert_allclose(again.world_from_cam, moved.world_from_cam, atol=1e-12)
    kept = [line.split()[0].split(",")[0] if line.split() else "" for line in text.splitlines()]
    assert name == "kept.kitti" or [
        line.split()[0].split(",")[0] if line.split() else "" for line in written.read_text().splitlines()
    ][: len(kept) if name != "kept.log" else 1] == (kept if name != "kept.log" else kept[:1])
    assert name != "data.csv" or written.read_text().splitlines()[1].endswith(",.5")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("head", [codecs.BOM_UTF8 + "# von Jörg\r\n".encode(), b"# J\xf6rg \x85 1 0 0 1\r\n\r\n"])
def test_every_byte_beside_the_poses_stays(name: str, head: bytes, tmp_path: Path) -> None:
    rewriter, text = FILES[name]
    body = text.replace("\n", "\r\n").encode()
    (tmp_path / name).write_bytes(head + body)
    trajectory = guess_reader(tmp_path / name).open(tmp_path / name).trajectory
    assert trajectory is not None and len(trajectory) == 2
    written = rewriter().rewrite(tmp_path, tmp_path / name, trajectory)
    contents = written.read_bytes()
    assert contents.startswith(head) and contents.count(b"\r\n") == (head + body).count(b"\n") == contents.count(b"\n")
    again = guess_reader(written).open(written).trajectory
    assert again is not None
    np.testing.assert_array_equal(again.world_from_cam, trajectory.world_from_cam)


def test_seven_scenes_poses_become_a_folder(tmp_path: Path) -> None:
    (tmp_path / "seq").mkdir()
    for number in (0, 4):
        np.savetxt(tmp_path / "seq" / f"frame-{number:06d}.pose.txt", np.eye(4))
    moved = Trajectory(np.array([0.0, 4.0]), se3.exp(np.full((2, 6), 0.1)))
    out = SevenScenesRewriter().rewrite(tmp_path, tmp_path / "seq", moved)
    np.testing.assert_allclose(np.loadtxt(out / "frame-000004.pose.txt"), moved.world_from_cam[1], atol=1e-12)
    same = SevenScenesRewriter().copy(tmp_path, tmp_path / "seq") / "frame-000000.pose.txt"
    assert same.read_bytes() == (tmp_path / "seq" / "frame-000000.pose.txt").read_bytes()
    (tmp_path / "scene").mkdir()
    (tmp_path / "seq").rename(tmp_path / "scene" / "seq-01")
    of_scene = SevenScenesRewriter().rewrite(tmp_path, tmp_path / "scene", moved) / "seq-01" / "frame-000004.pose.txt"
    np.testing.assert_allclose(np.loadtxt(of_scene), moved.world_from_cam[1], atol=1e-12)


def test_transforms_json_keeps_all_but_its_poses(tmp_path: Path) -> None:
    frames = [{"file_path": f"{row}.png", "mine": row, "transform_matrix": np.eye(4).tolist()} for row in range(3)]
    original = {"ply_file_path": "a.ply", "applied_scale": 2.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(original))
    moved = Trajectory(np.array([0.0, 2.0]), se3.exp([[0.1, 0.2, 0.3, 1.0, 2.0, 3.0], [0.3, 0.2, 0.1, 4.0, 5.0, 6.0]]))
    out = NerfstudioRewriter().rewrite(tmp_path, tmp_path, moved)
    found = NerfstudioReader().open(out).trajectory
    assert out.name == "refined.json" and found is not None
    np.testing.assert_allclose(found.world_from_cam[::2], moved.world_from_cam, atol=1e-12)
    back = json.loads(out.read_text())
    assert back["frames"][1] == frames[1]
    for entry in (*back["frames"], *frames):
        del entry["transform_matrix"]
    assert back == original
    assert NerfstudioRewriter().copy(tmp_path, tmp_path).read_bytes() == (tmp_path / "transforms.json").read_bytes()


def test_every_rewriter_has_the_name_of_a_reader() -> None:
    assert set(registry.names("rewriters")) <= set(registry.names("readers"))


def test_the_loop_that_open3d_left_open_is_closed(data_dir: Path, tmp_path: Path) -> None:
    """True relative poses of living room 1: gt.log of its fragments, moved by the origin that Redwood chose.

    The trajectory's fragments begin 50 frames apart; of two frames of each, the poses are as far off as of all.
    """
    folder = data_dir / "icl_nuim" / "livingroom1_redwood"
    truth = data_dir / "fragments" / "pair_estimates" / "iclnuim-livingroom1-evaluation" / "gt.log"
    if not folder.is_dir() or not truth.is_file():
        pytest.skip(f"no livingroom1_redwood or its gt.log in {data_dir}")
    start = np.array(list(read_log_file(folder / "test_scene" / "trajectory.log").poses.values()))[::25]
    frames = IclNuimReader(camera=(525.0, 525.0, 319.5, 239.5), every=25).open(folder).frames
    better = hodge_pipeline.refine_trajectory(start, frames, overrides=OFF).poses
    true = read_log_file(truth)
    origin = se3.from_parts(np.eye(3), np.array([2.0, 2.0, -0.3]))
    for (i, j), motion in zip(true.pairs, true.i_from_j, strict=True):
        if max(i, j) <= 4:
            found = se3.inverse(better[2 * i]) @ better[2 * j]
            error = found @ se3.inverse(se3.inverse(origin) @ motion @ origin)
            assert np.rad2deg(np.linalg.norm(se3.so3_log(error[:3, :3]))) < 0.05
            assert np.linalg.norm((se3.inverse(found) @ se3.inverse(origin) @ motion @ origin)[:3, 3]) < 0.003


def test_a_graph_is_sent_to_solve(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text(
        "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\n"
        "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1\n"
    )
    depth = np.full((24, 32), 2.0, np.float32)
    made = hodge_pipeline.frames_from_images([depth, depth], np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]]))
    recipe = load_recipe("slam_refine", [f"start.path={tmp_path / 'graph.g2o'}"])
    with pytest.raises(SourceError, match="give it to hodge solve"):
        hodge_pipeline.run(recipe, tmp_path / "run", source=Source("memory", Path("memory"), made))

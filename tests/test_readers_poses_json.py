"""Trajectories and graphs in EuRoC, Redwood, Open3D and nerfstudio files: round trips and conventions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.nerfstudio import NerfstudioReader, NerfstudioWriter
from hodge_adapters.open3d_json import Open3dPoseGraphWriter, Open3dReader, Open3dTrajectoryWriter
from hodge_adapters.trajectories.euroc import EurocReader, EurocWriter
from hodge_adapters.trajectories.log import LogReader, LogWriter
from hodge_adapters.trajectories.readers import KittiPosesReader, TumPosesReader
from hodge_pipeline import registry, se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Frame, Source, Trajectory, ViewGraph

CAMERA = Camera(640, 480, 585.0, 586.0, 319.5, 240.0)


def made(count: int = 5, seed: int = 0) -> Source:
    rng = np.random.default_rng(seed)
    poses = se3.exp(rng.normal(0, 1.0, (count, 6)) * [1, 1, 1, 100, 100, 100])
    stamps = 1403715524.9 + np.cumsum(rng.uniform(0.01, 1, count))
    frames = tuple(Frame(f"rgb/{k}.png", float(k), CAMERA, world_from_cam=pose) for k, pose in enumerate(poses))
    edges = np.array([(k, k + 1) for k in range(count - 1)] + [(count - 1, 0)])
    noise = se3.exp(rng.normal(0, 0.1, (count, 6)))
    motions = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ noise
    root = rng.normal(0, 1, (count, 6, 6))
    graph = ViewGraph.from_edges(np.arange(count), edges, motions, root @ root.transpose(0, 2, 1) + np.eye(6), "open3d")
    return Source("made", Path("made"), frames, Trajectory(stamps, poses), graph)


@pytest.mark.parametrize(
    ("writer", "reader", "name"),
    [
        (EurocWriter(), EurocReader(), "data.csv"),
        (LogWriter(), LogReader(), "trajectory.log"),
        (Open3dTrajectoryWriter(), Open3dReader(), "camera.json"),
        (NerfstudioWriter(), NerfstudioReader(), "transforms.json"),
        (Open3dPoseGraphWriter(), Open3dReader(), "graph.json"),
    ],
)
@given(seed=st.integers(0, 100))
@settings(max_examples=5, deadline=None)
def test_round_trips(tmp_path_factory: pytest.TempPathFactory, writer, reader, name: str, seed: int) -> None:
    path, source = tmp_path_factory.mktemp("trip") / name, made(seed=seed)
    writer.write(path, source)
    assert type(guess_reader(path)) is type(reader)
    back = check_reader(reader, path)
    np.testing.assert_allclose(back.trajectory.world_from_cam, source.trajectory.world_from_cam, atol=1e-9)
    if name == "data.csv":
        np.testing.assert_allclose(back.trajectory.stamps_s, source.trajectory.stamps_s, rtol=0, atol=3e-7)
    for before, after in zip(source.frames, back.frames, strict=False):
        assert after.camera == CAMERA
        np.testing.assert_allclose(after.world_from_cam, before.world_from_cam, atol=1e-9)
    if back.graph is not None:
        np.testing.assert_array_equal(back.graph.edges, source.graph.edges)
        np.testing.assert_allclose(back.graph.i_from_j, source.graph.i_from_j, atol=1e-9)
        np.testing.assert_allclose(back.graph.information, source.graph.information, rtol=1e-6, atol=1e-6)


def test_a_log_of_pairs_round_trips(tmp_path: Path) -> None:
    source = replace(made(), trajectory=None)
    LogWriter().write(tmp_path / "pairs.log", source)
    back = check_reader(LogReader(), tmp_path / "pairs.log").graph
    np.testing.assert_allclose(back.i_from_j, source.graph.i_from_j, atol=1e-9)
    np.testing.assert_array_equal(back.vertex_ids[back.edges], source.graph.edges)


def test_open3d_reads_what_is_written_and_means_the_same(tmp_path: Path) -> None:
    source = made()
    Open3dPoseGraphWriter().write(tmp_path / "graph.json", source)
    graph = o3d.io.read_pose_graph(str(tmp_path / "graph.json"))
    np.testing.assert_allclose([node.pose for node in graph.nodes], source.trajectory.world_from_cam, atol=1e-12)
    edge = graph.edges[1]
    assert (edge.target_node_id, edge.source_node_id) == (1, 2)
    np.testing.assert_allclose(edge.transformation, source.graph.i_from_j[1], atol=1e-12)
    # A small motion on our right costs what the same motion, moved to their left, costs there.
    xi = np.array([1e-3, 2e-3, -1e-3, 3e-3, 1e-3, 2e-3])
    left = se3.adjoint(source.graph.i_from_j[1]) @ xi
    assert left @ edge.information @ left == pytest.approx(xi @ source.graph.information[1] @ xi, rel=1e-9)
    Open3dTrajectoryWriter().write(tmp_path / "camera.json", source)
    cameras = o3d.io.read_pinhole_camera_trajectory(str(tmp_path / "camera.json")).parameters
    np.testing.assert_allclose(cameras[2].extrinsic @ source.trajectory.world_from_cam[2], np.eye(4), atol=1e-9)
    np.testing.assert_array_equal(cameras[2].intrinsic.intrinsic_matrix, CAMERA.matrix)


def test_a_nerfstudio_camera_looks_along_minus_z(tmp_path: Path) -> None:
    matrix = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    content = {
        "w": 8,
        "h": 6,
        "fl_x": 9.0,
        "cx": 4.0,
        "cy": 3.0,
        "frames": [{"file_path": "a", "transform_matrix": matrix}],
    }
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    source = check_reader(NerfstudioReader(), tmp_path)
    ahead = se3.transform(source.frames[0].world_from_cam, np.array([[0.0, 0, 1]]))
    np.testing.assert_allclose(ahead, [[5, 6, 6]])
    assert source.frames[0].camera == Camera(8, 6, 9.0, 9.0, 3.5, 2.5)
    below = se3.transform(source.frames[0].world_from_cam, np.array([[0.0, 1, 0]]))
    np.testing.assert_allclose(below, [[5, 5, 7]])


POSED = {"transform_matrix": np.eye(4).tolist()}
LENS = {"w": 8, "h": 6, "fl_x": 9.0, "cx": 4.0, "cy": 3.0}
DISTORTED = "the cameras have lens distortion, which is not corrected: undistort the images first"


def nerfstudio_scene(folder: Path, entry: Mapping[str, object], **content: object) -> Path:
    """A transforms.json of one frame beside its image of 8x6 pixels."""
    (folder / "a.png").write_bytes(cv2.imencode(".png", np.zeros((6, 8, 3), np.uint8))[1].tobytes())
    frames = [{"file_path": "a", **POSED, **entry}]
    (folder / "transforms.json").write_text(json.dumps({**content, "frames": frames}))
    return folder


@pytest.mark.parametrize("size", [{}, {"w": 8, "h": 6}])
def test_a_nerfstudio_camera_by_its_angle(tmp_path: Path, size: dict[str, int]) -> None:
    """As Blender writes it: the width spans 90 degrees."""
    source = check_reader(NerfstudioReader(), nerfstudio_scene(tmp_path, {}, camera_angle_x=np.pi / 2, **size))
    camera = source.frames[0].camera
    assert camera == Camera(8, 6, pytest.approx(4.0), pytest.approx(4.0), 3.5, 2.5) and source.notes == ()
    (tmp_path / "a.png").unlink()
    found = NerfstudioReader().open(tmp_path)
    assert (found.frames[0].camera is not None) == bool(size)
    assert any("camera_angle_x tells no camera" in note for note in found.notes) != bool(size)


@pytest.mark.parametrize(
    ("entry", "content", "note"),
    [
        ({}, {"camera_model": "OPENCV_FISHEYE", "k1": 0.0}, DISTORTED),
        ({"camera_model": "SIMPLE_RADIAL_FISHEYE"}, {}, DISTORTED),
        ({}, {"k4": 0.1}, "k4 of a lens that is no fisheye is left out: COLMAP has no such lens"),
        ({"depth_file_path": "b.png"}, {}, "1 of 1 depth images are not read, since they are not there"),
        ({"depth_file_path": "a.png"}, {"fl_x": None}, "1 of 1 depth images are not read, since they are not there"),
    ],
)
def test_what_nerfstudio_files_lose_is_noted(tmp_path: Path, entry: dict, content: dict, note: str) -> None:
    camera = {key: value for key, value in {**LENS, **content}.items() if value is not None}
    notes = NerfstudioReader().open(nerfstudio_scene(tmp_path, entry, **camera)).notes
    assert any(told.startswith(note) for told in notes)


@pytest.mark.parametrize("model", ["OPENCV", "PINHOLE", "simple_pinhole", None])
def test_perspective_cameras_of_nerfstudio_have_no_note(tmp_path: Path, model: str | None) -> None:
    source = NerfstudioReader().open(
        nerfstudio_scene(tmp_path, {"depth_file_path": "a.png"}, **LENS, camera_model=model)
    )
    assert source.notes == () and source.frames[0].read_depth is not None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({**LENS, "camera_model": "EQUIRECTANGULAR"}, "camera_model is 'EQUIRECTANGULAR'"),
        ({**LENS, "depth_unit_scale_factor": "0.001"}, "depth_unit_scale_factor is '0.001'"),
        ({**LENS, "depth_unit_scale_factor": 0}, "depth_unit_scale_factor is 0"),
        ({"camera_angle_x": "wide"}, "w, h, camera_angle_x are no camera"),
        ({"camera_angle_x": 4.0}, "w, h, camera_angle_x are no camera"),
    ],
)
def test_a_nerfstudio_file_that_says_no_pinhole_is_refused(tmp_path: Path, content: dict, message: str) -> None:
    with pytest.raises(SourceError, match=f"transforms.json.*{message}"):
        NerfstudioReader().open(nerfstudio_scene(tmp_path, {}, **content))


@pytest.mark.parametrize(
    "head",
    [
        "# exported by our tool\n#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x []\n",
        "#timestamp [ns],p_x,p_y\n",
        "#timestamp,x,y,z,qw,qx,qy,qz,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz\n",
        "timestamp,x,y,z,q_w,q_x,q_y,q_z\n",
        "# a comment\n\n",
    ],
)
@pytest.mark.parametrize("rest", ["", ",0" * 9])
def test_euroc_is_known_below_any_head(tmp_path: Path, head: str, rest: str) -> None:
    (tmp_path / "a.csv").write_text(f"{head}1403636580838555648,1,2,3,0.6,0,0,0.8{rest}\n")
    reader = guess_reader(tmp_path / "a.csv")
    assert isinstance(reader, EurocReader)
    turned = se3.to_quat_xyzw(reader.open(tmp_path / "a.csv").trajectory.world_from_cam)
    np.testing.assert_allclose(turned, [[0, 0, 0.8, 0.6]], atol=1e-15)


def test_nanoseconds_with_x_first_are_no_euroc(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("#timestamp,x,y,z,qx,qy,qz,qw\n1403636580838555648,1,2,3,0,0,0.8,0.6\n")
    reader = guess_reader(tmp_path / "a.csv")
    assert isinstance(reader, TumPosesReader)
    turned = se3.to_quat_xyzw(reader.open(tmp_path / "a.csv").trajectory.world_from_cam)
    np.testing.assert_allclose(turned, [[0, 0, 0.8, 0.6]], atol=1e-15)


@pytest.mark.parametrize(
    ("reader", "name", "text", "message"),
    [
        (EurocReader(), "a.csv", "#timestamp, q_RS_w\n1,0,0,0,0,0,0,0\n", "no line of"),
        (EurocReader(), "a.csv", "1,1e308,0,0,1,0,0,0\n", "no line of"),
        (LogReader(), "a.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 2 0\n0 0 0 1\n", ":1: not"),
        (LogReader(), "a.log", "0 0 1\n1 0 0 0\n", "no blocks"),
        (Open3dReader(), "a.json", '{"class_name": "PoseGraph", "nodes": [{"pose": [1]}]}', "node 0: not 16"),
        (Open3dReader(), "a.json", '{"class_name": "PointCloud"}', "class_name is"),
        (Open3dReader(), "a.json", "[" * 100000, "JSON"),
        (NerfstudioReader(), "a.json", '{"frames": [{"transform_matrix": 1}]}', "frame 0"),
        (NerfstudioReader(), "a.json", '{"frames": [\n,]}', "a.json:2: not JSON"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, reader, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match=message) as error:
        reader.open(tmp_path / name)
    assert name in str(error.value)


def test_real_euroc_agrees_with_its_estimate(data_dir: Path) -> None:
    folder = data_dir / "trajectories/evo"
    truth = check_reader(EurocReader(), folder / "V102_groundtruth.csv").trajectory
    estimate = check_reader(TumPosesReader(), folder / "V102.txt").trajectory
    rows = np.searchsorted(truth.stamps_s, estimate.stamps_s[10:60:10])
    true, found = truth.world_from_cam[rows], estimate.world_from_cam[10:60:10]
    moved, seen = (se3.log(se3.inverse(poses[:-1]) @ poses[1:])[:, :3] for poses in (true, found))
    # The angle of a relative rotation is the same in any frame; the order of the quaternion is not.
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(seen, axis=1), atol=0.05)


def test_real_open3d_graph(data_dir: Path) -> None:
    folder = data_dir / "icl_nuim/livingroom1_redwood"
    source = check_reader(Open3dReader(), folder / "test_fragments/fragment_optimized_000.json")
    graph, poses = source.graph, source.trajectory.world_from_cam
    i, j = graph.edges.T
    right = np.linalg.norm(se3.log(se3.inverse(graph.i_from_j) @ se3.inverse(poses[i]) @ poses[j]), axis=1)
    wrong = np.linalg.norm(se3.log(graph.i_from_j @ se3.inverse(poses[i]) @ poses[j]), axis=1)
    assert np.median(right) < 0.005 and np.median(wrong) > 10 * np.median(right), "the inverse convention must not fit"
    assert np.diagonal(graph.information, axis1=1, axis2=2).min() > 0


def test_real_logs_and_kitti(data_dir: Path) -> None:
    folder = data_dir / "icl_nuim/livingroom1_redwood"
    assert len(check_reader(LogReader(), folder / "test_scene/trajectory.log").trajectory) == 211
    gt = data_dir / "fragments/pair_estimates/7-scenes-redkitchen-evaluation/gt.log"
    assert check_reader(LogReader(), gt).graph.edge_count == 506
    kitti = KittiPosesReader(times="KITTI_00_gt_times.txt")
    assert len(check_reader(kitti, data_dir / "trajectories/evo/KITTI_00_gt.txt").trajectory) == 4541


def test_a_source_without_poses_is_refused(tmp_path: Path) -> None:
    empty = Source("empty", tmp_path, (Frame(0, 0.0, CAMERA),))
    for name in ("tum", "kitti", "euroc", "log", "open3d_trajectory", "nerfstudio", "open3d_pose_graph"):
        with pytest.raises(SourceError, match="no "):
            registry.load("writers", name)().write(tmp_path / "x", empty)

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hodge_adapters.icl_nuim.pov import read_pose, read_ray_lengths
from hodge_adapters.icl_nuim.reader import IclNuimReader
from hodge_adapters.images.camera_files import resized
from hodge_adapters.trajectories.log import read_log_file
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Floats
from readers_data import (
    agreement,
    depth_values,
    points_in_cam,
    some_poses,
    tum_line,
    write_colour,
    write_depth,
)

SMALL = (10.0, -10.0, 3.5, 2.5)
# The camera of one published file: right, up and direction are orthogonal, |right| is 4/3.
POSITION, AHEAD, UP = [0.91, 4.65, -2.92], [0.0496855, -0.285692, 0.957033], [0.00725319, 0.958294, 0.285692]
RIGHT = np.array([1.32832, 0.00964677, -0.0660817])


def pov_text(position: list[float] = POSITION, ahead: list[float] = AHEAD, up: list[float] = UP) -> str:
    vectors = {"cam_pos     ": position, "cam_dir     ": ahead, "cam_up      ": up, "cam_right   ": RIGHT.tolist()}
    lines = [f"{name} = [{', '.join(map(str, vector))}]';\n" for name, vector in vectors.items()]
    return "".join(lines) + "cam_angle    = 90;\n"


def floor_ray_lengths(world_from_cam: Floats, camera: Camera) -> Floats:
    """The lengths of the rays down to the plane y = 0 (H, W), huge where a ray goes up."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    down = (rays @ world_from_cam[:3, :3].T)[..., 1]
    with np.errstate(divide="ignore"):
        return np.where(down < -1e-9, -world_from_cam[1, 3] / down, 1e10)


def pov_folder(folder: Path, count: int = 2) -> Path:
    folder.mkdir()
    camera = Camera(640, 480, 481.2, -480.0, 319.5, 239.5)
    for number in range(count):
        stem = folder / f"scene_00_{number:04d}"
        stem.with_suffix(".txt").write_text(pov_text([0.1 * number, 1.5, 0.0]))
        lengths = floor_ray_lengths(read_pose(stem.with_suffix(".txt"), 1.0), camera)
        stem.with_suffix(".depth").write_text(" ".join(f"{value:.6g}" for value in lengths.ravel()))
        write_colour(stem.with_suffix(".png"), size=(480, 640))
    return folder


def redwood_folder(folder: Path, count: int = 3) -> Path:
    blocks = []
    for number, pose in enumerate(some_poses(count)):
        write_depth(folder / f"depth/{number:05d}.png", depth_values(number))
        write_colour(folder / f"color/{number:05d}.jpg")
        rows = "\n".join(" ".join(f"{value:.8f}" for value in row) for row in pose)
        blocks.append(f"{number} {number} {number + 1}\n{rows}\n")
    (folder / "trajectory.log").write_text("".join(blocks))
    return folder


def test_pov_files_by_contract_and_geometry(tmp_path: Path) -> None:
    source = check_reader(IclNuimReader(), pov_folder(tmp_path / "kt0"), max_decoded=1)
    assert [(f.frame_id, f.stamp_s) for f in source.frames] == [(0, 0.0), (1, 1.0)] and len(source.trajectory) == 2
    frame = source.frames[1]
    assert frame.camera == Camera(640, 480, 481.2, -480.0, 319.5, 239.5)
    points = points_in_cam(frame.read_depth(), frame.camera, step=16)
    assert len(points) > 500, "the floor is seen"
    assert abs(se3.transform(frame.world_from_cam, points)[:, 1]).max() < 2e-4, "and lies at height 0"


def test_the_axes_of_a_pov_camera(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(pov_text())
    pose = read_pose(tmp_path / "a.txt", 1.0)
    assert se3.is_motion(pose, 1e-9)
    np.testing.assert_allclose(pose[:3, 0], RIGHT / np.linalg.norm(RIGHT), atol=1e-5)
    np.testing.assert_allclose(pose[:3, 1], UP, atol=1e-5)
    np.testing.assert_allclose(pose[:3, 3], POSITION)
    np.testing.assert_allclose(read_pose(tmp_path / "a.txt", 100.0)[:3, 3], np.array(POSITION) / 100)


@pytest.mark.parametrize(
    "text", ["", "cam_pos = [1, 2, 3]';", pov_text(up=AHEAD), pov_text(ahead=[0, 0, 0]), pov_text([float("nan"), 0, 0])]
)
def test_pov_parameters_that_are_no_pose(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    assert read_pose(tmp_path / "a.txt", 1.0) is None


def test_pov_frames_without_pose_or_colour_are_noted(tmp_path: Path) -> None:
    folder = pov_folder(tmp_path / "kt0")
    (folder / "scene_00_0000.txt").write_text("")
    (folder / "scene_00_0001.png").unlink()
    (folder / "scene_00_0001.txt").write_text(pov_text([149.376, 451.41, -285.9]))
    source = IclNuimReader().open(folder)
    assert source.frames[0].world_from_cam is None and source.frames[1].read_colour is None
    assert "1 frame without usable camera parameters: 0" in source.notes
    assert any("centimetres" in note for note in source.notes)


def test_ray_lengths_become_z(tmp_path: Path) -> None:
    camera = Camera(3, 2, 2.0, -2.0, 1.0, 0.0)
    (tmp_path / "a.depth").write_text("1 2 inf\n-1 1e10 1.5\n")
    z = read_ray_lengths(tmp_path / "a.depth", camera=camera, units_per_metre=1.0)
    np.testing.assert_allclose(z, [[1 / np.sqrt(1.25), 2, 0], [0, 0, 1.5 / np.sqrt(1.5)]], rtol=1e-6)
    assert z.dtype == np.float32


@pytest.mark.parametrize(
    ("text", "reason"),
    [("1 2 3", "truncated"), ("1 2 x 4 5 6", "not a text"), ("1 " * 400, "the limit is"), ("", "0 ray")],
)
def test_damaged_ray_lengths_are_named(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "a.depth").write_text(text)
    with pytest.raises(SourceError, match=rf"a\.depth.*{reason}"):
        read_ray_lengths(tmp_path / "a.depth", camera=Camera(3, 2, 2.0, -2.0, 1.0, 0.0), units_per_metre=1.0)


def test_the_tum_like_layout(tmp_path: Path) -> None:
    for number in range(3):
        write_depth(tmp_path / f"depth/{number}.png", depth_values(number))
        write_colour(tmp_path / f"rgb/{number}.png")
    (tmp_path / "associations.txt").write_text("".join(f"{n} depth/{n}.png {n}.02 rgb/{n}.png\n" for n in range(3)))
    poses = some_poses(2)
    (tmp_path / "livingRoom0.gt.freiburg").write_text("".join(tum_line(1 + n, pose) for n, pose in enumerate(poses)))
    source = check_reader(IclNuimReader(camera=SMALL), tmp_path)
    assert [frame.frame_id for frame in source.frames] == [0, 1, 2] and len(source.trajectory) == 2
    assert [frame.colour_delay_s for frame in source.frames] == pytest.approx([0.02] * 3)
    assert source.frames[0].world_from_cam is None, "the truth starts at 1"
    assert "1 of 3 frames have no truth" in source.notes
    np.testing.assert_allclose(source.frames[2].world_from_cam, poses[1], atol=1e-6)
    np.testing.assert_allclose(source.frames[1].read_depth(), depth_values(1) / 5000, rtol=1e-6)
    published = IclNuimReader().open(tmp_path)
    assert published.frames[0].camera == resized(Camera(640, 480, 481.2, -480.0, 319.5, 239.5), (8, 6))


def test_the_redwood_layout(tmp_path: Path) -> None:
    folder = redwood_folder(tmp_path / "room")
    (folder / "color/00001.jpg").unlink()
    (folder / "depth/readme.png").write_bytes(b"")
    source = check_reader(IclNuimReader(camera=SMALL), folder)
    assert [frame.frame_id for frame in source.frames] == [0, 1, 2] and source.trajectory is None
    assert source.frames[1].read_colour is None
    np.testing.assert_allclose(source.frames[2].world_from_cam, some_poses(3)[2], atol=1e-7)
    np.testing.assert_allclose(source.frames[1].read_depth(), depth_values(1) / 1000, rtol=1e-6)
    assert "depth: 1 image without an own number left out: readme.png" in source.notes
    assert "1 frame has no colour image: 1" in source.notes
    assert any("an estimate of another program" in note for note in source.notes)
    assert [f.frame_id for f in IclNuimReader(every=2).open(folder).frames] == [0, 2]


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("", r"trajectory\.log: 0 lines"),
        ("0 0 1\n1 0 0 0\n", r"trajectory\.log: 2 lines"),
        ("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n", r"trajectory\.log:4: not"),
        ("0 0 1\n2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", r"trajectory\.log:1: .*rigid motion"),
    ],
)
def test_a_log_that_is_damaged_is_named(tmp_path: Path, text: str, where: str) -> None:
    (tmp_path / "trajectory.log").write_text(text)
    with pytest.raises(SourceError, match=where):
        read_log_file(tmp_path / "trajectory.log")


def test_what_is_none_of_the_layouts(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "bare/depth").mkdir(parents=True)
    (tmp_path / "bare/color").mkdir()
    (tmp_path / "text").write_text("")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("empty", "bare", "text", "loop", "absent"):
        with pytest.raises(SourceError, match=name):
            IclNuimReader().open(tmp_path / name)
    assert all(IclNuimReader().sniff(tmp_path / name).confidence == 0 for name in ("empty", "text", "loop", "absent"))


def test_the_real_redwood_rendering(data_dir: Path) -> None:
    folder, camera = data_dir / "icl_nuim/livingroom1_redwood", (525.0, 525.0, 319.5, 239.5)
    source = check_reader(IclNuimReader(camera=camera), folder)  # none that is assumed is tried on the images
    assert len(source.frames) == 211
    assumed = IclNuimReader().open(folder)
    assert source.frames[0].camera == assumed.frames[0].camera == Camera(640, 480, *camera) and not assumed.doubts
    first, later = source.frames[0], source.frames[10]
    right = se3.inverse(first.world_from_cam) @ later.world_from_cam
    wrong = first.world_from_cam @ se3.inverse(later.world_from_cam)
    assert agreement(first, later, right) > 0.85
    assert agreement(first, later, wrong) < 0.2


def test_the_authors_poses(data_dir: Path) -> None:
    path = data_dir / "icl_nuim/author_poses/livingRoom2.gt.freiburg.derived.txt"
    trajectory = check_reader(IclNuimReader(), path).trajectory
    assert trajectory.stamps_s[0] == 1 and len(trajectory) > 880
    np.testing.assert_allclose(trajectory.world_from_cam[0, :3, 3], [0, 0, -2.25], atol=1e-9)


@pytest.mark.parametrize(
    ("stated", "fy", "note"),
    [((11.0, 12.0), 12.0, "intrinsics from"), ((481.2, 480.0), -480.0, "states ICL-NUIM's camera with y down")],
)
def test_a_camera_file_beside_the_authors_images_or_pov_files_counts(tmp_path: Path, stated, fy, note) -> None:
    write_depth(tmp_path / "listed/depth/0.png", depth_values(0))
    (tmp_path / "listed/livingRoom1.gt.freiburg").write_text(tum_line(0, some_poses(1)[0]))
    write_colour(tmp_path / "listed/rgb/0.png")
    for folder in (tmp_path / "listed", pov_folder(tmp_path / "kt0")):
        file = folder / "camera-intrinsics.txt"
        file.write_text(f"{stated[0]} 0 4\n0 {stated[1]} 3\n0 0 1\n")
        source = IclNuimReader().open(folder)
        assert (source.frames[0].camera.fx, source.frames[0].camera.fy) == (stated[0], fy)
        assert file in source.files and any(note in told for told in source.notes)
        assert IclNuimReader(camera=(5, 6, 4, 3)).open(folder).frames[0].camera.fy == 6


def test_identities_amid_the_truth_are_none(tmp_path: Path) -> None:
    poses = some_poses(4)
    poses[2] = np.eye(4)
    for number in range(4):
        write_depth(tmp_path / f"listed/depth/{number}.png", depth_values(number))
        write_colour(tmp_path / f"listed/rgb/{number}.png")
        write_depth(tmp_path / f"replica/results/depth{number}.png", depth_values(number))
        write_colour(tmp_path / f"replica/results/frame{number}.png")
    (tmp_path / "listed/livingRoom1.gt.freiburg").write_text("".join(tum_line(n, poses[n]) for n in range(4)))
    np.savetxt(tmp_path / "replica/traj.txt", poses.reshape(4, 16))
    for name in ("listed", "replica"):
        source = IclNuimReader(camera=SMALL).open(tmp_path / name)
        pose = source.frames[2].world_from_cam
        assert pose is None or (name == "listed" and not np.allclose(pose, np.eye(4))), "a list is interpolated"
        assert any("1 frame with the identity amid other poses" in note for note in source.notes), name


def test_the_authors_images_without_their_list(tmp_path: Path) -> None:
    poses = some_poses(4)
    for number in range(3):
        write_depth(tmp_path / f"depth/{number}.png", depth_values(number))
        write_colour(tmp_path / f"rgb/{number}.png")
    (tmp_path / "livingRoom1.gt.freiburg").write_text("".join(tum_line(n, poses[n]) for n in (1, 2, 3)))
    assert IclNuimReader().sniff(tmp_path).confidence > 0.8
    assert IclNuimReader().open(tmp_path).frames[0].camera.fy == -480 / 80
    source = IclNuimReader(camera=SMALL).open(tmp_path)
    assert source.frames[0].read_depth is not None
    np.testing.assert_allclose(source.frames[0].read_depth(), depth_values(0) / 5000, rtol=1e-6)
    assert [frame.world_from_cam is not None for frame in source.frames] == [False, True, True]
    assert "no associations.txt: images are paired by the numbers in their names" in source.notes


def numbered_folder(folder: Path, depth: str, colour: str, count: int = 3) -> Path:
    for number in range(count):
        write_depth(folder / "depth" / depth.format(number), depth_values(number))
        write_colour(folder / "color" / colour.format(number))
    return folder


def test_the_number_of_a_frame_is_the_one_that_tells_images_apart(tmp_path: Path) -> None:
    folder = numbered_folder(tmp_path, "d435_{0:04d}_9{0}.png", "cam2_{0:04d}.png")
    source = IclNuimReader(camera=SMALL).open(folder)
    assert [frame.frame_id for frame in source.frames] == [0, 1, 2] and not source.doubts
    assert all(frame.read_colour is not None for frame in source.frames)


def test_grey_images_are_images(tmp_path: Path) -> None:
    for number in range(2):
        write_depth(tmp_path / f"depth/{number}.png", depth_values(number))
        (tmp_path / "mono").mkdir(exist_ok=True)
        Image.fromarray(np.full((6, 8), 40 + number, np.uint8)).save(tmp_path / f"mono/{number}.png")
    assert IclNuimReader().sniff(tmp_path).confidence > 0.5
    (first, second) = IclNuimReader(camera=SMALL).open(tmp_path).frames
    assert first.read_colour is not None and second.read_colour is not None
    assert np.unique(first.read_colour()) == 40 and np.unique(second.read_colour()) == 41


def test_images_named_without_numbers_or_by_stamps_are_told_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"depth: 3 of 3 images have no number of their own \(a\.png.*put depth"):
        letters = numbered_folder(tmp_path / "letters", "{}.png", "{}.png")
        for number, name in enumerate("abc"):
            (letters / f"depth/{number}.png").rename(letters / f"depth/{name}.png")
        IclNuimReader(camera=SMALL).open(letters)
    for name in ("130503110{}.16.png", "130503110{}160407000.png"):
        stamped = numbered_folder(tmp_path / name, name, name)
        with pytest.raises(SourceError, match="named by their stamps: .*hodge run tum"):
            IclNuimReader(camera=SMALL).open(stamped)
        assert TumReader().sniff(stamped).confidence > IclNuimReader().sniff(stamped).confidence
        source = TumReader().open(stamped)
        assert [frame.stamp_s for frame in source.frames] == pytest.approx([1305031100.16 + row for row in range(3)])
        assert all(frame.read_colour is not None for frame in source.frames), "color/ in the place of rgb/"


def test_colour_numbered_otherwise_than_depth_is_a_doubt(tmp_path: Path) -> None:
    source = IclNuimReader(camera=SMALL).open(numbered_folder(tmp_path, "{}.png", "100{}.png"))
    assert [(note.kind, note.count, note.detail) for note in source.doubts] == [("colour unpaired", 3, "3")]


def test_the_camera_and_the_depth_scale_of_open3d_s_recordings(tmp_path: Path) -> None:
    folder = numbered_folder(tmp_path, "{}.png", "{}.png")
    matrix = [10, 0, 0, 0, 10, 0, 3.5, 2.5, 1]
    told = {"width": 8, "height": 6, "intrinsic_matrix": matrix, "depth_scale": 4000.0}
    (folder / "intrinsic.json").write_text(json.dumps(told))
    source = IclNuimReader().open(folder)
    assert source.frames[0].camera == Camera(8, 6, 10.0, 10.0, 3.5, 2.5) and source.frames[1].read_depth is not None
    np.testing.assert_allclose(source.frames[1].read_depth(), depth_values(1) / 4000, rtol=1e-6)


def write_pairs(folder: Path, depth: str, colour: str, count: int = 3, ratio: int = 1) -> None:
    """Images by these names; colour is `ratio` times as large as depth."""
    for number in range(count):
        write_depth(folder / depth.format(number), depth_values(number))
        write_colour(folder / colour.format(number), size=(6 * ratio, 8 * ratio))


def test_replica_has_both_kinds_in_one_folder_one_camera_above_and_true_poses(tmp_path: Path) -> None:
    room, truth = tmp_path / "room0", some_poses(4)
    write_pairs(room, "results/depth{:06d}.png", "results/frame{:06d}.jpg")
    camera = {"w": 16, "h": 12, "fx": 20, "fy": 20, "cx": 7.5, "cy": 5.5, "scale": 6553.5}
    (tmp_path / "cam_params.json").write_text(json.dumps({"camera": camera}))
    (room / "traj.txt").write_text("\n".join(" ".join(map(str, pose.ravel())) for pose in truth))
    source = check_reader(IclNuimReader(), room)
    assert [frame.frame_id for frame in source.frames] == [0, 1, 2] and source.trajectory is not None
    for row, frame in enumerate(source.frames):
        assert frame.camera == Camera(8, 6, 10, 10, 3.5, 2.5) and frame.read_colour is not None
        np.testing.assert_allclose(frame.read_depth(), depth_values(row) / 6553.5, rtol=1e-6)
        np.testing.assert_allclose(frame.true_world_from_cam, truth[row], atol=1e-9)
    assert IclNuimReader().sniff(room).confidence > 0.5
    (room / "traj.txt").write_text("1 0 0")
    with pytest.raises(SourceError, match=r"traj.txt: not sixteen numbers"):
        IclNuimReader().open(room)


def test_a_flat_folder_is_told_by_what_its_images_names_say(tmp_path: Path) -> None:
    write_pairs(tmp_path, "depth_{:04d}.png", "rgb_{:04d}.png")
    write_colour(tmp_path / "overview.png")
    (tmp_path / "intrinsics.txt").write_text("10 10 3.5 2.5 8 6")
    source = check_reader(IclNuimReader(), tmp_path)
    assert len(source.frames) == 3 and all(frame.read_colour for frame in source.frames)
    write_pairs(tmp_path / "photographs", "depth_{:04d}.png", "IMG_{:04d}.jpg")
    assert IclNuimReader().sniff(tmp_path / "photographs").confidence == 0
    for number in range(6):
        write_colour(tmp_path / f"photographs/image_{number}.jpg")
    assert IclNuimReader().sniff(tmp_path / "photographs").confidence == 0, "few of them are of depth"


def test_stray_scanner_is_read_once_its_video_is_taken_apart(tmp_path: Path) -> None:
    write_depth(tmp_path / "depth/000000.png", depth_values())
    (tmp_path / "rgb.mp4").write_bytes(b"")
    assert "ffmpeg -i rgb.mp4 -start_number 0 color/" in IclNuimReader().sniff(tmp_path).advice
    write_pairs(tmp_path, "depth/{:06d}.png", "color/{:06d}.jpg", ratio=5)
    (tmp_path / "camera_matrix.csv").write_text("50.0, 0.0, 19.5\n0.0, 50.0, 14.5\n0.0, 0.0, 1.0\n")
    pose = some_poses(1)[0]
    (tmp_path / "odometry.csv").write_text(
        "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
        + ", ".join(["7.5", "000001", *map(str, [*pose[:3, 3], *se3.to_quat_xyzw(pose)])])
    )
    source = check_reader(IclNuimReader(), tmp_path)
    assert source.frames[0].camera == Camera(8, 6, 10, 10, 3.5, 2.5), "the matrix is of colour, five times as large"
    assert source.frames[0].world_from_cam is None and source.trajectory is None
    np.testing.assert_allclose(source.frames[1].world_from_cam, pose, atol=1e-9)
    assert source.frames[1].true_world_from_cam is None


@pytest.mark.parametrize("name", ["scan.r3d", "scan"])
def test_record3d_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    (path / "rgbd").mkdir(parents=True)
    (path / "metadata").write_text("{}")
    assert "Record3D" in IclNuimReader().sniff(path).advice

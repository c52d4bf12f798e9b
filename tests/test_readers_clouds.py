from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.clouds import columns as point_columns
from hodge_adapters.clouds.kitti import read_bin
from hodge_adapters.clouds.pcd import expand_lzf, read_pcd
from hodge_adapters.clouds.ply import read_ply, write_ply
from hodge_adapters.clouds.reader import CloudFolderReader, PlyWriter
from hodge_adapters.trajectories.log import read_log_file
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.measured_edges import GraphFile, MeasuredOptions, measured_edges
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import PointCloud, Source
from hodge_pipeline.types import ply as ply
from readers_data import some_poses


def cloud(count: int = 20, seed: int = 0) -> PointCloud:
    rng = np.random.default_rng(seed)
    normals = rng.normal(0, 1, (count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = rng.integers(0, 256, (count, 3)).astype(np.uint8)
    return PointCloud(rng.normal(0, 1, (count, 3)).astype(np.float32), normals.astype(np.float32), colours)


def as_open3d(points: PointCloud) -> o3d.geometry.PointCloud:
    made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.points_in_cam.astype(float)))
    made.normals = o3d.utility.Vector3dVector(points.normals_in_cam.astype(float))
    made.colors = o3d.utility.Vector3dVector(points.colours / 255.0)
    return made


def assert_same(found: PointCloud, expected: PointCloud) -> None:
    np.testing.assert_allclose(found.points_in_cam, expected.points_in_cam, atol=1e-5)
    np.testing.assert_allclose(found.normals_in_cam, expected.normals_in_cam, atol=1e-5)
    np.testing.assert_array_equal(found.colours, expected.colours)


@pytest.mark.parametrize(
    ("name", "ascii", "compressed"),
    [
        ("a.ply", True, False),
        ("a.ply", False, False),
        ("a.pcd", True, False),
        ("a.pcd", False, False),
        ("a.pcd", False, True),
    ],
)
def test_what_open3d_writes_is_read(tmp_path: Path, name: str, ascii: bool, compressed: bool) -> None:
    o3d.io.write_point_cloud(str(tmp_path / name), as_open3d(cloud()), write_ascii=ascii, compressed=compressed)
    assert_same(CloudFolderReader().open(tmp_path).frames[0].read_points(), cloud())


def test_big_endian_ply_after_another_element(tmp_path: Path) -> None:
    header = "ply\r\nformat binary_big_endian 1.0\r\nelement camera 2\r\nproperty short a\r\nelement vertex 1\r\n"
    header += "property double x\r\nproperty float y\r\nproperty float z\r\nend_header\r\n"
    (tmp_path / "a.ply").write_bytes(header.encode() + struct.pack(">hhdff", 7, 8, 1.5, 2.5, 3.5))
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").points_in_cam, [[1.5, 2.5, 3.5]])


def test_points_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    text = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(text + "1 2 3\nnan nan nan\n4 5 inf\n")
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd").points_in_cam, [[1, 2, 3]])


@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_written_ply_is_read_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, cloud(seed=seed))
    found = read_ply(path)
    np.testing.assert_array_equal(found.points_in_cam, cloud(seed=seed).points_in_cam)
    theirs = o3d.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(np.asarray(theirs.points), found.points_in_cam)


def test_lzf_by_hand() -> None:
    assert expand_lzf(b"\x00a\x20\x00", 4) == b"aaaa", "a match runs into what it writes"
    assert expand_lzf(b"\x02abc", 3) == b"abc"
    assert expand_lzf(b"\x20\x05", 3) is None, "a match before the beginning"
    assert expand_lzf(b"\x00a\xe0\xff\x00" * 3, 4) is None, "never past the size that is stated"
    assert expand_lzf(b"\x05ab", 6) is None


def fragments(folder: Path, count: int = 3) -> Path:
    folder.mkdir()
    for number in range(count):
        write_ply(folder / f"cloud_bin_{number * 5}.ply", cloud(seed=number))
    return folder


def log_block(i: int, j: int, pose: np.ndarray) -> str:
    return f"{i} {j} 3\n" + "\n".join(" ".join(map(repr, row)) for row in pose.tolist()) + "\n"


def test_a_folder_with_poses_and_pairs(tmp_path: Path) -> None:
    folder = fragments(tmp_path / "f")
    poses = some_poses(3)
    blocks = [log_block(5 * k, 5 * k, pose) for k, pose in enumerate(poses[:2])]
    (folder / "all.log").write_text("".join([*blocks, log_block(0, 5, poses[2]), log_block(0, 99, poses[2])]))
    source = check_reader(CloudFolderReader(), folder)
    assert [frame.frame_id for frame in source.frames] == ["cloud_bin_0.ply", "cloud_bin_5.ply", "cloud_bin_10.ply"]
    np.testing.assert_allclose(source.frames[1].world_from_cam, poses[1], atol=1e-12)
    assert source.frames[2].world_from_cam is None and len(source.trajectory) == 2
    assert source.graph.edges.tolist() == [[0, 1]]
    np.testing.assert_allclose(source.graph.i_from_j[0], poses[2], atol=1e-12)
    assert any("1 pair of the log" in note for note in source.notes)
    assert any("1 of 3 fragments have no pose: cloud_bin_10.ply" in note for note in source.notes)
    scaled = CloudFolderReader(units_per_metre=1000.0).open(folder).frames[0].read_points()
    np.testing.assert_allclose(scaled.points_in_cam * 1000, cloud(seed=0).points_in_cam, rtol=1e-5)


@pytest.mark.parametrize(
    ("logs", "posed", "note"),
    [
        ({"a.log": "2024-01-01 started\nsensor ready\n"}, 0, "a.log: left out: begins with no block"),
        ({"a.log": "2024-01-01 started\n", "b.log": "poses"}, 1, "a.log: left out: begins with no block"),
        (
            {"a.log": "# of a scanner\npose", "b.log": "pose"},
            0,
            "2 .log files, none taken: option log names one of a.log, b.log",
        ),
    ],
)
def test_logs_that_are_not_taken_are_told(tmp_path: Path, logs: dict[str, str], posed: int, note: str) -> None:
    folder = fragments(tmp_path / "f", 2)
    for name, text in logs.items():
        (folder / name).write_text(re.sub("poses?", log_block(0, 0, np.eye(4)), text))
    source = CloudFolderReader().open(folder)
    assert sum(frame.world_from_cam is not None for frame in source.frames) == posed
    assert any(told.startswith(note) for told in source.notes)


def test_one_cloud_of_all_fragments(tmp_path: Path) -> None:
    folder = fragments(tmp_path / "f", 2)
    with pytest.raises(SourceError, match="without poses"):
        PlyWriter().write(tmp_path / "all.ply", CloudFolderReader().open(folder))
    poses = some_poses(2)
    (folder / "poses.log").write_text(log_block(0, 0, poses[0]) + log_block(5, 5, poses[1]))
    PlyWriter().write(tmp_path / "all.ply", CloudFolderReader().open(folder))
    found = read_ply(tmp_path / "all.ply")
    expected = [se3.transform(pose, cloud(seed=k).points_in_cam) for k, pose in enumerate(poses)]
    np.testing.assert_allclose(found.points_in_cam, np.concatenate(expected), atol=1e-5)
    with pytest.raises(SourceError, match="no frame with points"):
        source = CloudFolderReader().open(folder)
        PlyWriter().write(tmp_path / "x.ply", replace(source, frames=()))


@pytest.mark.parametrize(
    ("name", "contents", "message"),
    [
        ("a.ply", b"", "no PLY header"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n1\n",
            "says 2 points, has 1",
        ),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "no x, y and z"),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nproperty float x\nend_header\n",
            "says 999999999999 points",
        ),
        ("a.ply", b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int v\nend_header\n", "no vertices"),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nproperty int y\nproperty int z\nend_header\n"
            b"1 2 3\n\n4 5 6\n",
            "says 1 points, has 2",
        ),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nend_header\n1\n", "vertices hold lists, nothing"),
        ("a.pcd", b"# .PCD\n", "no PCD header"),
        (
            "a.pcd",
            b"FIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 0\nPOINTS 1\nDATA ascii\n1 2 3\n",
            "fit together",
        ),
        ("a.csv", b"x,y,z,x\n1,2,3,4\n", "names x twice"),
        ("a.xyz", b"1 2 3\n\n4 5 x\n", "point 2, `4 5 x`, is no row of 3 numbers"),
        ("a.xyz", b"1 2 3 house\n", "point 1, `1 2 3 house`, is no row of 4 numbers"),
        ("a.xyz", b"2\n1 2 3\n", "says 2 points, has 1"),
        ("a.xyz", b"1,2,3;4\n", "no x, y and z"),
        ("a.pcd", b"FIELDS x y\nSIZE 4 4\nTYPE F F\nPOINTS 99999999999\nDATA binary\n", "cannot hold"),
        ("a.pcd", b"FIELDS x y\nSIZE 4\nTYPE F F\nPOINTS 1\nDATA binary\n", "does not fit together"),
        ("a.pcd", b"FIELDS x\nSIZE 4\nTYPE F\nPOINTS 2\nDATA binary_compressed\n\x01\0\0\0\x08\0\0\0\x00", "damaged"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, name: str, contents: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(contents)
    with pytest.raises(SourceError, match=message) as error:
        CloudFolderReader().open(tmp_path).frames[0].read_points()
    assert name in str(error.value)


def test_real_fragments_overlap_under_the_given_convention(data_dir: Path) -> None:
    folder = data_dir / "fragments/redkitchen_3dmatch"
    source = check_reader(CloudFolderReader(), folder)
    assert [len(frame.read_points()) for frame in source.frames[:2]] == [258342, 268977]
    log = read_log_file(data_dir / "fragments/pair_estimates/7-scenes-redkitchen-evaluation/gt.log")
    row = int(np.flatnonzero((log.pairs == (0, 1)).all(axis=1))[0])
    clouds = [frame.read_points().points_in_cam[::20].astype(float) for frame in source.frames[:2]]
    shares = []
    for motion in (log.i_from_j[row], se3.inverse(log.i_from_j[row])):
        keys = [
            {tuple(key) for key in np.floor(p / 0.1).astype(int)} for p in (clouds[0], se3.transform(motion, clouds[1]))
        ]
        shares.append(len(keys[0] & keys[1]) / len(keys[1]))
    assert shares[0] > 0.6 and shares[0] > 1.5 * shares[1], "matrix (i, j) moves j into i, not i into j"


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_files_are_read_in_parts_as_they_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    expected = cloud(50)
    path = tmp_path / f"a.{kind}"
    for ascii_text in (True, False):
        made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(expected.points_in_cam.astype(float)))
        made.colors = o3d.utility.Vector3dVector(expected.colours / 255.0)  # type: ignore[operator]
        o3d.io.write_point_cloud(str(path), made, write_ascii=ascii_text)
        read = {"ply": read_ply, "pcd": read_pcd}[kind]
        whole = read(path)
        monkeypatch.setattr(point_columns, "LINES_IN_PART", 7)
        monkeypatch.setattr(point_columns, "ROWS_IN_PART", 9)
        monkeypatch.setattr(ply, "ROWS_IN_PART", 9)
        parts = read(path)
        monkeypatch.undo()
        assert np.array_equal(whole.points_in_cam, parts.points_in_cam) and len(parts) == 50
        assert np.array_equal(whole.colours, parts.colours)  # type: ignore[arg-type]
        np.testing.assert_array_equal(parts.colours, expected.colours)


def lidar_scan(count: int = 48, seed: int = 0) -> np.ndarray:
    """Points (count, 3) round a scanner, in the order in which it turns."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    radius = 10 + np.random.default_rng(seed).uniform(0, 0.1, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, -1.7)]).astype("<f4")


def columns_of_kitti(kind: str) -> np.ndarray:
    points, rng = lidar_scan(), np.random.default_rng(1)
    match kind:
        case "three":
            return points
        case "three, no coordinate below 0":
            return points + np.float32(20)
        case "share":
            return np.column_stack([points, rng.uniform(0, 1, len(points)).astype("<f4")])
        case "whole":
            return np.column_stack([points, rng.integers(0, 256, len(points)).astype("<f4")])
        case "beams":
            return np.column_stack([points, rng.integers(0, 256, len(points)), np.arange(len(points)) % 32]).astype(
                "<f4"
            )
    return np.column_stack([points + np.float32(20), rng.uniform(0, 255, len(points)).astype("<f4")])


@pytest.mark.parametrize("kind", ["three", "three, no coordinate below 0", "share", "whole", "up to 255", "beams"])
def test_columns_of_kittis_scans_are_told_apart(tmp_path: Path, kind: str) -> None:
    """48 points of three columns have the bytes of 36 of four, and 48 of four those of 64 of three."""
    table = columns_of_kitti(kind)
    (tmp_path / "000000.bin").write_bytes(table.tobytes())
    found = read_bin(tmp_path / "000000.bin")
    np.testing.assert_array_equal(found.points_in_cam, table[:, :3])


def test_scans_whose_names_end_in_a_number(tmp_path: Path) -> None:
    names = ["planes_000010.bin", "scan__LIDAR_TOP__1532402927647951.pcd.bin"]
    for seed, name in enumerate([*names, "points3D.bin", "frames.bin"]):
        (tmp_path / name).write_bytes(lidar_scan(seed=seed).tobytes())
    assert [frame.frame_id for frame in CloudFolderReader().open(tmp_path).frames] == names


def test_a_folder_of_kitti_with_calibration_and_poses(tmp_path: Path) -> None:
    folder, poses, camera_from_scan = tmp_path / "07/velodyne", some_poses(3), some_poses(1, seed=5)[0]
    folder.mkdir(parents=True)
    for number in (0, 2, 7):
        (folder / f"{number:06d}.bin").write_bytes(lidar_scan(seed=number).tobytes())
    (folder / "velodyne.bin").write_bytes(b"no scan")

    def twelve(pose: np.ndarray) -> str:
        return " ".join(map(repr, pose[:3].ravel().tolist()))

    (tmp_path / "07/poses.txt").write_text("".join(twelve(pose) + "\n" for pose in poses))
    (tmp_path / "07/calib.txt").write_text(f"P0: {twelve(np.eye(4))}\nTr: {twelve(camera_from_scan)}\n")
    source = check_reader(CloudFolderReader(), folder)
    assert [frame.frame_id for frame in source.frames] == ["000000.bin", "000002.bin", "000007.bin"]
    np.testing.assert_allclose(source.frames[1].world_from_cam, poses[2] @ camera_from_scan, atol=1e-12)
    assert source.frames[2].world_from_cam is None and any("no pose: 000007.bin" in note for note in source.notes)
    assert all(frame.true_world_from_cam is None for frame in source.frames), "given, and no more"
    (tmp_path / "07/calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(SourceError, match="no line `Tr:`"):
        CloudFolderReader().open(folder)
    (folder / "000002.bin").write_bytes(b"\0" * 13)
    with pytest.raises(SourceError, match="13 bytes are no float32 rows"):
        read_bin(folder / "000002.bin")


HDL_64E = (*np.linspace(2.0, -8.33, 32), *np.linspace(-8.83, -24.33, 32))
FANS = {
    "an HDL-64E": (HDL_64E, 360),
    "half of it": (HDL_64E, 180),
    "an OS1-64": (np.linspace(-16.6, 16.6, 64), 360),
    "an HDL-32E": (np.linspace(-30.67, 10.67, 32), 360),
    "64 beams from -24 to 6": (np.linspace(-24.0, 6.0, 64), 360),
}


@pytest.mark.parametrize("fan", FANS)
def test_points_of_kittis_scanner_are_raised_by_the_error_of_its_angles(tmp_path: Path, fan: str) -> None:
    beams_deg, round_deg = FANS[fan]
    rng = np.random.default_rng(0)
    for number in range(3):
        up, turn = (v.ravel() for v in np.meshgrid(np.radians(beams_deg), np.radians(np.arange(0, round_deg, 0.5))))
        up = up + np.radians(rng.normal(0, 0.05, up.size))
        away = rng.uniform(6, 60, (up.size, 1))
        points = away * np.column_stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)])
        (tmp_path / f"{number:06d}.bin").write_bytes(points.astype("<f4").tobytes())
    source = CloudFolderReader().open(tmp_path)
    found = source.frames[2].read_points().points_in_cam.astype(float)
    by_deg = 0.205 if fan == "an HDL-64E" else 0.0
    risen_deg = np.degrees(np.arcsin(found[:, 2] / np.linalg.norm(found, axis=1)) - up)
    np.testing.assert_allclose(risen_deg, by_deg, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), away[:, 0], rtol=1e-5)
    np.testing.assert_allclose(np.cos(np.arctan2(found[:, 1], found[:, 0]) - turn), 1, atol=1e-9)
    assert any("raised by 0.205 degrees" in note for note in source.notes) == bool(by_deg)
    as_stored = CloudFolderReader(raise_deg=0).open(tmp_path)
    np.testing.assert_array_equal(as_stored.frames[2].read_points().points_in_cam, points.astype("<f4"))
    assert not any("raised" in note for note in as_stored.notes)


def test_scans_of_kitti_07(data_dir: Path) -> None:
    source = CloudFolderReader().open(data_dir / "scans/kitti_07_5scans")
    sizes = [len(frame.read_points()) for frame in source.frames if frame.read_points]
    assert [frame.frame_id for frame in source.frames] == [f"{row:06d}.bin" for row in range(5)]
    assert sizes == [21562, 24703, 24573, 16911, 19872]
    assert "the angles of 5 .bin scans are those of KITTI's HDL-64E" in source.notes[0]


def test_a_graph_of_numbers_joins_scans_with_names(tmp_path: Path) -> None:
    frames = CloudFolderReader().open(fragments(tmp_path / "f")).frames
    (tmp_path / "edges.log").write_text(log_block(0, 5, some_poses(1)[0]))
    options = MeasuredOptions(files=(GraphFile(tmp_path / "edges.log"),))
    found, _ = measured_edges(Source("f", tmp_path, frames), options)
    assert found.edges.tolist() == [[0, 1]]


@pytest.mark.parametrize(
    ("name", "head", "separator"),
    [
        ("a.xyz", "", " "),
        ("a.asc", "//X Y Z R G B\n", " "),
        ("a.csv", "x,y,z,red,green,blue\n", " , "),
        ("a.csv", '"x";"y";"z";"red";"green";"blue"\n\n', ";"),
    ],
)
def test_tables_of_points_are_read(tmp_path: Path, name: str, head: str, separator: str) -> None:
    made = cloud()
    rows = np.column_stack([made.points_in_cam.astype(str), made.colours.astype(str)])
    (tmp_path / name).write_text(head + "\n".join(separator.join(row) for row in rows) + "\n")
    found = check_reader(CloudFolderReader(), tmp_path).frames[0].read_points()
    np.testing.assert_allclose(found.points_in_cam, made.points_in_cam, atol=1e-6)
    assert found.colours is None if not head else (found.colours == made.colours).all()


FAR = np.array([[500_000.123, 5_400_000.456, 100.1], [500_000.223, 5_400_000.556, 100.2], [np.nan, 0, 0]])
"""Where a map's coordinates are: float32 would round them to half a metre."""


def far_file(name: str, text: bool) -> bytes:
    """`FAR` in a file of text, or of doubles."""
    rows = "\n".join(" ".join(map(repr, row)) for row in FAR.tolist()) + "\n"
    values = rows.encode() if text else FAR.astype(">f8" if name == "a.vtk" else "<f8").tobytes()
    kind = "ascii" if text else {"a.ply": "binary_little_endian", "a.vtk": "BINARY"}.get(name, "binary")
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    return {
        "a.ply": f"ply\nformat {kind} 1.0\nelement vertex 3\n{properties}end_header\n",
        "a.pcd": f"FIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nPOINTS 3\nDATA {kind}\n",
        "a.vtk": f"# vtk DataFile Version 3.0\nt\n{kind}\nDATASET POLYDATA\nPOINTS 3 double\n",
    }.get(name, "").encode() + values


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.vtk", "a.xyz"])
def test_map_coordinates_are_counted_from_whole_kilometres(tmp_path: Path, name: str, text: bool) -> None:
    if name == "a.xyz" and not text:
        pytest.skip("a table is text")
    (tmp_path / name).write_bytes(far_file(name, text))
    source = CloudFolderReader().open(tmp_path)
    found = source.frames[0].read_points()
    np.testing.assert_allclose(found.points_in_cam, FAR[:2] - [500_000, 5_400_000, 0], atol=1e-5)
    assert any(f"{name}: lies far" in note and "counted from 500000 5400000 0" in note for note in source.notes)
    told = PlyWriter().write(tmp_path / "out.ply", source)
    assert "1 point that is not finite left out" in told
    in_millimetres = CloudFolderReader(units_per_metre=1000.0).open(tmp_path)
    assert not any("counted from" in note for note in in_millimetres.notes), "5.4 km in metres"


def test_points_of_a_far_frame_are_written_from_whole_kilometres(tmp_path: Path) -> None:
    source = CloudFolderReader().open(fragments(tmp_path / "f", 1))
    pose = se3.from_parts(np.eye(3), FAR[0])
    frames = tuple(replace(frame, world_from_cam=pose) for frame in source.frames)
    told = PlyWriter().write(tmp_path / "out.ply", replace(source, frames=frames))
    assert "points lie far from zero: they are counted from 500000 5400000 0" in told
    expected = cloud(seed=0).points_in_cam + FAR[0] - [500_000, 5_400_000, 0]
    np.testing.assert_allclose(read_ply(tmp_path / "out.ply").points_in_cam, expected, atol=1e-4)


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff1.5 2.5 3.5\n4.5 5.5 6.5\n",
        "\ufeff# a scan\n# of a hall\n\n1.5 2.5 3.5\n// half of it\n4.5 5.5 6.5\n",
        "2\n1.5 2.5 3.5\n4.5 5.5 6.5\n",
        "# a scan\n//X Y Z\n2\n1.5 2.5 3.5\n4.5 5.5 6.5\n",
        "1,5;2,5;3,5\n4,5;5,5;6,5\n",
        "x;y;z\n1,5;2,5;3,5\n4,5;5,5;6,5\n",
    ],
)
def test_what_stands_above_rows_and_between_their_numbers(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.xyz").write_text(text)
    found = CloudFolderReader().open(tmp_path).frames[0].read_points()
    np.testing.assert_array_equal(found.points_in_cam, [[1.5, 2.5, 3.5], [4.5, 5.5, 6.5]])


COLOUR_HEADS = {
    "a.ply": "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    "property {0} red\nproperty {0} green\nproperty {0} blue\nend_header\n",
    "a.pcd": "FIELDS x y z red green blue\nSIZE 4 4 4 {1} {1} {1}\nTYPE F F F U U U\nWIDTH 2\nHEIGHT 1\nDATA ascii\n",
    "a.csv": "x,y,z,r,g,b\n",
}


@pytest.mark.parametrize("name", COLOUR_HEADS)
@pytest.mark.parametrize("bits", [8, 16])
def test_colours_in_text_have_the_bits_that_are_declared(tmp_path: Path, name: str, bits: int) -> None:
    head = COLOUR_HEADS[name].format({8: "uchar", 16: "ushort"}[bits], bits // 8)
    stored, colour = ("0 1 1", [0, 1, 1]) if bits == 8 else ("65535 30000 0", [255, 116, 0])
    if name == "a.csv" and bits == 8:
        colour = [0, 255, 255]  # nothing tells them from fractions
    (tmp_path / name).write_text(head + f"1 2 3 {stored}\n" * 2)
    found = CloudFolderReader().open(tmp_path).frames[0].read_points()
    assert found.colours.tolist() == [colour, colour]


def test_tables_of_something_else_are_no_scans_and_told(tmp_path: Path) -> None:
    (tmp_path / "gps.csv").write_text("stamp,x,y,z\n0,1,2,3\n")
    (tmp_path / "scan.pts").write_text("1 2 3\n")
    with pytest.raises(SourceError, match="1 file is a scan of another format, left out: scan.pts: convert to PLY"):
        CloudFolderReader().open(tmp_path)
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n")
    source = CloudFolderReader().open(tmp_path)
    assert [frame.frame_id for frame in source.frames] == ["a.csv"]
    assert "2 files are scans of another format, left out: gps.csv, scan.pts" in source.notes[0]
    (tmp_path / "a.csv").write_text("x,y,z\n1,2\n")
    with pytest.raises(SourceError, match=r"a\.csv: point 1, `1 2`, is no row of 3 numbers"):
        CloudFolderReader().open(tmp_path).frames[0].read_points()

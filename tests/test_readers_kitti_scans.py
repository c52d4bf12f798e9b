"""KITTI's scans: which columns they have, their folders, and the error of the scanner's angles."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clouds_data import lidar_scan
from hodge_adapters.clouds.kitti import read_bin
from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import ply as ply
from readers_data import some_poses


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
        case "times":
            return np.column_stack([points, rng.uniform(0, 255, len(points)), TIMES_S]).astype("<f4")
        case "beams and times":
            beams = np.arange(len(points)) % 32
            return np.column_stack([points, rng.uniform(0, 255, len(points)), beams, TIMES_S]).astype("<f4")
        case "something else":
            along = points[np.argsort(np.arctan2(points[:, 1], points[:, 0]))]
            return np.column_stack([along, rng.uniform(0, 255, (len(points), 2))]).astype("<f4")
    return np.column_stack([points + np.float32(20), rng.uniform(0, 255, len(points)).astype("<f4")])


TIMES_S = np.linspace(0, 0.1, 48)
KINDS = ["three", "three, no coordinate below 0", "share", "whole", "up to 255", "beams", "times", "beams and times"]


@pytest.mark.parametrize("kind", [*KINDS, "something else"])
def test_columns_of_kittis_scans_are_told_apart(tmp_path: Path, kind: str) -> None:
    """48 points of three columns have the bytes of 36 of four, and 48 of four those of 64 of three."""
    table = columns_of_kitti(kind)
    (tmp_path / "000000.bin").write_bytes(table.tobytes())
    found = read_bin(tmp_path / "000000.bin")
    np.testing.assert_array_equal(found.points_in_cam, table[:, :3])
    if "times" not in kind:
        assert found.times_s is None
    else:
        np.testing.assert_allclose(found.times_s, TIMES_S, atol=1e-6)


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


@pytest.mark.filterwarnings("error")
def test_numbers_that_are_none_are_left_out_in_silence(tmp_path: Path) -> None:
    rows = lidar_scan().astype("<f4")
    rows[5, 0], rows[7:9] = np.nan, np.inf
    (tmp_path / "000000.bin").write_bytes(rows.tobytes())
    assert len(read_bin(tmp_path / "000000.bin")) == len(rows) - 3

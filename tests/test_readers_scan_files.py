"""LAS and E57: points, colours, poses; what is wrong with a file is one line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.clouds import CloudFolderReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from readers_data import some_poses

ROOM = np.random.default_rng(0).uniform(0, 3, (50, 3))
FAR = np.array([431_000.0, 5_401_000.0, 120.0])
"""Where a map's coordinates are: float32 would round them to half a metre."""


def write_las(path: Path, points: np.ndarray, bits: int = 16) -> Path:
    laspy = pytest.importorskip("laspy", reason="laspy is not installed: pip install 'hodge-pipeline[scans]'")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), points.min(axis=0)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red = las.green = np.full(len(points), 200 * (257 if bits == 16 else 1))
    las.blue = np.zeros(len(points))
    las.write(str(path))
    return path


def write_e57(path: Path, poses: np.ndarray) -> Path:
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed: pip install 'hodge-pipeline[scans]'")
    file = pye57.E57(str(path), mode="w")
    for pose in poses:
        local = se3.transform(se3.inverse(pose), ROOM)
        columns = {f"cartesian{axis}": local[:, row].copy() for row, axis in enumerate("XYZ")}
        columns.update({f"color{name}": np.full(len(ROOM), 7, np.uint8) for name in ("Red", "Green", "Blue")})
        quat_wxyz = se3.to_quat_xyzw(pose)[[3, 0, 1, 2]]
        file.write_scan_raw(columns, rotation=quat_wxyz, translation=pose[:3, 3].copy())
    file.close()
    return path


def test_las_files_count_from_one_corner(tmp_path: Path) -> None:
    write_las(tmp_path / "tile_0.las", FAR + ROOM)
    write_las(tmp_path / "tile_1.las", FAR + ROOM + [10, 0, 0], bits=8)
    source = check_reader(CloudFolderReader(), tmp_path)
    first, second = (frame.read_points() for frame in source.frames)
    np.testing.assert_allclose(first.points_in_cam, ROOM - ROOM.min(axis=0), atol=2e-4)
    np.testing.assert_allclose(second.points_in_cam - first.points_in_cam, np.tile([10, 0, 0], (50, 1)), atol=2e-4)
    assert first.colours[0].tolist() == second.colours[0].tolist() == [200, 200, 0]
    assert source.notes[0].startswith("coordinates of 2 LAS files are counted from their common lower corner 431000.")


def test_each_scan_of_an_e57_is_a_posed_frame(tmp_path: Path) -> None:
    poses = some_poses(3)
    source = check_reader(CloudFolderReader(), write_e57(tmp_path / "hall.e57", poses))
    assert [frame.frame_id for frame in source.frames] == [0, 1, 2] and len(source.trajectory) == 3
    for frame, pose in zip(source.frames, poses, strict=True):
        np.testing.assert_allclose(frame.world_from_cam, pose, atol=1e-9)
        cloud = frame.read_points()
        np.testing.assert_allclose(se3.transform(frame.world_from_cam, cloud.points_in_cam), ROOM, atol=1e-5)
        assert cloud.colours[0].tolist() == [7, 7, 7]


@pytest.mark.parametrize("name", ["a.las", "a.e57"])
@pytest.mark.parametrize("cut", [0, 3, 100, 0.5, 0.99])
def test_files_that_are_cut_are_refused(tmp_path: Path, name: str, cut: float) -> None:
    path = tmp_path / name
    write_las(path, FAR + ROOM) if name.endswith("las") else write_e57(path, some_poses(2))
    contents = path.read_bytes()
    path.write_bytes(contents[: int(cut if cut >= 1 else cut * len(contents))])
    with pytest.raises(SourceError, match=name) as error:
        for frame in CloudFolderReader().open(path).frames:
            frame.read_points()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("name", "package"), [("a.las", "laspy"), ("a.laz", "laspy"), ("a.e57", "pye57")])
def test_the_package_that_is_needed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"LASF")
    with pytest.raises(SourceError, match=f"pip install {package}"):
        CloudFolderReader().open(tmp_path)

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader

VTK = b"# vtk DataFile Version 3.0\na title\n%s\nDATASET POLYDATA\n"
POINTS = np.array([[0, 0, 100.0], [10, 20, 30], [-5, 7, 900]])


def uos(folder: Path, head: str = "", pose: str = "12 -30 200\n10 -20 35\n") -> Path:
    """Two scans of 3DTK, one with a pose."""
    rows = "\n".join(" ".join(map(str, row)) for row in POINTS)
    (folder / "scan000.3d").write_text(f"{head}{rows}\n")
    (folder / "scan001.3d").write_text("\n".join(f"{line} 0.5" for line in rows.splitlines()))
    (folder / "scan000.pose").write_text(pose)
    return folder


def by_3dtk(points: np.ndarray, position: np.ndarray, angles_deg: np.ndarray) -> np.ndarray:
    """What EulerToMatrix4 of 3DTK makes of points (N, 3), in its own axes and centimetres."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(np.radians(angles_deg)), np.cos(np.radians(angles_deg))
    turn = np.array(
        [
            [cy * cz, -cy * sz, sy],
            [sx * sy * cz + cx * sz, -sx * sy * sz + cx * cz, -sx * cy],
            [-cx * sy * cz + sx * sz, cx * sy * sz + sx * cz, cx * cy],
        ]
    )
    return np.asarray(points @ turn.T + position)


def ahead_left_up(points: np.ndarray) -> np.ndarray:
    """Of centimetres right, up and ahead."""
    return np.column_stack([points[:, 2], -points[:, 0], points[:, 1]]) / 100


@pytest.mark.parametrize("head", ["", "3 x 1\n", "2\n", "# a comment\n"])
def test_scans_of_3dtk_lie_as_3dtk_lays_them(tmp_path: Path, head: str) -> None:
    source = check_reader(CloudFolderReader(), uos(tmp_path, head))
    first, second = (frame.read_points().points_in_cam for frame in source.frames)
    np.testing.assert_allclose(first, ahead_left_up(POINTS), atol=1e-6)
    np.testing.assert_array_equal(first, second)
    assert [frame.stamp_s for frame in source.frames] == [0.0, 1.0] and source.frames[1].world_from_cam is None
    world = se3.transform(source.frames[0].world_from_cam, first.astype(float))
    expected = by_3dtk(POINTS, np.array([12, -30, 200]), np.array([10, -20, 35]))
    np.testing.assert_allclose(world, ahead_left_up(expected), atol=1e-5)
    assert tmp_path / "scan000.pose" in source.files
    assert CloudFolderReader().sniff(tmp_path).confidence == 0.8, "poses are no files of another kind"
    millimetres = CloudFolderReader(units_per_metre=10.0).open(tmp_path).frames[0]
    np.testing.assert_allclose(millimetres.world_from_cam[:3, 3], source.frames[0].world_from_cam[:3, 3] / 10)


def vtk(kind: bytes, number: str = "float") -> bytes:
    """A file of PolyData: three points, several to a line of text, and normals that are left."""
    values = POINTS.ravel()
    points = b" ".join(b"%.9g" % value for value in values[:6]) + b"\n" + b" ".join(b"%.9g" % v for v in values[6:])
    if kind == b"BINARY":
        points = struct.pack(f">9{number[0]}", *values)
    after = b"\nVERTICES 1 4\n3 0 1 2\nPOINT_DATA 3\nNORMALS n float\n0 0 1 0 0 1 0 0 1\n"
    return VTK % kind + b"POINTS 3 %s\n" % number.encode() + points + after


@pytest.mark.parametrize("kind", [b"ASCII", b"BINARY"])
@pytest.mark.parametrize("number", ["float", "double"])
def test_points_of_vtk(tmp_path: Path, kind: bytes, number: str) -> None:
    (tmp_path / "a.vtk").write_bytes(vtk(kind, number))
    found = check_reader(CloudFolderReader(), tmp_path).frames[0].read_points()
    np.testing.assert_array_equal(found.points_in_cam, POINTS.astype(np.float32))


@pytest.mark.parametrize(
    ("name", "contents", "message"),
    [
        ("a.3d", b"", "no rows of x, y and z"),
        ("a.3d", b"3 x 1\n1 2\n", "no rows of x, y and z"),
        ("a.3d", b"1 2 3\n4 5\n", "point 2, `4 5`, is no row of 3 numbers"),
        ("a.3d", b"1 2 3\n4 5 hello\n", "point 2, `4 5 hello`, is no row of 3 numbers"),
        ("a.vtk", b"", "no legacy VTK file"),
        ("a.vtk", b"<VTKFile type='PolyData'>", "no legacy VTK file"),
        ("a.vtk", VTK % b"ASCII" + b"LINES 1 2\n", "no legacy VTK file"),
        ("a.vtk", VTK % b"BINARY" + b"POINTS 99999999999999 float\n" + bytes(36), "which its bytes cannot hold"),
        ("a.vtk", VTK % b"ASCII" + b"POINTS 99999999999999 float\n1 2 3\n", "which its bytes cannot hold"),
        ("a.vtk", vtk(b"BINARY")[:100], "which its bytes cannot hold"),
        ("a.vtk", vtk(b"ASCII").replace(b"POINTS 3", b"POINTS 4"), "says 4 points, has"),
        ("a.vtk", vtk(b"ASCII").replace(b" 20 ", b" x "), "says 3 points, has"),
    ],
)  # fmt: skip
def test_damaged_scans_are_named(tmp_path: Path, name: str, contents: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(contents)
    with pytest.raises(SourceError, match=message) as error:
        CloudFolderReader().open(tmp_path).frames[0].read_points()
    assert name in str(error.value)


@pytest.mark.parametrize(
    "pose", ["1 2 3\n", "1 2 3\n4 5 nan\n", "one two three\n", "0 0 0 1e300 0 0", "1e101 0 0 0 0 0"]
)
def test_a_damaged_pose_is_named(tmp_path: Path, pose: str) -> None:
    with pytest.raises(SourceError, match="scan000.pose: holds no six numbers"):
        CloudFolderReader().open(uos(tmp_path, pose=pose))

"""Files of one cloud, PLY, PCD and tables of text: read as they were written, damaged ones named."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clouds_data import cloud
from hodge_adapters.clouds import columns as point_columns
from hodge_adapters.clouds.columns import columns_called
from hodge_adapters.clouds.fragments import Fragment, read_fragment
from hodge_adapters.clouds.pcd import expand_lzf
from hodge_adapters.clouds.ply import write_ply
from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import PointCloud
from hodge_pipeline.types import ply as ply


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
    np.testing.assert_array_equal(read_fragment(Fragment(tmp_path / "a.ply")).points_in_cam, [[1.5, 2.5, 3.5]])


def test_points_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    text = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(text + "1 2 3\nnan nan nan\n4 5 inf\n")
    np.testing.assert_array_equal(read_fragment(Fragment(tmp_path / "a.pcd")).points_in_cam, [[1, 2, 3]])


@given(seed=st.integers(0, 1000))
@settings(max_examples=5, deadline=None)
def test_written_ply_is_read_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, cloud(seed=seed))
    found = read_fragment(Fragment(path))
    np.testing.assert_array_equal(found.points_in_cam, cloud(seed=seed).points_in_cam)
    theirs = o3d.io.read_point_cloud(str(path))
    np.testing.assert_array_equal(np.asarray(theirs.points), found.points_in_cam)


def test_lzf_by_hand() -> None:
    assert expand_lzf(b"\x00a\x20\x00", 4) == b"aaaa", "a match runs into what it writes"
    assert expand_lzf(b"\x02abc", 3) == b"abc"
    assert expand_lzf(b"\x20\x05", 3) is None, "a match before the beginning"
    assert expand_lzf(b"\x00a\xe0\xff\x00" * 3, 4) is None, "never past the size that is stated"
    assert expand_lzf(b"\x05ab", 6) is None


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


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_files_are_read_in_parts_as_they_are_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    expected = cloud(50)
    path = tmp_path / f"a.{kind}"
    for ascii_text in (True, False):
        made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(expected.points_in_cam.astype(float)))
        made.colors = o3d.utility.Vector3dVector(expected.colours / 255.0)  # type: ignore[operator]
        o3d.io.write_point_cloud(str(path), made, write_ascii=ascii_text)
        whole = read_fragment(Fragment(path))
        monkeypatch.setattr(point_columns, "LINES_IN_PART", 7)
        monkeypatch.setattr(point_columns, "ROWS_IN_PART", 9)
        monkeypatch.setattr(ply, "ROWS_IN_PART", 9)
        parts = read_fragment(Fragment(path))
        monkeypatch.undo()
        assert np.array_equal(whole.points_in_cam, parts.points_in_cam) and len(parts) == 50
        assert np.array_equal(whole.colours, parts.colours)  # type: ignore[arg-type]
        np.testing.assert_array_equal(parts.colours, expected.colours)


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


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff1.5 2.5 3.5\n4.5 5.5 6.5\n",
        "\ufeff# a scan\n# of a hall\n\n1.5 2.5 3.5\n// half of it\n4.5 5.5 6.5\n",
        "2\n1.5 2.5 3.5\n4.5 5.5 6.5\n",
        "# a scan\n//X Y Z\n2\n1.5 2.5 3.5\n4.5 5.5 6.5\n",
        "1,5;2,5;3,5\n4,5;5,5;6,5\n",
        "1,5\t2,5\t3,5\n4,5\t5,5\t6,5\n",
        "15,0e-1 2,5E+00 3,5\n4,5 5,5 6,5\n",
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


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
@pytest.mark.parametrize("colours", ["Red Green Blue", "R G B", "RED GREEN BLUE"])
def test_names_of_columns_may_be_in_capitals(tmp_path: Path, name: str, colours: str) -> None:
    head = COLOUR_HEADS[name].format("uchar", 1)
    for word, named in zip(["x", "y", "z", "red", "green", "blue"], f"X Y Z {colours}".split(), strict=True):
        head = head.replace(f" {word}", f" {named}")
    (tmp_path / name).write_text(head + "1 2 3 0 1 1\n" * 2)
    found = CloudFolderReader().open(tmp_path).frames[0].read_points()
    assert found.points_in_cam.tolist() == [[1, 2, 3]] * 2
    assert found.colours.tolist() == [[0, 1, 1]] * 2


def test_a_column_that_has_the_very_name_keeps_it() -> None:
    assert columns_called(["X", "x", "y", "z", "T", "b"]) == ["X", "x", "y", "z", "T", "blue"]

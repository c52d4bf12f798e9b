"""LAS and E57: points, colours, poses; what is wrong with a file is one line."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from readers_data import some_poses
from scan_data import FAR, ROOM, write_e57, write_las


def test_las_files_count_from_the_whole_metres_of_their_middle(tmp_path: Path) -> None:
    write_las(tmp_path / "tile_0.las", FAR + ROOM)
    write_las(tmp_path / "tile_1.las", FAR + ROOM + [10, 0, 0], bits=8)
    source = check_reader(CloudFolderReader(), tmp_path)
    first, second = (frame.read_points() for frame in source.frames)
    np.testing.assert_allclose(first.points_in_cam, FAR + ROOM - [431_006, 5_401_002, 121], atol=2e-4)
    np.testing.assert_allclose(second.points_in_cam - first.points_in_cam, np.tile([10, 0, 0], (50, 1)), atol=2e-4)
    assert first.colours[0].tolist() == second.colours[0].tolist() == [200, 200, 0]
    assert source.notes == ("coordinates of 2 LAS files are counted from their middle 431006 5401002 121",)


def test_an_empty_las_tile_does_not_move_the_corner_to_zero(tmp_path: Path) -> None:
    write_las(tmp_path / "tile_0.las", FAR + ROOM)
    write_las(tmp_path / "tile_1.las", np.zeros((0, 3)))
    first, _ = CloudFolderReader().open(tmp_path).frames
    np.testing.assert_allclose(first.read_points().points_in_cam, FAR + ROOM - [431_001, 5_401_002, 121], atol=2e-4)


def test_las_sweeps_keep_the_scanners_axes_and_the_times_of_their_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, points, times_s = tmp_path / "sweep_0.las", ROOM - [1, 1, 1], np.linspace(7.0, 7.1, len(ROOM))
    source = CloudFolderReader().open(write_las(path, points, times_s=times_s))
    cloud = source.frames[0].read_points()
    np.testing.assert_allclose(cloud.points_in_cam, points, atol=2e-4)
    np.testing.assert_allclose(cloud.times_s, times_s - 7.0, atol=1e-6)
    assert not source.notes
    minutes = CloudFolderReader().open(write_las(path, points, times_s=100 * times_s))  # no second in milliseconds
    assert minutes.frames[0].read_points().times_s is None
    monkeypatch.setattr("hodge_adapters.clouds.scan_files.ROWS_IN_PART", len(ROOM) - 1)
    survey = CloudFolderReader().open(write_las(path, points, times_s=times_s)).frames[0].read_points()
    assert len(survey) == len(ROOM) and survey.times_s is None


def test_each_scan_of_an_e57_is_a_posed_frame(tmp_path: Path) -> None:
    poses = some_poses(3)
    source = check_reader(CloudFolderReader(), write_e57(tmp_path / "hall.e57", poses))
    assert [frame.frame_id for frame in source.frames] == [f"hall.e57/{row}" for row in range(3)] and len(
        source.trajectory
    ) == 3
    for frame, pose in zip(source.frames, poses, strict=True):
        np.testing.assert_allclose(frame.world_from_cam, pose, atol=1e-9)
        cloud = frame.read_points()
        np.testing.assert_allclose(se3.transform(frame.world_from_cam, cloud.points_in_cam), ROOM, atol=1e-5)
        assert cloud.colours[0].tolist() == [7, 7, 7]


def test_far_tables_count_from_the_corner_of_the_las_files(tmp_path: Path) -> None:
    write_las(tmp_path / "tile_0.las", FAR + ROOM)
    np.savetxt(tmp_path / "tile_1.xyz", FAR + ROOM)
    first, second = (frame.read_points() for frame in CloudFolderReader().open(tmp_path).frames)
    np.testing.assert_allclose(first.points_in_cam, second.points_in_cam, atol=2e-4)


@pytest.mark.parametrize("turned", [True, False])
def test_far_scans_of_an_e57_count_from_whole_metres_unless_turned(tmp_path: Path, turned: bool) -> None:
    poses = some_poses(1) if turned else np.eye(4)[None]
    source = CloudFolderReader().open(write_e57(tmp_path / "hall.e57", poses, [FAR + ROOM]))
    off = np.zeros(3) if turned else np.round(np.median((FAR + ROOM).astype(np.float32).astype(float), axis=0))
    stored = (FAR + ROOM).astype(np.float32).astype(float)  # as pye57 writes them
    np.testing.assert_allclose(source.frames[0].read_points().points_in_cam, stored - off, atol=1e-4)
    assert any("counted from 43100" in note for note in source.notes) != turned


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


@pytest.mark.parametrize("name", ["a.las", "a.laz", "a.e57"])
def test_an_empty_file_is_told_to_be_copied_again(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    with pytest.raises(SourceError, match=rf"{name}: the file is empty: copy it again"):
        CloudFolderReader().open(tmp_path / name).frames[0].read_points()  # type: ignore[misc]


@pytest.mark.parametrize(("name", "package"), [("a.las", "laspy"), ("a.laz", "laspy"), ("a.e57", "pye57")])
def test_the_package_that_is_needed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"LASF")
    with pytest.raises(SourceError, match=f"pip install {package}"):
        CloudFolderReader().open(tmp_path)


@pytest.mark.parametrize(("at", "value"), [(96, 2**31), (100, 2**32 - 1)])
def test_a_las_header_that_counts_too_much_is_refused_at_once(tmp_path: Path, at: int, value: int) -> None:
    path = write_las(tmp_path / "a.las", ROOM)
    contents = bytearray(path.read_bytes())
    contents[at : at + 4] = value.to_bytes(4, "little")
    path.write_bytes(contents)
    with pytest.raises(SourceError, match=r"a.las: laspy cannot read it \(counts .* of \d+ on\): convert it to PLY"):
        CloudFolderReader().open(tmp_path)


@pytest.mark.parametrize("said", [np.zeros((2, 3)), np.array([[4.31e9, 5.401e10, 1.2e6], [4.32e9, 5.402e10, 1.3e6]])])
def test_las_points_outside_the_box_of_their_header_count_from_their_own_middle(
    tmp_path: Path, said: np.ndarray
) -> None:
    path = write_las(tmp_path / "a.las", FAR + ROOM)
    contents = bytearray(path.read_bytes())
    contents[179:227] = said[::-1].T.astype("<f8").tobytes()  # highest and lowest x, then y, z
    path.write_bytes(contents)
    cloud = CloudFolderReader().open(path).frames[0].read_points()
    np.testing.assert_allclose(cloud.points_in_cam, FAR + ROOM - [431_001, 5_401_002, 121], atol=2e-4)


@pytest.mark.parametrize(("at", "value"), [(131, 0.0), (139, np.inf), (155, np.nan), (171, 1e300)])
def test_las_coordinates_without_a_scale_are_refused(tmp_path: Path, at: int, value: float) -> None:
    path = write_las(tmp_path / "a.las", ROOM)
    contents = bytearray(path.read_bytes())
    contents[at : at + 8] = np.float64(value).tobytes()
    path.write_bytes(contents)
    with pytest.raises(SourceError, match=r"a\.las: laspy cannot read it \(scales .* and offsets .*\): convert it"):
        CloudFolderReader().open(path)


@pytest.mark.parametrize("left", [0, 49])
def test_a_las_file_cut_between_two_points_is_refused(tmp_path: Path, left: int) -> None:
    path = write_las(tmp_path / "a.las", ROOM)
    contents, row_bytes = path.read_bytes(), 34
    path.write_bytes(contents[: len(contents) - row_bytes * (50 - left)])
    with pytest.raises(SourceError, match=rf"a\.las: says 50 points, has {left}: copy it again"):
        CloudFolderReader().open(path).frames[0].read_points()


def test_what_the_rust_of_laspy_panics_at_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("lazrs", reason="lazrs is not installed: pip install 'hodge-pipeline[scans]'")
    path = write_las(tmp_path / "a.laz", ROOM)
    contents = bytearray(path.read_bytes())
    compressor = contents.index(b"laszip encoded") - 2 + 54
    contents[compressor], contents[compressor + 12 : compressor + 16] = 1, bytes(4)  # without chunks, as LASzip began
    path.write_bytes(contents)
    with pytest.raises(SourceError, match=r"a\.laz: laspy cannot read it \(.*\): convert it to PLY"):
        CloudFolderReader().open(path).frames[0].read_points()


def e57_of_fields(path: Path, fields: dict[str, tuple[float, float]]) -> Path:
    """A scan of one point: its fields, each a value and the largest that may be stored; `int` is stored as one."""
    pye57 = pytest.importorskip("pye57", reason="pye57 is not installed: pip install 'hodge-pipeline[scans]'")
    libe57, file = pye57.libe57, pye57.E57(str(path), mode="w")
    image, buffers = file.image_file, libe57.VectorSourceDestBuffer()
    prototype = libe57.StructureNode(image)
    columns = {name: np.array([value], float) for name, (value, _) in fields.items()}  # buffers do not keep them alive
    for name, (value, largest) in fields.items():
        is_whole = isinstance(value, int)
        prototype.set(name, libe57.IntegerNode(image, 0, 0, largest) if is_whole else libe57.FloatNode(image, 0.0))
        buffers.append(libe57.SourceDestBuffer(image, name, columns[name], 1, True, True))
    scan = libe57.StructureNode(image)
    scan.set("guid", libe57.StringNode(image, "{0}"))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan.set("points", points)
    file.data3d.append(scan)
    writer = points.writer(buffers)
    writer.write(1)
    writer.close()
    file.close()
    return path


def test_an_e57_with_stamps_and_colours_of_16_bits_is_read(tmp_path: Path) -> None:
    place = {f"cartesian{axis}": (float(at), 0.0) for at, axis in enumerate("XYZ")}
    colour = {f"color{name}": (200 * 257, 65535) for name in ("Red", "Green", "Blue")}
    path = e57_of_fields(tmp_path / "hall.e57", {**place, **colour, "timeStamp": (7.0, 0.0)})
    cloud = CloudFolderReader().open(path).frames[0].read_points()
    assert cloud.points_in_cam.tolist() == [[0, 1, 2]]
    assert cloud.colours.tolist() == [[200, 200, 200]]


def test_an_e57_of_angles_says_what_it_has(tmp_path: Path) -> None:
    path = e57_of_fields(tmp_path / "hall.e57", {"sphericalRange": (1.0, 0.0)})
    with pytest.raises(SourceError, match=r"scan 0 has sphericalRange, not cartesianX, .*\): convert it to PLY"):
        CloudFolderReader().open(path).frames[0].read_points()

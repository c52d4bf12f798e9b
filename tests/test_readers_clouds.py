"""Folders of clouds: which files are scans, with which poses and pairs, and far from zero."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clouds_data import cloud, fragments, log_block
from hodge_adapters.clouds.fragments import Fragment, read_fragment
from hodge_adapters.clouds.reader import CloudFolderReader, PlyWriter
from hodge_adapters.trajectories.log import read_log_file
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.measured_edges import GraphFile, MeasuredOptions, measured_edges
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Source
from hodge_pipeline.types import ply as ply
from readers_data import some_poses


def test_a_folder_with_poses_and_pairs(tmp_path: Path) -> None:
    folder = fragments(tmp_path / "f")
    poses = some_poses(3)
    blocks = [log_block(5 * k, 5 * k, pose) for k, pose in enumerate(poses[:2])]
    blocks += [log_block(0, 5, poses[2]), log_block(0, 99, poses[2]), log_block(7, 7, poses[2])]
    (folder / "all.log").write_text("".join(blocks))
    source = check_reader(CloudFolderReader(), folder)
    assert [frame.frame_id for frame in source.frames] == ["cloud_bin_0.ply", "cloud_bin_5.ply", "cloud_bin_10.ply"]
    np.testing.assert_allclose(source.frames[1].world_from_cam, poses[1], atol=1e-12)
    assert source.frames[2].world_from_cam is None and len(source.trajectory) == 2
    assert source.graph.edges.tolist() == [[0, 1]]
    np.testing.assert_allclose(source.graph.i_from_j[0], poses[2], atol=1e-12)
    assert any("1 pair of the log" in note for note in source.notes)
    assert any("1 of 3 fragments have no pose: cloud_bin_10.ply" in note for note in source.notes)
    assert any("all.log: 1 of 3 poses have no fragment of their number" in note for note in source.notes)
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
    found = read_fragment(Fragment(tmp_path / "all.ply"))
    expected = [se3.transform(pose, cloud(seed=k).points_in_cam) for k, pose in enumerate(poses)]
    np.testing.assert_allclose(found.points_in_cam, np.concatenate(expected), atol=1e-5)
    with pytest.raises(SourceError, match="no frame with points"):
        source = CloudFolderReader().open(folder)
        PlyWriter().write(tmp_path / "x.ply", replace(source, frames=()))


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


def test_a_graph_of_numbers_joins_scans_with_names(tmp_path: Path) -> None:
    frames = CloudFolderReader().open(fragments(tmp_path / "f")).frames
    (tmp_path / "edges.log").write_text(log_block(0, 5, some_poses(1)[0]))
    options = MeasuredOptions(files=(GraphFile(tmp_path / "edges.log"),))
    found, _ = measured_edges(Source("f", tmp_path, frames), options)
    assert found.edges.tolist() == [[0, 1]]


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
def test_map_coordinates_are_counted_from_the_whole_metres_of_their_middle(
    tmp_path: Path, name: str, text: bool
) -> None:
    if name == "a.xyz" and not text:
        pytest.skip("a table is text")
    (tmp_path / name).write_bytes(far_file(name, text))
    source = CloudFolderReader().open(tmp_path)
    found = source.frames[0].read_points()
    np.testing.assert_allclose(found.points_in_cam, FAR[:2] - [500_000, 5_400_001, 100], atol=1e-5)
    assert any(f"{name}: lies far" in note and "counted from 500000 5400001 100" in note for note in source.notes)
    told = PlyWriter().write(tmp_path / "out.ply", source)
    assert "1 point that is not finite left out" in told
    in_millimetres = CloudFolderReader(units_per_metre=1000.0).open(tmp_path)
    assert not any("counted from" in note for note in in_millimetres.notes), "5.4 km in metres"


def test_map_coordinates_that_were_written_in_32_bits_are_told_with_their_step(tmp_path: Path) -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    for name, kind, code in (("a", "float", "<f4"), ("b", "double", "<f8")):
        points = FAR[:2].astype(np.float32).astype(code)
        properties = "".join(f"property {kind} {axis}\n" for axis in "xyz")
        (tmp_path / f"{name}.ply").write_bytes(f"{header}{properties}end_header\n".encode() + points.tobytes())
        notes = CloudFolderReader().open(tmp_path / f"{name}.ply").notes
        assert any("rounded to steps of 0.5 m" in note and "64 bits" in note for note in notes)
        (tmp_path / f"{name}.ply").unlink()
    (tmp_path / "a.ply").write_bytes(far_file("a.ply", False))
    assert not any("rounded" in note for note in CloudFolderReader().open(tmp_path).notes)


def test_tables_of_points_with_another_ending_are_named(tmp_path: Path) -> None:
    (tmp_path / "scan.txt").write_text("1 2 3\n")
    with pytest.raises(SourceError, match=r"tables of points are read as \.xyz, .*: scan\.txt"):
        CloudFolderReader().open(tmp_path)


def test_points_of_a_far_frame_are_written_from_whole_kilometres(tmp_path: Path) -> None:
    source = CloudFolderReader().open(fragments(tmp_path / "f", 1))
    pose = se3.from_parts(np.eye(3), FAR[0])
    frames = tuple(replace(frame, world_from_cam=pose) for frame in source.frames)
    told = PlyWriter().write(tmp_path / "out.ply", replace(source, frames=frames))
    assert "points lie far from zero: they are counted from 500000 5400000 0" in told
    expected = cloud(seed=0).points_in_cam + FAR[0] - [500_000, 5_400_000, 0]
    np.testing.assert_allclose(read_fragment(Fragment(tmp_path / "out.ply")).points_in_cam, expected, atol=1e-4)


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

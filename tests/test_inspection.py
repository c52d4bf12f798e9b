"""What `hodge inspect` says of frames, trajectories and graphs, and which oddities it finds."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hodge_adapters.clouds.ply import write_ply
from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_adapters.colmap.reader import ColmapReader
from hodge_pipeline import se3
from hodge_pipeline.cli.list import next_command
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.frame_facts import frame_facts
from hodge_pipeline.sources.graph_facts import graph_facts
from hodge_pipeline.sources.inspect import inspect
from hodge_pipeline.store.artifacts import json_text
from hodge_pipeline.types import Camera, Frame, PointCloud, ViewGraph

CAMERA = Camera(4, 3, 10, 10, 2, 1.5)


def constant_depth(metres: float) -> np.ndarray:
    return np.full((3, 4), metres, np.float32)


def unreadable(error: type[Exception] = SourceError) -> np.ndarray:
    raise error("frame.png: is no PNG")


def walk(count: int) -> list[Frame]:
    """Frames a tenth of a second and a centimetre apart, two metres before a wall."""
    poses = se3.exp(np.outer(np.arange(count) / 100, [0, 0, 0, 1, 0, 0]))
    read = partial(constant_depth, 2.0)
    return [Frame(row, row / 10, CAMERA, read, world_from_cam=pose) for row, pose in enumerate(poses)]


def oddities_of(frames: list[Frame]) -> list[str]:
    found: list[str] = []
    frame_facts(frames, found)
    return found


def test_a_run_folder_is_no_source(tmp_path: Path) -> None:
    (tmp_path / "stages").mkdir()
    for name in ("recipe.yaml", "mesh.ply", "poses.tum"):
        (tmp_path / name).write_text("")
    with pytest.raises(SourceError, match="the folder of a run, no source: give a file of it, such as poses.tum"):
        inspect(tmp_path)


CLOUDS = {"frames": 3, "frames with depth": 0, "frames with points": 3}


def test_images_alone_are_sent_to_no_run_which_would_refuse_them() -> None:
    images = {**CLOUDS, "frames with points": 0, "formats": [{"reader": "nerfstudio"}]}
    assert next_command(Path("in"), {**images, "frames with a pose": 3}, None) == "hodge convert in poses.tum"
    assert next_command(Path("in"), {**images, "frames with a pose": 0}, None) == ""


def test_a_reader_without_a_recipe_of_its_name_gets_one_to_type() -> None:
    assert next_command(Path("my data"), {"frames": 0}, None).split(" --")[0] == "hodge refine trajectory 'my data'"
    command = next_command(Path("in"), {**CLOUDS, "formats": []}, "mine")
    assert command == "hodge run clouds --source in --set source.reader=mine --out runs/in"
    facts = {"frames": 3, "frames with depth": 3, "formats": []}
    command = next_command(Path("in"), facts, "tum", ["depth_scale=1000"])
    assert command == "hodge run tum --source in --set source.reader.depth_scale=1000 --out runs/in"


def test_a_recording_of_point_clouds_gets_the_recipe_of_clouds() -> None:
    facts = {**CLOUDS, "formats": [{"reader": "mcap"}]}
    assert next_command(Path("a.mcap"), facts, None) == "hodge run mcap_clouds --source a.mcap --out runs/a"
    images = {**facts, "frames with depth": 3, "frames with points": 0}
    assert next_command(Path("a.mcap"), images, None) == "hodge run mcap --source a.mcap --out runs/a"
    assert next_command(Path("a.mcap"), {**facts, "scanner": "spins"}, None).startswith("hodge run lidar ")


def test_posed_scans_of_an_e57_and_of_3dtk_start_from_their_poses(tmp_path: Path) -> None:
    facts = {**CLOUDS, "frames with a pose": 3, "formats": [{"reader": "clouds"}]}
    model = {"frames": 7, "frames with depth": 0, "formats": [{"reader": "colmap"}]}
    assert next_command(Path("sparse/0"), model, None) == "hodge refine colmap sparse/0 --out runs/0"
    command = next_command(Path("hall.e57"), facts, None)
    assert command == "hodge run scans --source hall.e57 --set start=given --out runs/hall"
    assert "start" not in next_command(Path("hall.e57"), {**facts, "frames with a pose": 0}, None)
    assert "start" not in next_command(tmp_path, facts, None)
    (tmp_path / "scan000.pose").touch()
    assert " --set start=given " in next_command(tmp_path, facts, None)


def test_a_sound_sequence_has_no_oddities() -> None:
    found: list[str] = []
    facts = frame_facts(walk(10), found)
    assert found == []
    assert facts["path length in metres"] == pytest.approx(0.09)
    assert facts["median step"] == pytest.approx(0.1) and facts["frames with depth"] == 10
    assert facts["depth range in metres"] == [2.0, 2.0] and facts["share without depth"] == 0.0
    assert facts["cameras"] == ["4x3 fx 10 fy 10 cx 2 cy 1.5 (10 frames)"]


@pytest.mark.parametrize(
    ("row", "change", "expected"),
    [
        (4, {"stamp_s": 0.3}, "1 stamp is that of the one before: after 3"),
        (4, {"stamp_s": 0.25}, "1 stamp is earlier than the stamp before"),
        (9, {"stamp_s": 7.0}, "1 gap in time of more than 5 steps; the longest, 6.2 s, between 8 and 9"),
        (5, {"frame_id": 4}, "1 frame ids are given more than once: 4"),
        (5, {"read_depth": None}, "1 of 10 frames have no depth: 5"),
        (9, {"world_from_cam": se3.exp(np.array([0, 0, 0, 3.0, 0, 0]))}, "1 jump of the pose, the largest 2.92 m"),
        (9, {"world_from_cam": se3.exp(np.array([0, 0, 1.0, 0.09, 0, 0]))}, "1 jump of the pose, the largest 57.3 °"),
        (0, {"read_depth": partial(constant_depth, 0.0)}, "frame 0: 100% of its pixels have no depth"),
    ],
)
def test_an_oddity_is_named(row: int, change: dict[str, Any], expected: str) -> None:
    frames = walk(10)
    frames[row] = replace(frames[row], **change)
    assert any(text.startswith(expected) for text in oddities_of(frames)), oddities_of(frames)


def test_a_wrong_depth_scale_is_suspected() -> None:
    frames = [replace(frame, read_depth=partial(constant_depth, 2000.0)) for frame in walk(3)]
    assert oddities_of(frames) == ["the median depth is 2e+03 m: is the depth scale right (source.reader.depth_scale)?"]
    near = [replace(frame, read_depth=partial(constant_depth, 0.4)) for frame in frames]
    assert oddities_of(near)[0].startswith("all depth lies within 0.4 m, as in a close-up: is the depth scale right")


@pytest.mark.parametrize("error", [SourceError, OSError])
def test_frames_that_cannot_be_read_are_told(error: type[Exception]) -> None:
    frames = walk(3)
    frames[1] = replace(frames[1], read_depth=partial(unreadable, error))
    facts = frame_facts(frames, [])
    assert facts["unreadable among them"] == ["frame.png: is no PNG"] and facts["frames looked into"] == 2


def test_where_no_frame_can_be_read_the_reason_is_the_error(tmp_path: Path) -> None:
    (tmp_path / "0.ply").write_text("ply\n")
    with pytest.raises(SourceError, match=r"^\S+0\.ply: no PLY header"):
        inspect(tmp_path)
    (tmp_path / "1.ply").write_text("ply\n")
    with pytest.raises(SourceError, match=r"none of the 2 frames looked into can be read: \S+0\.ply: no PLY header"):
        inspect(tmp_path)


@pytest.mark.parametrize("error", [SourceError, OSError])
def test_images_without_readable_colours_are_told(error: type[Exception]) -> None:
    frames = [replace(frame, read_colour=partial(unreadable, error)) for frame in walk(2)]
    facts = frame_facts(frames, [])
    assert facts["unreadable among them"] == ["frame.png: is no PNG"] * 2 and facts["frames looked into"] == 2


def test_sequences_are_not_compared_with_each_other() -> None:
    second = [replace(frame, sequence="b", frame_id=f"b{frame.frame_id}") for frame in walk(5)]

    assert oddities_of([*walk(5), *second]) == []


def square(*extra: tuple[int, int]) -> ViewGraph:
    """0 - 1
    |   |
    3 - 2, and vertex 4 alone."""
    edges = np.array([(0, 1), (1, 2), (2, 3), (3, 0), *extra])
    motions = np.broadcast_to(np.eye(4), (len(edges), 4, 4))
    return ViewGraph.from_edges(np.arange(10, 15), edges, motions, 2 * np.broadcast_to(np.eye(6), (len(edges), 6, 6)))


def test_cycles_of_a_square() -> None:
    found: list[str] = []
    facts = graph_facts(square(), found)
    assert facts["independent cycles"] == facts["cycles that no triangles fill (b1)"] == 1
    assert facts["connected components"] == 2 and facts["isolated vertices"] == 1
    assert facts["degree, least median most"] == [0, 2.0, 2]
    assert found == ["1 of 5 vertices have no edge: 14"]


def test_a_diagonal_fills_the_square() -> None:
    facts = graph_facts(square((0, 2)), [])
    assert (facts["independent cycles"], facts["triangles"], facts["cycles that no triangles fill (b1)"]) == (2, 2, 0)


def test_lengths_of_a_model_without_a_scale_are_no_metres(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    folder.mkdir()
    cameras = [f"{row + 1} PINHOLE 40 30 {50 + row} {50 + row} 20 15" for row in range(6)]
    images = [f"{row + 1} 1 0 0 0 {row} 0 0 {row + 1} {row}.jpg\n" for row in range(6)]
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", [])):
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    facts = inspect(folder)
    assert facts["cameras"] == ["40x30 fx 50 to 55 (6 cameras)"]
    assert facts["path length in units of its own"] == 5.0 and not any("metres" in name for name in facts)
    assert inspect(folder, ColmapReader(scale=2.0))["path length in metres"] == 10.0


def test_parallel_edges_and_loops_are_no_cycles() -> None:
    found: list[str] = []
    facts = graph_facts(square((1, 0), (2, 2)), found)
    assert facts["independent cycles"] == 1 and facts["pairs with more than one edge"] == 1
    assert "1 of 6 edges have both ends at one vertex: 12-12" in found
    assert "1 edge repeats a pair that has one already" in found


def test_information_that_is_none() -> None:
    graph = square()
    information = graph.information.copy()
    information[0] = np.diag([1, 1, 1, 1, 1, -1])
    information[1] = 0
    information[2, 0, 0] = np.nan
    found: list[str] = []
    graph_facts(replace(graph, information=information), found)
    assert "1 of 4 edges have indefinite information: 10-11" in found
    assert "1 of 4 edges have no information at all: 11-12" in found
    assert "1 of 4 edges have information that is not finite: 12-13" in found


def test_a_quaternion_of_another_length_is_noted(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1.5\n")
    assert inspect(tmp_path / "poses.txt")["notes"] == [
        "poses.txt: 1 of 2 poses have a quaternion of another length than 1 (as 1.5)"
    ]
    row = " ".join(["0"] * 21)
    (tmp_path / "graph.g2o").write_text(f"EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 2 {row}\n")
    facts = inspect(tmp_path / "graph.g2o")
    assert "1 of 1 edges have a quaternion of another length than 1 (as 2)" in facts["notes"]
    assert facts["oddities"] == ["1 of 1 edges have no information at all: 0-1"]
    assert json.loads(json_text(facts))["graph"]["edges"] == 1


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("absent", "no such file or folder"),
        ("loop", "no such file or folder"),
        ("pipe", "neither a file nor a folder"),
        ("notes.md", "no reader knows this format"),
    ],
)
def test_what_cannot_be_opened_is_one_line(tmp_path: Path, name: str, complaint: str) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "notes.md").write_text("words\n")
    with pytest.raises(SourceError, match=complaint) as error:
        inspect(tmp_path / name)
    assert name in str(error.value) and "\n" not in str(error.value)


def test_a_real_graph(data_dir: Path) -> None:
    facts = inspect(data_dir / "pose_graphs/sesync/tinyGrid3D.g2o")["graph"]
    assert (facts["vertices"], facts["edges"], facts["independent cycles"]) == (9, 11, 3)


def test_of_a_long_folder_a_few_images_are_decoded(data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decode, decoded = cv2.imdecode, []
    monkeypatch.setattr(cv2, "imdecode", lambda *given: decoded.append(1) or decode(*given))
    facts = inspect(data_dir / "seven_scenes/redkitchen")
    # depth and colour, of frames looked into and of those that tell the colour camera; colour of three moments
    assert 0 < len(decoded) <= 2 * (8 + 8) + 8 * (1 + 3)
    assert facts["frames"] == 250 and facts["frames looked into"] == 8 and facts["oddities"] == []


def test_scans_without_points_and_with_many_that_are_no_numbers_are_named() -> None:
    whole = PointCloud(np.random.default_rng(0).uniform(-3, 3, (100, 3)).astype(np.float32))
    half = PointCloud(whole.points_in_cam[:50], no_numbers=50)
    clouds, oddities = [whole, half, PointCloud(whole.points_in_cam[:0]), whole, whole], list[str]()
    frame_facts([Frame(f"{k}.ply", float(k), read_points=partial(clouds.__getitem__, k)) for k in range(5)], oddities)
    assert "frame 1.ply: 50% of its points are no numbers" in oddities and "frame 2.ply has no points" in oddities


def test_a_damaged_las_file_refuses_no_folder(tmp_path: Path) -> None:
    for name in ("a1", "a2"):
        write_ply(tmp_path / f"{name}.ply", PointCloud(np.ones((3, 3), np.float32)))
    (tmp_path / "a3.las").write_bytes(b"LASF" + bytes(40))
    frames = CloudFolderReader().open(tmp_path).frames
    assert [frame.frame_id for frame in frames] == ["a1.ply", "a2.ply", "a3.las"]
    with pytest.raises(SourceError, match="a3.las"):
        frames[2].read_points()  # type: ignore[misc]
    for name in ("a1", "a2"):
        (tmp_path / f"{name}.ply").unlink()
    with pytest.raises(SourceError, match="a3.las"):
        CloudFolderReader().open(tmp_path)

"""A path that no reader opens is told what it is, or what to give instead, in one line."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.reader import ColmapReader
from hodge_adapters.pose_graphs.g2o import load_g2o
from hodge_adapters.pose_graphs.toro import load_toro
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import guess_reader, inspect
from readers_data import tum_folder

ISAM = (
    "ODOMETRY 0 1 1 0 0.1 4 0 0 9 0 1\n"
    "LANDMARK 0 5 2 3 0.4 0 0.4\n"
    "ODOMETRY 1 2 1 0 0.1 4 0 0 9 0 1\n"
    "LANDMARK 1 5 1 3 0.4 0 0.4\n"
)  # fmt: skip


def complaint(path: Path) -> str:
    with pytest.raises(SourceError) as error:
        inspect(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    return str(error.value)


def test_a_folder_of_sources_names_them(tmp_path: Path) -> None:
    tum_folder(tmp_path / "data/room/first")
    (tmp_path / "data/loop.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    (tmp_path / "data/again").symlink_to(tmp_path)
    (tmp_path / "data/main.cpp").write_text('// reads "PinholeCameraTrajectory" and "PoseGraph"\n')
    told = complaint(tmp_path)
    assert told.endswith(f"give {tmp_path / 'data/loop.g2o'} (g2o), {tmp_path / 'data/room/first'} (tum)")


def test_what_holds_nothing_or_something_packed_is_told_so(tmp_path: Path) -> None:
    (tmp_path / "bag.mcap").write_bytes(b"")
    assert complaint(tmp_path / "bag.mcap").endswith("the file is empty: record or copy it again")
    (tmp_path / "folder").mkdir()
    assert complaint(tmp_path / "folder").endswith("the folder is empty")
    (tmp_path / "folder/bag.tar.xz").write_bytes(b"x")
    (tmp_path / "folder/README.md").write_text("a bag")
    assert complaint(tmp_path / "folder").endswith("unpack bag.tar.xz first")
    (tmp_path / "graph.g2o.gz").write_bytes(b"\x1f\x8b")
    assert complaint(tmp_path / "graph.g2o.gz").endswith(": packed: unpack it first")
    (tmp_path / "scan.ptx").write_text("2\n2\n0 0 0\n")
    assert complaint(tmp_path / "scan.ptx").endswith(": a scan of another format: convert to PLY")


def test_images_of_another_format_are_told_what_to_become(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth/0.pgm").write_bytes(b"P5 1 1 65535 00")
    assert complaint(tmp_path).endswith("convert depth/0.pgm and its like to PNG, depth with all 16 bits")
    assert "convert 0.pgm" in complaint(tmp_path / "depth") and "convert 0.pgm" in complaint(tmp_path / "depth/0.pgm")


def test_depth_beside_colour_in_another_format_is_told_what_to_become(tmp_path: Path) -> None:
    for name in ("depth/1.pgm", "color/1.png"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_bytes(b"P5 1 1 65535 00")
    assert complaint(tmp_path).endswith("no PNG in it: convert 1.pgm and its like to PNG, depth with all 16 bits")


def test_images_in_an_unknown_layout_are_told_which_is_known(tmp_path: Path) -> None:
    (tmp_path / "depth_0001.png").write_bytes(b"")
    assert "put depth (PNG of 16 bits, millimetres) in depth/ and colour in color/" in complaint(tmp_path)


def test_a_folder_of_many_sources_names_a_few(tmp_path: Path) -> None:
    for number in range(200):
        (tmp_path / f"{number:03}.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    assert complaint(tmp_path).endswith("002.g2o (g2o) and others")


def test_a_folder_of_nothing_known_says_so(tmp_path: Path) -> None:
    (tmp_path / "a/b/c/d").mkdir(parents=True)
    (tmp_path / "a/words.md").write_text("words\n")
    assert "no reader knows this format" in complaint(tmp_path)


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("images.txt", "one file of a COLMAP model: give its folder"),
        ("points3D.txt", "one file of a COLMAP model: give its folder"),
        ("database.db", "give the folder of a model, with --database for this one"),
        ("gt.info", "give the .log beside it"),
        ("drive.bag", "the file is empty"),
        ("drive.mcap.zstd", "packed: unpack it first"),
        ("bag.tar.xz", "packed: unpack it first"),
    ],
)
def test_a_file_that_is_nearly_a_source(tmp_path: Path, name: str, advice: str) -> None:
    for part in ("cameras.txt", "images.txt", name):
        (tmp_path / part).write_text("")
    assert advice in complaint(tmp_path / name)


def test_an_old_bag_is_told_from_what_is_no_bag(tmp_path: Path) -> None:
    (tmp_path / "old.bag").write_text("#ROSBAG V1.2\n")
    (tmp_path / "other.bag").write_bytes(bytes(range(256)))
    assert "a ROS 1 bag of another format than 2.0" in complaint(tmp_path / "old.bag")
    assert "no reader knows this format" in complaint(tmp_path / "other.bag")


@pytest.mark.parametrize("ending", ["bin", "txt"])
def test_a_model_further_down_is_named(tmp_path: Path, ending: str) -> None:
    model = tmp_path / "project/export/truth"
    model.mkdir(parents=True)
    for part in ("cameras", "images"):
        (model / f"{part}.{ending}").write_text("")
    for opened in (ColmapReader().open, ColmapModels().open_models):
        with pytest.raises(SourceError, match=f"holds some below: give {model}$"):
            opened(tmp_path)
        with pytest.raises(SourceError, match=f"one file of a COLMAP model: give its folder {model}$"):
            opened(model / f"images.{ending}")
        with pytest.raises(SourceError, match="no such file or folder"):
            opened(tmp_path / "nowhere")
        with pytest.raises(SourceError, match="no COLMAP model: give the folder with cameras.bin"):
            opened(Path(__file__).parent)
    shutil.copytree(model, tmp_path / "text")
    with pytest.raises(SourceError, match=f"holds some below: give {model}, {tmp_path / 'text'}$"):
        ColmapModels().open_models(tmp_path)


def test_of_a_graph_with_landmarks_the_poses_are_solved(tmp_path: Path) -> None:
    path = tmp_path / "drive.txt"
    path.write_text(ISAM)
    source = guess_reader(path).open(path)
    assert source.graph is not None and source.graph.edges.tolist() == [[0, 1], [1, 2]]
    assert "2 lines of kind LANDMARK not read: landmarks, where only edges between poses are solved" in source.notes


def test_landmarks_alone_are_refused(tmp_path: Path) -> None:
    (tmp_path / "isam.txt").write_text("LANDMARK 0 5 2 3 0.4 0 0.4\n")
    (tmp_path / "g2o.txt").write_text("VERTEX_XY 5 1 2\nEDGE_SE2_XY 0 5 2 3 0.4 0 0.4\n")
    assert "holds landmarks alone (LANDMARK)" in complaint(tmp_path / "isam.txt")
    assert "holds landmarks alone (EDGE_SE2_XY, VERTEX_XY)" in complaint(tmp_path / "g2o.txt")
    with pytest.raises(SourceError, match="landmarks alone"):
        load_toro(tmp_path / "isam.txt")
    with pytest.raises(SourceError, match="landmarks alone"):
        load_g2o(tmp_path / "g2o.txt")


def test_the_first_names_of_edges_and_vertices(tmp_path: Path) -> None:
    (tmp_path / "old.graph").write_text("VERTEX 0 0 0 0\nVERTEX 1 1 0 0\nEDGE 0 1 1 0 0 1 0 1 1 0 0\n")
    facts = inspect(tmp_path / "old.graph")
    assert facts["graph"]["edges"] == 1 and facts["trajectory poses"] == 2

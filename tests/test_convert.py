from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from hodge_adapters.colmap.writer import ColmapWriter
from hodge_adapters.trajectories.rewriting import TumRewriter
from hodge_adapters.trajectories.text import parse_tum
from hodge_pipeline import se3
from hodge_pipeline.cli.convert import convert, writer_name
from hodge_pipeline.cli.main import app
from hodge_pipeline.errors import HodgeError, RecipeError, SourceError
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.types import Source, Trajectory
from readers_data import seven_scenes_sequence, tum_line, write_colour


@pytest.mark.parametrize("name", ["a.tum", "a.kitti", "a.csv", "a.log", "a.json", "transforms.json", "model"])
def test_poses_survive_a_conversion_there_and_back(tmp_path: Path, name: str, capsys) -> None:
    sequence = seven_scenes_sequence(tmp_path / "seq-01")
    original = guess_reader(sequence).open(sequence)
    convert(sequence, tmp_path / name)
    assert "written as" in capsys.readouterr().out
    convert(tmp_path / name, tmp_path / "back.tum")
    back = parse_tum(tmp_path / "back.tum").trajectory.world_from_cam
    np.testing.assert_allclose(back, [frame.world_from_cam for frame in original.frames], atol=1e-9)


def test_the_name_tells_the_writer(tmp_path: Path) -> None:
    empty = Source("a", tmp_path)
    assert writer_name(Path("a.g2o"), empty) == "g2o" and writer_name(Path("a.json"), empty) == "open3d_trajectory"
    with pytest.raises(RecipeError, match="--to"):
        writer_name(Path("a.docx"), empty)
    path = tmp_path / "a.tum"
    path.write_text(tum_line(1.5, np.eye(4)))
    with pytest.raises(HodgeError, match="no graph"):
        convert(path, tmp_path / "a.g2o")
    with pytest.raises(SourceError, match="no such file"):
        convert(tmp_path / "nothing", tmp_path / "new.tum")
    convert(path, tmp_path / "b.any", to="kitti")
    assert (tmp_path / "b.any").read_text().count(" ") == 11


def test_a_result_is_not_written_into_the_folder_that_is_read(tmp_path: Path) -> None:
    (tmp_path / "data/room").mkdir(parents=True)
    (tmp_path / "data/room/poses.tum").write_text("0 0 0 0 0 0 0 1\n")
    for source, out, what in (("data", "data", "is"), ("data/room/poses.tum", "data", "holds")):
        with pytest.raises(RecipeError, match=f"{what} what is read"):
            convert(tmp_path / source, tmp_path / out)


def test_what_is_read_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text("# mine\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    (tmp_path / "same.g2o").symlink_to("graph.g2o")
    before = (tmp_path / "graph.g2o").read_bytes()
    for command in (["convert", "graph.g2o", "same.g2o"], ["solve", "graph.g2o", "--out", "same.g2o"]):
        given = [str(tmp_path / word) if word.endswith(".g2o") else word for word in command]
        with pytest.raises(RecipeError, match="is what is read"):
            CliRunner().invoke(app, given, catch_exceptions=False)
    assert (tmp_path / "graph.g2o").read_bytes() == before


def test_what_is_there_is_replaced_only_when_asked_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sequence, out = seven_scenes_sequence(tmp_path / "seq-01"), tmp_path / "new/folder/poses.kitti"
    convert(sequence, out)
    told = capsys.readouterr().out
    assert f"{out}: written as kitti: 3 poses" in told, "counted, in a folder that is made"
    assert "not in this format, so lost: 1 camera, 3 images, 3 depth images" in told
    before = out.read_bytes()
    with pytest.raises(RecipeError, match="--overwrite"):
        convert(sequence, out)
    (tmp_path / "other.tum").write_text(tum_line(1.5, np.eye(4)))
    assert CliRunner().invoke(app, ["convert", str(tmp_path / "other.tum"), str(out), "--overwrite"]).exit_code == 0
    assert out.read_bytes() != before
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(HodgeError, match="cannot be written"):
        convert(sequence, tmp_path / "file/poses.tum")


def test_notes_are_one_line_each_and_come_before_what_a_writer_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tum = tmp_path / "a.tum"
    tum.write_text(tum_line(1.5, np.eye(4)) + "no pose\n")
    with pytest.raises(HodgeError, match="no graph"):
        convert(tum, tmp_path / "a.g2o", reader="tum_poses")
    assert capsys.readouterr().out == "note: a.tum: 1 line that is no pose left out: 2\n"
    (tmp_path / "a\nb.tum").write_text(tum.read_text())
    convert(tmp_path / "a\nb.tum", tmp_path / "a.kitti", reader="tum_poses")
    assert "note: a\\nb.tum: 1 line" in capsys.readouterr().out
    told = CliRunner().invoke(app, ["inspect", str(tmp_path / "a\nb.tum"), "--reader", "tum_poses"]).output
    assert "a\\nb.tum: 1 line" in told and "a\nb" not in told


def test_the_ninth_column_of_rtabmap_is_read(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(
        "#timestamp x y z qx qy qz qw id\n" + "".join(f"{row}.5 {row} 0 0 0 0 0 1 {row + 7}\n" for row in range(4))
    )
    assert guess_reader(path).open(path).trajectory is not None
    poses = parse_tum(path).trajectory
    assert poses.stamps_s.tolist() == [0.5, 1.5, 2.5, 3.5] and poses.world_from_cam[:, 0, 3].tolist() == [0, 1, 2, 3]
    moved = Trajectory(poses.stamps_s, se3.exp(np.array([0, 0, 0, 0, 1.0, 0])) @ poses.world_from_cam)
    lines = TumRewriter().rewrite(tmp_path, path, moved).read_text().splitlines()
    assert [line.split()[-1] for line in lines[1:]] == ["7", "8", "9", "10"] and lines[1].split()[2] == "1.0"


def binary_model(folder: Path, model: str, params: list[float]) -> Path:
    """Two images, one with a blank in its name, one point that both see; images as files."""
    made = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model=model, width=32, height=24, params=params, camera_id=1)
    made.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(("my image.png", "rig/b.png"), 1):
        pixels = [pycolmap.Point2D(np.array([10.0 + number, 12.0]))]
        image = pycolmap.Image(name=name, camera_id=1, image_id=number, points2D=pixels)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-0.5 * number, 0, 0]))
        made.add_image_with_trivial_frame(image, pose)
        write_colour(folder / "images" / name, size=(24, 32))
    track = pycolmap.Track([pycolmap.TrackElement(1, 0), pycolmap.TrackElement(2, 0)])
    made.add_point3D(np.array([0.5, 0.0, 5.0]), track, np.array([1, 2, 3], np.uint8))
    (folder / "sparse").mkdir(parents=True)
    made.write_binary(str(folder / "sparse"))
    return folder


@pytest.mark.parametrize(("scale", "factor"), [([], 1.0), (["scale=2.5"], 2.5)])
def test_a_colmap_model_stays_whole(tmp_path: Path, scale: list[str], factor: float) -> None:
    folder = binary_model(tmp_path / "scene", "SIMPLE_RADIAL", [30, 16, 12, -0.1])
    convert(folder, tmp_path / "out", settings=["min_shared=8", "edges=none", *scale])
    read, made = (pycolmap.Reconstruction(str(place)) for place in (tmp_path / "out", folder / "sparse"))
    assert read.cameras[1].model.name == "SIMPLE_RADIAL" and read.cameras[1].params.tolist() == [30, 16, 12, -0.1]
    assert {image.name for image in read.images.values()} == {"my image.png", "rig/b.png"}
    np.testing.assert_allclose(read.points3D[1].xyz, factor * made.points3D[1].xyz)
    assert len(read.points3D[1].track.elements) == 2
    np.testing.assert_allclose(read.images[2].projection_center(), factor * made.images[2].projection_center())


def test_a_lens_passes_through_to_nerfstudio_and_back_to_colmap(tmp_path: Path) -> None:
    folder = binary_model(tmp_path / "scene", "SIMPLE_RADIAL", [30, 16, 12, -0.1])
    convert(folder, tmp_path / "scene/transforms.json", settings=["edges=none"])
    there = json.loads((tmp_path / "scene/transforms.json").read_text())
    frame = there["frames"][0]
    assert there["camera_model"] == "OPENCV" and frame["file_path"] == "images/my image.png"
    assert [frame[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1")] == [32, 24, 30, 30, 16, 12, -0.1]
    convert(folder, tmp_path / "far/transforms.json", settings=["edges=none"])
    copied = json.loads((tmp_path / "far/transforms.json").read_text())["frames"][1]["file_path"]
    assert (tmp_path / "far" / copied).read_bytes() == (folder / "images/rig/b.png").read_bytes(), "copied beside it"
    convert(tmp_path / "far/transforms.json", tmp_path / "model")
    camera = pycolmap.Reconstruction(str(tmp_path / "model")).cameras[1]
    assert camera.model.name == "OPENCV" and camera.params.tolist() == [30, 30, 16, 12, -0.1, 0, 0, 0]
    with pytest.raises(SourceError, match="blanks"):
        ColmapWriter(form="txt").write(tmp_path / "text", guess_reader(tmp_path / "far").open(tmp_path / "far"))


def test_a_name_without_an_ending_is_the_folder_that_nerfstudio_trains_on(tmp_path: Path) -> None:
    folder, out = binary_model(tmp_path / "scene", "PINHOLE", [30, 30, 16, 12]), tmp_path / "for nerfstudio"
    convert(folder, out, to="nerfstudio", settings=["edges=none"])
    assert sorted(path.name for path in out.iterdir()) == ["images", "transforms.json"]
    assert not (tmp_path / "images").exists() and len(guess_reader(out).open(out).frames) == 2


def test_images_of_a_lens_that_nerfstudio_lacks_are_undistorted(tmp_path: Path) -> None:
    folder = binary_model(tmp_path / "scene", "FOV", [30, 30, 16, 12, 0.4])
    convert(folder, tmp_path / "out/transforms.json", settings=["edges=none"])
    there = json.loads((tmp_path / "out/transforms.json").read_text())["frames"][0]
    assert not {"k1", "k2"} & set(there) and there["file_path"] == "images/my image.png"
    written = cv2.cvtColor(cv2.imread(str(tmp_path / "out/images/my image.png")), cv2.COLOR_BGR2RGB)
    frame = guess_reader(folder).open(folder).frames[0]
    assert frame.read_colour is not None and frame.camera is not None and there["fl_x"] == frame.camera.fx
    np.testing.assert_array_equal(written, frame.read_colour())

from __future__ import annotations

import json
import re
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_data import synthetic
from hodge_adapters.colmap.cameras import pinhole_camera, undistortion
from hodge_adapters.colmap.content import content_of
from hodge_adapters.colmap.files import by_report
from hodge_adapters.colmap.reader import ColmapReader
from hodge_adapters.colmap.records import NO_POINT, CameraRecord
from hodge_adapters.colmap.writer import ColmapWriter
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Frame, Source
from readers_data import some_poses, write_colour, write_depth

SIZE = (64, 48)


def edge_errors(source: Source) -> tuple[np.ndarray, np.ndarray]:
    graph, poses = source.graph, source.trajectory.world_from_cam
    i, j = graph.edges.T
    error = se3.log(se3.inverse(graph.i_from_j) @ se3.inverse(poses[i]) @ poses[j])
    return np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)


@pytest.mark.parametrize("form", ["text", "binary"])
def test_poses_of_a_rig_model_are_those_of_pycolmap(tmp_path: Path, form: str) -> None:
    made = synthetic(tmp_path)
    source = check_reader(ColmapReader(edges="none"), tmp_path / form)
    assert len(source.frames) == len(made.images) == 8
    for frame in source.frames:
        image = made.find_image_with_name(frame.frame_id)
        expected = np.vstack([image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(frame.world_from_cam, expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["covisibility", "database"])
@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV_FISHEYE", "EUCM"])
def test_edges_are_estimated_without_the_poses(tmp_path: Path, kind: str, model: str) -> None:
    synthetic(tmp_path, model, database=True)
    connection = sqlite3.connect(tmp_path / "database.db")
    with connection:
        connection.execute("UPDATE two_view_geometries SET qvec = NULL, tvec = NULL")
    connection.close()
    source = check_reader(ColmapReader(edges=kind, min_shared=20), tmp_path / "text")
    by = {"covisibility": "structure"}.get(kind, kind)
    assert source.graph.edge_count >= 10 and set(source.graph.source) == {by}
    rotation, translation = edge_errors(source)
    assert np.median(rotation) < 1e-4 and np.median(translation) < 1e-2
    # Moved poses must not move the edges: they are measured from the images alone.
    text = (tmp_path / "text/images.txt").read_text().split("\n")
    rows = [row for row, line in enumerate(text) if line.endswith(".png")]
    fields = text[rows[0]].split()
    text[rows[0]] = " ".join([fields[0], "1 0 0 0 9 9 9", *fields[8:]])
    (tmp_path / "text/images.txt").write_text("\n".join(text))
    again = ColmapReader(edges=kind, min_shared=20, scale=2.0).open(tmp_path / "text")
    np.testing.assert_array_equal(again.graph.i_from_j, se3.rescaled(source.graph.i_from_j, 2.0))
    in_metres = np.outer(unit := np.repeat([1.0, 0.5], 3), unit)
    np.testing.assert_array_equal(again.graph.information, source.graph.information * in_metres)


@pytest.mark.parametrize("model", sorted(set(pycolmap.CameraModelId.__members__) - {"EQUIRECTANGULAR", "INVALID"}))
def test_undistortion_puts_every_ray_where_the_pinhole_says(model: str) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, model, 60.0, *SIZE)
    params = camera.params.copy()
    if len(params) > 4 and model not in ("FOV", "EUCM", "DIVISION"):
        params[4] = 0.01
    record = CameraRecord(1, model, *SIZE, tuple(params))
    pinhole = pinhole_camera(record, SIZE)
    columns, rows = undistortion(record, SIZE)
    v, u = 7, 11
    ray = np.array([[(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy, 1.0]])
    exact = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params)
    distorted = exact.img_from_cam(ray)[0] - 0.5
    np.testing.assert_allclose([columns[v, u], rows[v, u]], distorted, atol=1e-4)
    back = exact.cam_from_img(distorted[None] + 0.5)
    np.testing.assert_allclose(back[0], ray[0, :2], atol=1e-6)


def text_model(folder: Path, camera: str = "1 PINHOLE 8 6 10 10 4 3", name: str = "a.png") -> Path:
    """A model of one image in text."""
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(camera + "\n")
    (folder / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {name}\n\n")
    (folder / "points3D.txt").write_text("")
    return folder


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ("1 EQUIRECTANGULAR 64 32 64 32", "model: camera 1: .* panorama, .* rig .*colmap bundle_adjuster"),
        ("1 MEI 64 48 50 50 32 24", r"cameras.txt:1: has a camera of the unknown model MEI"),
        ("1 PINHOLE 64 48 50 x 32 24", r"cameras.txt:1: .*expected numbers"),
    ],
)
def test_cameras_that_are_refused_are_named(tmp_path: Path, camera: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        ColmapReader().open(text_model(tmp_path / "model", camera))


@pytest.mark.parametrize("name", [".", "/", "..", "a/.."])
def test_an_image_without_a_name_has_no_depth(tmp_path: Path, name: str) -> None:
    (tmp_path / "depth").mkdir()
    source = ColmapReader(edges="none").open(text_model(tmp_path / "model", name=name))
    assert source.frames[0].read_depth is None and any("not there as files" in note for note in source.notes)


def test_content_is_what_pycolmap_gives_object_by_object(tmp_path: Path) -> None:
    synthetic(tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "text")
    model.delete_point3D(max(model.points3D))
    model.deregister_frame(model.reg_frame_ids()[1])
    content, posed = content_of(model), set(model.reg_image_ids())
    assert len(content.images) == len(posed) < model.num_images()
    for record in content.images:
        seen = model.images[record.image_id].points2D
        np.testing.assert_array_equal(record.pixels, [point.xy for point in seen])
        assert record.point_ids.tolist() == [p.point3D_id if p.has_point3D() else NO_POINT for p in seen]
    assert (np.concatenate([record.point_ids for record in content.images]) == NO_POINT).any()
    points = content.points
    assert points.ids.tolist() == sorted(model.points3D)
    for row, point_id in enumerate(points.ids.tolist()):
        here, point = slice(points.offsets[row], points.offsets[row + 1]), model.points3D[point_id]
        np.testing.assert_array_equal(points.xyz[row], point.xyz)
        own = zip(points.image_ids[here].tolist(), points.columns[here].tolist(), strict=True)
        assert [*own] == [(e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in posed]


def test_what_a_report_leads_to_is_told(tmp_path: Path) -> None:
    model, far = text_model(tmp_path / "refined/sparse/0"), tmp_path / "far/away"
    (tmp_path / "refined/refinement").mkdir()
    (tmp_path / "refined/report.json").write_text(json.dumps({"source": {"path": str(far / "from/it")}}))
    (far / "images").mkdir(parents=True)
    for found in (far / "images", far / "database.db"):
        assert by_report(model, found)[0].startswith(f"{found}: taken, since the report.json of this model")
    assert by_report(model, far / "images")[0] in ColmapReader().open(model).notes
    (far / "images").rename(tmp_path / "images")
    assert not any("report.json" in note for note in ColmapReader().open(model).notes), "above the model"


def posed_source(folder: Path, count: int = 4) -> Source:
    camera = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)
    poses = some_poses(count)
    frames = tuple(Frame(f"a{row}.png", float(row), camera, world_from_cam=pose) for row, pose in enumerate(poses))
    return Source("made", folder, frames)


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_written_models_are_read_again_here_and_by_pycolmap(tmp_path: Path, form: str) -> None:
    source = posed_source(tmp_path)
    ColmapWriter(form=form).write(tmp_path / "model", source)
    back = ColmapReader(edges="none").open(tmp_path / "model")
    theirs = pycolmap.Reconstruction(tmp_path / "model")
    for before, after in zip(source.frames, back.frames, strict=True):
        assert before.frame_id == after.frame_id and before.camera == after.camera
        np.testing.assert_allclose(after.world_from_cam, before.world_from_cam, atol=1e-12)
        image = theirs.find_image_with_name(before.frame_id)
        np.testing.assert_allclose(image.cam_from_world().matrix(), se3.inverse(before.world_from_cam)[:3], atol=1e-12)
        assert image.camera.principal_point_x == 4.0, "COLMAP's pixel centres are at halves"


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    source = posed_source(tmp_path)
    with pytest.raises(SourceError, match="no frame"):
        ColmapWriter().write(tmp_path / "model", replace(source, frames=()))
    up = replace(source.frames[0], camera=Camera(8, 6, 10.0, -10.0, 3.5, 2.5))
    with pytest.raises(SourceError, match="negative"):
        ColmapWriter().write(tmp_path / "model", replace(source, frames=(up,)))


def depth_map(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pycolmap.DepthMap.from_array(values.astype(np.float32), 0.1, 10.0).write(path)


def test_colmaps_own_depth_maps(tmp_path: Path) -> None:
    source = posed_source(tmp_path, 2)
    (tmp_path / "sparse").mkdir()
    ColmapWriter().write(tmp_path / "sparse", source)
    values = np.arange(48, dtype=np.float32).reshape(6, 8) / 10
    values[0, 0] = -1
    for frame in source.frames:
        depth_map(tmp_path / f"stereo/depth_maps/{frame.frame_id}.geometric.bin", values)
        write_colour(tmp_path / "images" / frame.frame_id)
    found = check_reader(ColmapReader(scale=2.0), tmp_path)
    np.testing.assert_allclose(found.frames[0].read_depth(), np.maximum(values, 0) * 2)
    np.testing.assert_allclose(found.frames[1].world_from_cam[:3, 3], source.frames[1].world_from_cam[:3, 3] * 2)
    assert found.frames[0].read_colour().shape == (6, 8, 3) and found.graph is None
    broken = tmp_path / f"stereo/depth_maps/{source.frames[0].frame_id}.geometric.bin"
    broken.write_bytes(broken.read_bytes()[:-5])
    with pytest.raises(SourceError, match="copy it again"):
        ColmapReader().open(tmp_path).frames[0].read_depth()


def test_sensor_depth_is_undistorted_like_the_colour(tmp_path: Path) -> None:
    model = tmp_path / "sparse"
    ColmapWriter(form="txt").write(model, posed_source(tmp_path, 1))
    (model / "cameras.txt").write_text("1 OPENCV 64 48 50 50 32 24 -0.2 0.01 0 0\n")
    v, u = np.mgrid[0:48, 0:64]
    write_depth(tmp_path / "depth/a0.png", (1000 + 10 * u + 5 * v).astype(np.uint16))
    frame = check_reader(ColmapReader(scale=1.0), tmp_path).frames[0]
    columns, rows = undistortion(CameraRecord(1, "OPENCV", 64, 48, (50, 50, 32, 24, -0.2, 0.01, 0, 0)), (64, 48))
    depth = frame.read_depth()
    inside = (depth > 0) & (columns > 1) & (rows > 1) & (columns < 62) & (rows < 46)
    assert inside.sum() > 1000
    expected = (1000 + 10 * columns + 5 * rows) / 1000
    assert np.abs(depth - expected)[inside].max() <= 0.0076, "the nearest pixel, half a pixel off at most"
    assert frame.encoded_depth is None, "its bytes are of the distorted image"


def test_scale_from_sensor_depth(tmp_path: Path) -> None:
    made = synthetic(tmp_path, "PINHOLE")
    folder = tmp_path / "text"
    for image in made.images.values():
        depth = np.zeros((768, 1024), np.uint16)
        points = [p for p in image.points2D if p.has_point3D()]
        for point in points:
            z = (image.cam_from_world() * made.points3D[point.point3D_id].xyz)[2]
            column, row = np.floor(point.xy).astype(int)
            depth[row, column] = np.clip(round(z * 500 * 0.3), 0, 65000)
        write_depth(tmp_path / "depth" / image.name, depth)
    source = ColmapReader(depth_scale=500.0).open(folder)
    scale = np.linalg.norm(source.frames[0].world_from_cam[:3, 3]) / np.linalg.norm(
        made.find_image_with_name(source.frames[0].frame_id).projection_center()
    )
    assert scale == pytest.approx(0.3, rel=1e-2)
    assert any("by sensor depth" in note for note in source.notes)


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        ("cameras", lambda b: b[:-1], "cut off"),
        ("images", lambda b: b"\xff" * 8 + b[8:], "more than the file has room for"),
        ("points3D", lambda b: b + b"\0", "goes on"),
        ("cameras", lambda b: b[:12] + b"\x63" + b[13:], "unknown model 99"),
    ],
)
def test_damaged_binary_models_name_file_and_byte(tmp_path: Path, name: str, edit, message: str) -> None:
    synthetic(tmp_path)
    path = tmp_path / "binary" / f"{name}.bin"
    path.write_bytes(edit(path.read_bytes()))
    with pytest.raises(SourceError, match=message) as error:
        ColmapReader().open(tmp_path / "binary")
    assert path.name in str(error.value) and "at byte" in str(error.value)


@pytest.mark.parametrize("x", ["1e101", "nan"])
def test_a_pose_that_is_none_is_refused_by_its_image(tmp_path: Path, x: str) -> None:
    synthetic(tmp_path)
    path = tmp_path / "text" / "frames.txt"
    *head, frame = path.read_text("utf-8").splitlines()
    frame = re.sub(r"^((?:\S+ ){6})\S+", rf"\g<1>{x}", frame)
    path.write_text("\n".join([*head, frame]) + "\n", "utf-8")
    with pytest.raises(SourceError, match=r"frames.txt:|camera00000\d_frame00000\d.png"):
        ColmapReader().open(tmp_path / "text")


@pytest.mark.parametrize(
    ("name", "column", "remedy"),
    [
        ("points3D", 1, "COLMAP writes points that are none, and does not read them: give the model as .bin"),
        ("cameras", 4, "calibrate the camera again"),
        ("images", 5, "register the image again"),
    ],
)
def test_no_converter_is_advised_for_numbers_that_are_none(tmp_path: Path, name: str, column: int, remedy: str) -> None:
    synthetic(tmp_path)
    path = tmp_path / "text" / f"{name}.txt"
    lines = path.read_text("utf-8").splitlines()
    row = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    words = lines[row].split(" ")
    words[column] = "nan"
    path.write_text("\n".join([*lines[:row], " ".join(words), *lines[row + 1 :]]) + "\n", "utf-8")
    with pytest.raises(SourceError, match=rf"{name}.txt:{row + 1}: `nan`: expected a number: {remedy}") as refused:
        ColmapReader().open(tmp_path / "text")
    assert "model_converter" not in str(refused.value)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_models_with_a_byte_order_mark_are_refused_by_name(tmp_path: Path, name: str, encoding: str) -> None:
    synthetic(tmp_path)
    path = tmp_path / "text" / f"{name}.txt"
    path.write_text(path.read_text("utf-8"), encoding)
    with pytest.raises(SourceError, match=rf"{name}.txt:1: begins with a byte-order mark.*save it as UTF-8"):
        ColmapReader().open(tmp_path / "text")


def test_a_database_that_is_none_is_named(tmp_path: Path) -> None:
    synthetic(tmp_path)
    with pytest.raises(SourceError, match="no database.db"):
        ColmapReader(edges="database").open(tmp_path / "text")
    (tmp_path / "database.db").write_bytes(b"SQLite format 3\0" + b"\xff" * 200)
    with pytest.raises(SourceError, match="database.db"):
        ColmapReader(edges="database").open(tmp_path / "text")


def test_real_models(data_dir: Path) -> None:
    door = ColmapReader(min_shared=100, max_edges_per_image=1).open(
        data_dir / "colmap/lund_door/set1_lund_door/colmap_ground_truth"
    )
    rotation, translation = edge_errors(door)
    assert len(rotation) >= 6 and np.degrees(rotation).max() < 0.2 and translation.max() < 0.1
    assert door.frames[3].read_colour().shape == (1936, 1296, 3)
    vesta = check_reader(ColmapReader(), data_dir / "colmap/astrovision_vesta/test_2011212_opnav_022", max_decoded=1)
    assert vesta.graph.edge_count == 6
    assert len(ColmapReader().open(data_dir / "colmap/unsorted_tiny").frames) == 3


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("palace", "the track of point"),
        ("t265_fisheye_rig", "blanks instead of commas"),
        ("lund_door/lund_door_binary/C_1/C_1_1/ba_output", "the track of point"),
    ],
)
def test_real_models_that_contradict_themselves(data_dir: Path, place: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        ColmapReader().open(data_dir / "colmap" / place)
    if "track" in message:
        assert len(ColmapReader(tracks=False).open(data_dir / "colmap" / place).frames) > 0


def test_red_kitchen_depth_beside_images(data_dir: Path, tmp_path: Path) -> None:
    sequence = data_dir / "seven_scenes/redkitchen/seq-01"
    names = [f"frame-{number:06d}.color.jpg" for number in (0, 20)]
    for name in names:
        for file in (name, name.replace("color.jpg", "depth.png")):
            (tmp_path / "images").mkdir(exist_ok=True)
            shutil.copy(sequence / file, tmp_path / "images" / file)
    camera = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    frames = tuple(Frame(name, 0.0, camera, world_from_cam=np.eye(4)) for name in names)
    ColmapWriter().write(tmp_path / "sparse", Source("made", tmp_path, frames))
    source = check_reader(ColmapReader(), tmp_path)
    depth = source.frames[0].read_depth()
    assert source.frames[0].camera == camera and depth[depth > 0].min() > 0.4 and depth.max() < 10


MUTATE = """
import random, shutil, sys
from pathlib import Path
from hodge_adapters.colmap.content import read_model
from hodge_pipeline.errors import SourceError

model, work = Path(sys.argv[1]), Path(sys.argv[2])
WRONG = [b"\\0\\0\\0\\0", b"\\xff\\xff\\xff\\xff", b"\\0\\0\\xf8\\x7f", b"9 nan"]
told = {"opened": 0, "refused": 0}
for seed in range(150):
    rng = random.Random(seed)
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(model, work)
    file = rng.choice(sorted(work.iterdir()))
    data = bytearray(file.read_bytes())
    for _ in range(rng.choice([1, 2, 8])):
        at = rng.randrange(len(data))
        data[at : at + 4] = rng.choice(WRONG)[: len(data) - at]
    file.write_bytes(data)
    try:
        read_model(work)
        told["opened"] += 1
    except SourceError as error:
        assert "\\n" not in str(error), error
        told["refused"] += 1
print(told["opened"], told["refused"])
"""


@pytest.mark.parametrize("form", ["text", "binary"])
def test_whatever_the_bytes_are_pycolmap_neither_crashes_nor_hangs(tmp_path: Path, form: str) -> None:
    synthetic(tmp_path)
    command = [sys.executable, "-c", MUTATE, str(tmp_path / form), str(tmp_path / "work")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    opened, refused = map(int, done.stdout.split())
    assert opened >= 10 and refused >= 10


def test_text_files_beside_a_binary_model_are_noted(tmp_path: Path) -> None:
    synthetic(tmp_path)
    note = "the binary model is read, not the text files beside it"
    assert note not in ColmapReader(edges="none").open(tmp_path / "binary").notes
    for file in (tmp_path / "text").iterdir():
        shutil.copy(file, tmp_path / "binary")
    assert note in ColmapReader(edges="none").open(tmp_path / "binary").notes

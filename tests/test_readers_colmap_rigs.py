"""COLMAP's rigs and frames: whose pose an image has, and what is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hodge_adapters.colmap.content import read_model
from hodge_adapters.colmap.reader import ColmapReader
from hodge_adapters.colmap.writer import ColmapWriter
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Frame, Source
from readers_data import some_poses

RIGS = "1 2 CAMERA 1 CAMERA 2 1 1 0 0 0 0.1 0 0\n"
FRAMES = "1 1 1 0 0 0 0 0 0 2 CAMERA 1 1 CAMERA 2 2\n2 1 1 0 0 0 0 0 -2 2 CAMERA 1 3 CAMERA 2 4\n"
"""Two cameras side by side, the second at x = -0.1; then both go to z = 2."""

CENTRES = [[0, 0, 0], [-0.1, 0, 0], [0, 0, 2], [-0.1, 0, 2]]


def write_model(folder: Path, rigs: str | None = RIGS, frames: str | None = FRAMES, own: str = "1 0 0 0 5 5 5") -> Path:
    """Four images of two cameras, whose own records all hold the same pose."""
    folder.mkdir()
    (folder / "cameras.txt").write_text("1 PINHOLE 8 6 10 10 4 3\n2 PINHOLE 8 6 11 11 4 3\n")
    rows = [f"{number} {own} {1 + (number - 1) % 2} {number}.png\n\n" for number in range(1, 5)]
    (folder / "images.txt").write_text("".join(rows))
    for name, text in (("rigs", rigs), ("frames", frames)):
        if text is not None:
            (folder / f"{name}.txt").write_text(text)
    return folder


def centres(source: Source) -> np.ndarray:
    return np.array([frame.world_from_cam[:3, 3] for frame in source.frames])


def test_an_image_has_the_pose_of_its_rigs_frame(tmp_path: Path) -> None:
    source = check_reader(ColmapReader(), write_model(tmp_path / "model"))
    np.testing.assert_allclose(centres(source), CENTRES, atol=1e-15)
    assert "1 of 1 rigs have more than one sensor: 2 frames of rigs" in source.notes
    assert tmp_path / "model/rigs.txt" in source.files and tmp_path / "model/frames.txt" in source.files


def test_without_rigs_the_images_own_poses_hold(tmp_path: Path) -> None:
    source = check_reader(ColmapReader(), write_model(tmp_path / "model", None, None))
    np.testing.assert_allclose(centres(source), [[-5, -5, -5]] * 4)


@pytest.mark.parametrize(("length", "is_noted"), [(1 + 1e-5, False), (2.0, True)])
def test_quaternions_of_another_length_are_divided_by_it(tmp_path: Path, length: float, is_noted: bool) -> None:
    own = f"{0.6 * length:.9g} 0 0 {0.8 * length:.9g} 0 0 5"
    model, content = read_model(write_model(tmp_path / "model", None, None, own))
    turn = [[-0.28, 0.96, 0], [-0.96, -0.28, 0], [0, 0, 1]]  # world from camera: about z by -2 arccos(0.6)
    np.testing.assert_allclose(content.images[0].world_from_cam[:3, :3], turn, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(model.images[1].cam_from_world().rotation.quat), 1, atol=1e-12)
    note = "4 of 4 poses have a quaternion of another length than 1 (as 2)"
    assert (note in content.notes) == is_noted


@pytest.mark.parametrize(
    ("rigs", "frames", "complaint"),
    [
        (
            "1 3 CAMERA 1 CAMERA 2 0 IMU 1 1 1 0 0 0 1 1 1\n",
            "1 1 1 0 0 0 0 0 0 3 CAMERA 1 1 CAMERA 2 2 IMU 1 7\n",
            "in no frame",
        ),
        ("1 2 CAMERA 1 CAMERA 2 0\n", FRAMES, "a sensor whose place on its rig is not known"),
    ],
)
def test_images_that_no_posed_sensor_took_are_refused(tmp_path: Path, rigs: str, frames: str, complaint: str) -> None:
    with pytest.raises(SourceError, match=complaint):
        ColmapReader().open(write_model(tmp_path / "model", rigs, frames))


@pytest.mark.parametrize("form", ["text", "binary"])
def test_rigs_that_pycolmap_wrote(tmp_path: Path, form: str) -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=2, num_cameras_per_rig=3, num_frames_per_rig=3, num_points3D=20)
    pycolmap.set_random_seed(0)
    made = pycolmap.synthesize_dataset(options)
    (tmp_path / "model").mkdir()
    (made.write_text if form == "text" else made.write_binary)(tmp_path / "model")
    source = check_reader(ColmapReader(tracks=False, edges="none"), tmp_path / "model")
    assert len(source.frames) == 18 and not any("another pose" in note for note in source.notes)
    for frame in source.frames:
        expected = made.find_image_with_name(frame.frame_id).cam_from_world().inverse().matrix()
        np.testing.assert_allclose(frame.world_from_cam[:3], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("rigs", "frames", "complaint"),
    [
        (RIGS, None, "frames.txt: is not there, but rigs.txt is"),
        (None, FRAMES, "rigs.txt: is not there, but frames.txt is"),
        ("1 2 CAMERA 1\n", FRAMES, "rigs.txt:1: .*so many sensors"),
        ("1 2 CAMERA 1 CAMERA 2 1 1 0 0\n", FRAMES, "rigs.txt:1: .*HAS_POSE"),
        ("1 2 CAMERA 1 CAMERA 2 yes\n", FRAMES, "rigs.txt:1: .*HAS_POSE"),
        ("1 1 SONAR 1\n", FRAMES, "rigs.txt:1: .*SENSOR_TYPE"),
        ("1 2 CAMERA 1 CAMERA 2 1 0 0 0 0 0 0 0\n", FRAMES, "quaternion is of length 0, not 1"),
        (RIGS + RIGS, FRAMES, "given twice"),
        ("1 2 CAMERA 1 CAMERA 1 0\n", FRAMES, "a sensor twice"),
        (RIGS, "1 1 1 0 0 0 0 0 0 2 CAMERA 1 1\n", "frames.txt:1: .*triples"),
        (RIGS, "1 1 1 0 0 0 nan 0 0 1 CAMERA 1 1\n", "frames.txt:1"),
        (RIGS, "1 9 1 0 0 0 0 0 0 1 CAMERA 1 1\n", "rig 9, which is not there"),
        (RIGS, "1 1 1 0 0 0 0 0 0 1 CAMERA 9 1\n", "a camera which its rig has not"),
        (RIGS, FRAMES + FRAMES, "an image is in two frames"),
    ],
)
def test_rigs_that_lie_are_refused(tmp_path: Path, rigs: str | None, frames: str | None, complaint: str) -> None:
    with pytest.raises(SourceError, match=complaint):
        ColmapReader().open(write_model(tmp_path / "model", rigs, frames))


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin"])
def test_binary_rigs_cut_anywhere_are_refused(tmp_path: Path, name: str) -> None:
    write_frames(tmp_path / "model", "bin")
    whole = (tmp_path / "model" / name).read_bytes()
    for cut in range(0, len(whole), 5):
        (tmp_path / "model" / name).write_bytes(whole[:cut])
        with pytest.raises(SourceError, match=name):
            ColmapReader().open(tmp_path / "model")
    (tmp_path / "model" / name).write_bytes(struct.pack("<Q", 1 << 60) + whole[8:])
    with pytest.raises(SourceError, match="more than the file has room for"):
        ColmapReader().open(tmp_path / "model")


def write_frames(folder: Path, form: str) -> tuple[Frame, ...]:
    cameras = Camera(8, 6, 10, 11, 4, 3), Camera(16, 6, 12, 12, 8, 3)
    frames = tuple(
        Frame(f"{row}.png", float(row), cameras[row % 2], world_from_cam=pose) for row, pose in enumerate(some_poses(5))
    )
    ColmapWriter(form=form).write(folder, Source("s", folder, frames))
    return frames


@pytest.mark.parametrize("form", ["bin", "txt"])
def test_a_model_is_written_with_a_rig_for_each_camera(tmp_path: Path, form: str) -> None:
    frames = write_frames(tmp_path / "model", form)
    names = {path.name for path in (tmp_path / "model").iterdir()}
    assert names == {f"{name}.{form}" for name in ("cameras", "rigs", "frames", "images", "points3D")}
    opened = pycolmap.Reconstruction(tmp_path / "model")
    assert len(opened.rigs) == 2 and len(opened.frames) == 5 and opened.num_reg_images() == 5
    for frame in frames:
        image = opened.find_image_with_name(frame.frame_id)
        np.testing.assert_allclose(image.cam_from_world().inverse().matrix(), frame.world_from_cam[:3], atol=1e-12)
        assert image.frame_id == image.image_id
    again = check_reader(ColmapReader(), tmp_path / "model")
    assert [frame.camera for frame in again.frames] == [frame.camera for frame in frames]
    away = [
        se3.log(se3.inverse(a.world_from_cam) @ b.world_from_cam) for a, b in zip(again.frames, frames, strict=True)
    ]
    assert np.abs(away).max() < 1e-9

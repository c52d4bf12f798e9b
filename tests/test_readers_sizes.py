"""Folders of other cameras: images of another size than their intrinsics, and camera files by other programs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.icl_nuim.reader import IclNuimReader
from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline.cli.list import next_command
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import inspect
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera
from readers_data import (
    HEIGHT,
    WIDTH,
    depth_values,
    pose_text,
    seven_scenes_sequence,
    some_poses,
    tum_folder,
    write_depth,
)

HALVED = Camera(WIDTH, HEIGHT, 10, 10, 4, 3)
"""The camera 20 20 8.5 6.5 of images twice as large: the first pixel's centre moves by a quarter of a pixel."""


def test_intrinsics_of_larger_images_are_scaled_and_noted(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "sequence")
    (folder / "intrinsics.txt").write_text(f"20 20 8.5 6.5 {2 * WIDTH} {2 * HEIGHT}\n")
    source = check_reader(TumReader(), folder)
    assert source.frames[0].camera == HALVED
    assert f"intrinsics of {2 * WIDTH}x{2 * HEIGHT} are scaled to the images' {WIDTH}x{HEIGHT}" in source.notes


def test_images_of_another_shape_than_the_intrinsics_are_refused_in_one_line(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "sequence")
    for image in (folder / "depth").iterdir():
        write_depth(image, depth_values(shape=(9, 16)))
    with pytest.raises(
        SourceError, match=rf"depth: images of 16x9, but intrinsics of {WIDTH}x{HEIGHT}: give .*camera="
    ):
        TumReader().open(folder)
    sequence = seven_scenes_sequence(tmp_path / "seq-01")
    (sequence / "camera-intrinsics.txt").unlink()
    for image in sequence.glob("*.depth.png"):
        write_depth(image, depth_values(shape=(9, 16)))
    with pytest.raises(SourceError, match=r"images of 16x9, but intrinsics of 640x480: give .*camera="):
        SevenScenesReader().open(sequence)


def test_images_without_intrinsics_are_described_with_what_is_missing(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "sequence")
    for image in (folder / "depth").iterdir():
        write_depth(image, depth_values(shape=(9, 16)))
    facts = inspect(folder)
    assert facts["frames"] == 3 and facts["frames looked into"] == 3
    assert facts["cameras"] == ["16x9, intrinsics unknown"]
    assert facts["missing"] == ["source.reader.camera=[fx,fy,cx,cy]"]
    assert "images of 16x9, but intrinsics of" in facts["oddities"][0]
    assert "--set 'source.reader.camera=[fx,fy,cx,cy]' --out" in next_command(folder, facts, None)


def test_colour_of_a_larger_camera_is_brought_to_the_size_of_depth(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "sequence")
    left_red = np.zeros((5 * HEIGHT, 5 * WIDTH, 3), np.uint8)
    left_red[:, : 5 * WIDTH // 2, 2] = 255
    for image in (folder / "rgb").iterdir():
        assert cv2.imwrite(str(image), left_red)
    frame = check_reader(TumReader(), folder).frames[0]
    colour = frame.read_colour()
    assert colour.shape == (HEIGHT, WIDTH, 3)
    assert (colour[:, : WIDTH // 2, 0] == 255).all()
    assert (colour[:, WIDTH // 2 :] == 0).all()
    shown = cv2.imdecode(np.frombuffer(frame.encoded_colour().contents, np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == colour.shape, "the recording's camera is that of depth"
    assert (frame.image.width, frame.image.height) == (5 * WIDTH, 5 * HEIGHT), "the file itself is not changed"
    assert frame.image.params[0] == pytest.approx(50)


def test_scannets_folders_come_with_their_camera_and_poses(tmp_path: Path) -> None:
    poses = some_poses(3)
    for kind in ("color", "depth"):
        (tmp_path / kind).mkdir()
        for number in range(3):
            image = tmp_path / kind / f"{number}.png"
            write_depth(image, depth_values()) if kind == "depth" else cv2.imwrite(
                str(image), np.zeros((HEIGHT, WIDTH, 3), np.uint8)
            )
    (tmp_path / "pose").mkdir()
    for number in (0, 2):
        (tmp_path / "pose" / f"{number}.txt").write_text(pose_text(poses[number]))
    (tmp_path / "intrinsic").mkdir()
    (tmp_path / "intrinsic/intrinsic_depth.txt").write_text("10 0 4 0\n0 10 3 0\n0 0 1 0\n0 0 0 1\n")
    source = check_reader(IclNuimReader(), tmp_path)
    assert source.frames[0].camera == HALVED
    assert [frame.world_from_cam is not None for frame in source.frames] == [True, False, True]
    np.testing.assert_allclose(source.frames[2].world_from_cam, poses[2], atol=1e-6)
    assert source.frames[2].true_world_from_cam is None, "BundleFusion's poses, not the truth"
    assert IclNuimReader(camera=(1, 2, 3, 4)).open(tmp_path).frames[0].camera == Camera(WIDTH, HEIGHT, 1, 2, 3, 4)


def test_bundlefusions_folders_come_with_their_camera(tmp_path: Path) -> None:
    sequence = seven_scenes_sequence(tmp_path / "office")
    (sequence / "camera-intrinsics.txt").unlink()
    (sequence / "info.txt").write_text(
        f"m_versionNumber = 4\nm_sensorName = StructureSensor\nm_depthWidth = {WIDTH}\nm_depthHeight = {HEIGHT}\n"
        "m_calibrationDepthIntrinsic = 10 0 4 0 0 10 3 0 0 0 1 0 0 0 0 1 \nm_frames.size = 3\n"
    )
    assert SevenScenesReader().open(sequence).frames[0].camera == HALVED
    depth_m = SevenScenesReader(depth_scale=5000).open(sequence).frames[0].read_depth()
    np.testing.assert_allclose(depth_m, depth_values() / 5000, rtol=1e-6)

"""Colour of a camera beside the depth camera, brought onto the depth image's pixels."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from hodge_adapters.images.second_camera import colour_pixels
from hodge_adapters.seven_scenes.colour import kinect_colour_camera
from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera
from readers_data import seven_scenes_sequence

DEPTH_CAMERA = Camera(8, 6, 585.0, 585.0, 4.0, 3.0)


def test_a_camera_to_the_right_sees_things_further_left() -> None:
    """Of 525 pixels of focal length, 2.5 cm beside: 6.5625 pixels at 2 m, twice as many at 1 m."""
    depth = np.full((6, 8), 2.0, np.float32)
    depth[:, 4:] = 1.0
    columns, rows = colour_pixels(depth, DEPTH_CAMERA, kinect_colour_camera(DEPTH_CAMERA))
    wider = 525 / 585
    expected = 4 + wider * (np.arange(8) - 4) - np.repeat([6.5625, 13.125], 4)
    np.testing.assert_allclose(columns[2], expected, atol=1e-5)
    np.testing.assert_allclose(rows[:, 0], 3 + wider * (np.arange(6) - 3), atol=1e-5)


def test_pixels_without_depth_are_taken_for_the_median() -> None:
    depth = np.full((6, 8), 2.0, np.float32)
    depth[0, 0] = 0.0
    columns, _ = colour_pixels(depth, DEPTH_CAMERA, kinect_colour_camera(DEPTH_CAMERA))
    assert columns[0, 0] == pytest.approx(columns[1, 0])


def test_the_option_of_the_reader(tmp_path: Path) -> None:
    folder = seven_scenes_sequence(tmp_path / "seq-01")
    kinect = check_reader(SevenScenesReader(colour_camera="kinect"), folder)
    shown = cv2.imdecode(np.frombuffer(kinect.frames[0].encoded_colour().contents, np.uint8), cv2.IMREAD_COLOR)
    assert kinect.frames[0].read_colour().shape == shown.shape == (6, 8, 3)


def two_walls(folder: Path, seen_at: Callable[[int], int]) -> Path:
    """A dark board 1 m away before a bright wall at 2 m, whose sides the colour image shows at columns `seen_at` those
    of the depth image.
    """
    folder.mkdir(parents=True)
    for number in range(4):
        sides = 200 + 10 * number, 400
        depth = np.full((480, 640), 2000, np.uint16)
        depth[:, sides[0] : sides[1]] = 1000
        colour = np.full((480, 640, 3), 200, np.uint8)
        colour[:, seen_at(sides[0]) : seen_at(sides[1])] = 40
        cv2.imwrite(str(folder / f"frame-{number:06d}.depth.png"), depth)
        cv2.imwrite(str(folder / f"frame-{number:06d}.color.png"), colour)
    return folder


def test_edges_tell_where_colour_was_seen_from(tmp_path: Path) -> None:
    beside = two_walls(tmp_path / "a/seq-01", lambda u: round(525 / 585 * (u - 320) + 320 - 13.125))
    here = two_walls(tmp_path / "b/seq-01", lambda u: u)
    found, same = (SevenScenesReader().open(folder) for folder in (beside, here))
    assert any("colour is not registered to depth" in note for note in found.notes)
    assert not any("beside" in note for note in same.notes)
    depth, colour = found.frames[0].read_depth(), found.frames[0].read_colour()
    dark = colour[240, :, 0] < 120
    assert np.abs(np.flatnonzero(np.diff(dark)) - np.flatnonzero(np.diff(depth[240] < 1.5))).max() <= 8
    np.testing.assert_array_equal(same.frames[0].read_colour()[240, :, 0] < 120, same.frames[0].read_depth()[240] < 1.5)


def swaying(folder: Path, late: int, seen_at: Callable[[int], int]) -> SevenScenesReader:
    """A board that sways before a wall; colour is of `late` frames before, seen as of `two_walls`."""
    folder.mkdir(parents=True)
    for number in range(20):
        left, shown = (200 + round(70 * np.sin(0.5 * at) + 40 * np.sin(0.21 * at)) for at in (number, number - late))
        depth = np.full((480, 640), 2000, np.uint16)
        depth[:, left : left + 200] = 1000
        colour = np.full((480, 640, 3), 200, np.uint8)
        colour[:, seen_at(shown) : seen_at(shown + 200)] = 40
        cv2.imwrite(str(folder / f"frame-{number:06d}.depth.png"), depth)
        cv2.imwrite(str(folder / f"frame-{number:06d}.color.png"), colour)
    return SevenScenesReader()


@pytest.mark.parametrize(("late", "told"), [(0, ""), (1, "1 frame later"), (-3, "3 frames earlier"), (6, "")])
def test_colour_of_another_moment_is_paired_anew_before_it_is_drawn_on_depth(
    late: int, told: str, tmp_path: Path
) -> None:
    folder = tmp_path / "seq-01"
    source = swaying(folder, late, lambda u: round(525 / 585 * (u - 320) + 320 - 13.125)).open(folder)
    assert [(note.kind, note.count, note.detail) for note in source.doubts] == (
        [("colour paired anew", late, told)] if told else []
    ), "at 6, an end of those tried, it may be later still"
    if told:
        assert any("colour is not registered to depth" in note for note in source.notes)
        depth, colour = source.frames[8].read_depth(), source.frames[8].read_colour()
        dark = np.flatnonzero(np.diff(colour[240, :, 0] < 120))
        assert np.abs(dark - np.flatnonzero(np.diff(depth[240] < 1.5))).max() <= 8
        without = [row for row, frame in enumerate(source.frames) if frame.read_colour is None]
        assert without == [row for row in range(20) if not 0 <= row + late < 20]
    assert len(source.files) == 40


def test_colour_is_paired_anew_by_number_where_frames_have_no_depth(tmp_path: Path) -> None:
    folder = tmp_path / "seq-01"
    reader = swaying(folder, 1, lambda u: round(525 / 585 * (u - 320) + 320 - 13.125))
    for number in (4, 18):
        (folder / f"frame-{number:06d}.depth.png").unlink()
    source = reader.open(folder)
    assert [note.detail for note in source.doubts if note.kind == "colour paired anew"] == ["1 frame later"]
    for frame in source.frames[:-1]:
        assert frame.read_colour.args[0].name == f"frame-{frame.frame_id + 1:06d}.color.png"
    assert source.frames[-1].read_colour is None
    assert {f"frame-{number:06d}.color.png" for number in (4, 18)} <= {path.name for path in source.files}


def test_registered_colour_is_left_to_who_runs_the_sequence(tmp_path: Path) -> None:
    folder = tmp_path / "seq-01"
    assert swaying(folder, 2, lambda u: u).open(folder).doubts == ()


def test_depth_is_read_again_where_its_file_has_changed(tmp_path: Path) -> None:
    folder = two_walls(tmp_path / "seq-01", lambda u: u)
    frame = SevenScenesReader(colour_camera="kinect").open(folder).frames[0]
    before = frame.read_depth()
    before[:] = 0  # no one else's
    assert frame.read_depth().max() == pytest.approx(2)
    cv2.imwrite(str(folder / "frame-000000.depth.png"), np.full((480, 640), 3000, np.uint16))
    os.utime(folder / "frame-000000.depth.png", ns=(1, 1))
    assert frame.read_depth().max() == pytest.approx(3)


def edge_contrast(reader: SevenScenesReader, folder: Path) -> float:
    """The colour gradient at edges of the depth, over that of the whole image."""
    ratios = []
    for frame in reader.open(folder).frames[::50]:
        depth, colour = frame.read_depth(), frame.read_colour()
        grey = cv2.GaussianBlur(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1)
        gradient = np.hypot(cv2.Sobel(grey, -1, 1, 0), cv2.Sobel(grey, -1, 0, 1))
        gradient = np.minimum(gradient, np.percentile(gradient, 95))
        nearest, farthest = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
        inside = np.zeros(depth.shape, bool)
        inside[30:-30, 30:-30] = True
        edges = (farthest - nearest > 0.15) & (nearest > 0) & inside
        ratios.append(gradient[edges].mean() / gradient[inside].mean())
    return float(np.mean(ratios))


def test_colour_edges_fall_on_depth_edges_of_a_real_scene(data_dir: Path) -> None:
    folder = data_dir / "seven_scenes/redkitchen"
    same, kinect = (edge_contrast(SevenScenesReader(colour_camera=name), folder) for name in ("same", "kinect"))
    assert kinect > 1.2 * same

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.images.camera_files import resized
from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera
from readers_data import (
    HEIGHT,
    WIDTH,
    agreement,
    depth_values,
    pose_text,
    seven_scenes_sequence,
    some_poses,
    write_depth,
)

KINECT = Camera(640, 480, 585, 585, 320, 240)


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return seven_scenes_sequence(tmp_path / "seq-01")


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    for number in (1, 2, 3):
        seven_scenes_sequence(tmp_path / f"seq-{number:02d}", colour=".jpg")
    (tmp_path / "TrainSplit.txt").write_text("sequence1\r\nsequence3\r\n", newline="")
    (tmp_path / "TestSplit.txt").write_text("sequence2\r\n", newline="")
    (tmp_path / "camera-intrinsics.txt").write_text("10 0 4\n0 10 3\n0 0 1\n")
    return tmp_path


def test_the_contract(sequence: Path, scene: Path) -> None:
    for reader in (SevenScenesReader(), SevenScenesReader(every=2)):
        check_reader(reader, sequence)
        check_reader(reader, scene)


def test_frames_of_a_sequence(sequence: Path) -> None:
    source = SevenScenesReader().open(sequence)
    assert [(f.frame_id, f.stamp_s, f.sequence) for f in source.frames] == [(n, float(n), "seq-01") for n in range(3)]
    assert source.frames[0].camera == Camera(WIDTH, HEIGHT, 10, 10, 4, 3)
    assert source.notes == () and len(source.files) == 10
    np.testing.assert_allclose(source.frames[1].read_depth(), depth_values(1) / 1000, rtol=1e-6)
    np.testing.assert_array_equal(source.frames[1].read_colour()[0, 0], [200, 100, 50])
    np.testing.assert_allclose(source.frames[2].world_from_cam, some_poses(3)[2], atol=1e-6)
    np.testing.assert_array_equal(source.trajectory.world_from_cam[2], source.frames[2].world_from_cam)


def test_a_scene_and_its_splits(scene: Path) -> None:
    def ids(**options) -> list[str]:
        return [frame.frame_id for frame in SevenScenesReader(**options).open(scene).frames]

    assert len(ids()) == 9 and ids()[:2] == ["seq-01/000000", "seq-01/000001"]
    assert {name.split("/")[0] for name in ids(split="train")} == {"seq-01", "seq-03"}
    assert ids(split="test") == [0, 1, 2], "one sequence alone keeps its numbers"
    assert ids(split="train", sequences=("seq-03",)) == [0, 1, 2]
    assert SevenScenesReader(split="train", sequences=("seq-03",)).open(scene).notes == ()
    assert ids(every=2)[:3] == ["seq-01/000000", "seq-01/000002", "seq-02/000000"]
    assert SevenScenesReader().open(scene).trajectory is None
    assert len(SevenScenesReader(split="test").open(scene).trajectory) == 3


def test_sequences_that_are_not_there(scene: Path) -> None:
    some = SevenScenesReader(sequences=("seq-02", "seq-09")).open(scene)
    assert len(some.frames) == 3 and "not there: seq-09" in some.notes[0]
    with pytest.raises(SourceError, match="none of the sequences"):
        SevenScenesReader(sequences=("seq-09",)).open(scene)
    with pytest.raises(SourceError, match="`kitchen` is no sequence"):
        SevenScenesReader(sequences=("kitchen",)).open(scene)
    (scene / "TestSplit.txt").write_text("\n")
    with pytest.raises(SourceError, match="TestSplit.txt: lists no sequence"):
        SevenScenesReader(split="test").open(scene)
    (scene / "TestSplit.txt").write_text("sequence1\nkitchen\n")
    with pytest.raises(SourceError, match=r"TestSplit\.txt:2"):
        SevenScenesReader(split="test").open(scene)


def test_a_split_of_a_sequence_folder_is_refused(sequence: Path) -> None:
    with pytest.raises(SourceError, match="no sequences to choose from"):
        SevenScenesReader(split="train").open(sequence)


@pytest.mark.parametrize(
    "text",
    [
        pose_text(np.full((4, 4), np.nan)),
        pose_text(np.zeros((4, 4))),
        pose_text(np.diag([1.0, 1.0, -1.0, 1.0])),
        "-1.#IND 1.#QNAN\n" * 8,
        "1 0 0 0\n",
        "",
    ],
    ids=["nan", "singular", "mirrored", "windows nan", "short", "empty"],
)
def test_a_frame_without_a_usable_pose_is_kept_and_noted(sequence: Path, text: str) -> None:
    (sequence / "frame-000001.pose.txt").write_text(text)
    source = check_reader(SevenScenesReader(), sequence)
    assert [frame.world_from_cam is None for frame in source.frames] == [False, True, False]
    assert len(source.trajectory) == 2
    assert source.notes == ("1 frame without a usable pose (missing, not finite or not rigid): seq-01/000001",)


@pytest.mark.parametrize(
    ("identities", "lost"),
    [((2,), (2,)), ((0, 2, 3), (0, 2, 3)), ((4, 5), (4, 5)), ((0, 1), ()), ((5,), ()), (range(6), ())],
    ids=["between", "and at the first", "to the end", "first", "reversed", "all"],
)
def test_identities_amid_other_poses_are_none(tmp_path: Path, identities, lost) -> None:
    folder = seven_scenes_sequence(tmp_path / "seq-01", count=6)
    for row in identities:
        (folder / f"frame-{row:06d}.pose.txt").write_text(pose_text(np.eye(4)))
    source = SevenScenesReader().open(folder)
    assert tuple(row for row, frame in enumerate(source.frames) if frame.world_from_cam is None) == lost
    told = [note for note in source.notes if "identity" in note]
    assert len(told) == bool(lost) and all(note.startswith(f"{len(lost)} frame") for note in told)


def test_rotations_are_made_orthonormal(sequence: Path) -> None:
    pose = some_poses(3)[1]
    scaled = pose.copy()
    scaled[:3, :3] *= 0.9998
    (sequence / "frame-000001.pose.txt").write_text(pose_text(scaled))
    found = SevenScenesReader().open(sequence).frames[1].world_from_cam
    assert abs(np.linalg.det(found[:3, :3]) - 1) < 1e-12
    np.testing.assert_allclose(found, pose, atol=1e-6)


def test_frames_that_lack_an_image(sequence: Path) -> None:
    (sequence / "frame-000000.depth.png").unlink()
    (sequence / "frame-000002.color.png").unlink()
    source = check_reader(SevenScenesReader(), sequence)
    assert [(f.frame_id, f.read_colour is None) for f in source.frames] == [(1, False), (2, True)]
    assert "1 frame without a depth image left out: seq-01/000000" in source.notes
    assert "1 frame has no colour image: seq-01/000002" in source.notes
    assert [(note.kind, note.count, note.detail) for note in source.doubts] == [("images missing", 1, "3 depth images")]


def test_a_bad_image_is_found_on_reading_and_not_before(sequence: Path) -> None:
    damaged, odd = sequence / "frame-000000.depth.png", sequence / "frame-000001.depth.png"
    damaged.write_bytes(damaged.read_bytes()[:-20])
    write_depth(odd, depth_values(shape=(3, 4)))
    frames = SevenScenesReader().open(sequence).frames
    with pytest.raises(SourceError, match=damaged.name):
        frames[0].read_depth()
    with pytest.raises(SourceError, match=rf"{odd.name}.*4x3.*8x6"):
        frames[1].read_depth()
    assert frames[2].read_depth().shape == (HEIGHT, WIDTH)


def test_one_frame_without_any_depth_in_it(tmp_path: Path) -> None:
    sequence = seven_scenes_sequence(tmp_path / "seq-01", count=1)
    write_depth(sequence / "frame-000000.depth.png", np.full((HEIGHT, WIDTH), 65535, np.uint16))
    source = check_reader(SevenScenesReader(), sequence)
    assert len(source.frames) == 1 and not source.frames[0].read_depth().any()


def test_nothing_to_read_is_an_error_and_no_sniff(tmp_path: Path) -> None:
    (tmp_path / "scene/seq-01").mkdir(parents=True)
    (tmp_path / "file").write_text("frame-000000.depth.png")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("scene", "scene/seq-01", "file", "loop", "absent"):
        assert SevenScenesReader().sniff(tmp_path / name).confidence == 0
        with pytest.raises(SourceError, match=name):
            SevenScenesReader().open(tmp_path / name)


def test_a_link_back_to_the_scene_is_no_endless_walk(scene: Path) -> None:
    (scene / "seq-04").symlink_to(scene)
    (scene / "seq-05").symlink_to(scene / "seq-05")
    (scene / "seq-01" / "again").symlink_to(scene / "seq-01")
    assert len(SevenScenesReader().open(scene).frames) == 9


def test_intrinsics_by_option_and_the_published_ones(sequence: Path) -> None:
    given = SevenScenesReader(camera=(9, 8, 4, 3)).open(sequence).frames[0].camera
    assert given == Camera(WIDTH, HEIGHT, 9, 8, 4, 3)
    of_colour = (sequence / "camera-intrinsics.txt").rename(sequence / "camera-intrinsics.color.txt")
    assert SevenScenesReader().open(sequence).frames[0].camera != resized(KINECT, (WIDTH, HEIGHT))
    of_colour.unlink()
    source = SevenScenesReader().open(sequence)
    assert source.frames[0].camera == resized(KINECT, (WIDTH, HEIGHT))
    assert "585 585 320 240" in source.notes[0]
    with pytest.raises(SourceError, match="no pinhole camera"):
        SevenScenesReader(camera=(0, 8, 4, 3)).open(sequence)
    off = SevenScenesReader(camera=(585, 585, 320, 240)).open(sequence)
    assert any("principal point" in note for note in off.notes)


def test_red_kitchen_by_contract_and_convention(data_dir: Path) -> None:
    source = check_reader(SevenScenesReader(), data_dir / "seven_scenes/redkitchen")
    assert len(source.frames) == len(source.trajectory) == 250
    assert len(source.notes) == 1 and "colour is not registered to depth" in source.notes[0]
    assert source.frames[5].frame_id == 20
    first, later = source.frames[0], source.frames[5]
    right = se3.inverse(first.world_from_cam) @ later.world_from_cam
    wrong = first.world_from_cam @ se3.inverse(later.world_from_cam)
    assert agreement(first, later, right) > 0.8
    assert agreement(first, later, wrong) < 0.5 * agreement(first, later, right)


def test_the_original_layout(data_dir: Path) -> None:
    scene = data_dir / "seven_scenes/stairs_sample/stairs"
    source = check_reader(SevenScenesReader(split="train"), scene)
    assert {frame.sequence for frame in source.frames} == {"seq-02", "seq-03"}
    one = SevenScenesReader(sequences=("seq-01",)).open(scene).frames[0]
    np.testing.assert_allclose(one.world_from_cam[:3, 3], [-1.4903377, -0.49737796, -0.054694783])
    depth = one.read_depth()
    assert depth[depth > 0].min() > 0 and depth.max() < 10, "65535 is no depth of 65 m"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_folder_that_may_not_be_read(sequence: Path) -> None:
    sequence.chmod(0)
    try:
        with pytest.raises(SourceError, match="seq-01"):
            SevenScenesReader().open(sequence)
    finally:
        sequence.chmod(0o755)


def test_sequences_that_are_still_packed_are_named(scene: Path, tmp_path: Path) -> None:
    for name in ("seq-03.zip", "seq-05.zip"):
        (scene / name).write_bytes(b"PK")
    notes = SevenScenesReader().open(scene).notes
    assert "sequences that are still packed left out: seq-05.zip" in notes, "seq-03 lies unpacked beside its archive"
    assert not any("packed" in note for note in SevenScenesReader(split="test").open(scene).notes)
    asked = SevenScenesReader(sequences=("seq-01", "seq-05")).open(scene).notes
    assert [note for note in asked if "seq-05" in note] == ["sequences that are still packed left out: seq-05.zip"]


def test_a_scene_as_it_is_downloaded(tmp_path: Path) -> None:
    (tmp_path / "seq-01.zip").write_bytes(b"PK")
    assert SevenScenesReader().sniff(tmp_path).advice == "its sequences are packed: unpack seq-01.zip in it"
    with pytest.raises(SourceError, match=r"packed: unpack seq-01\.zip"):
        SevenScenesReader().open(tmp_path)

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.images.camera_files import resized
from hodge_adapters.tum import reader
from hodge_adapters.tum.image_lists import StampedImages, read_pairs
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.start.key_frames import is_video
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Source
from readers_data import HEIGHT, WIDTH, agreement, depth_values, linked, some_poses, tum_folder, tum_line, write_depth


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tum_folder(tmp_path / "sequence")


def colour_names(source: Source) -> list[str | None]:
    return [frame.read_colour.args[0].name if frame.read_colour else None for frame in source.frames]


def test_the_contract(folder: Path) -> None:
    poses = some_poses(30)
    truth = "".join(tum_line(9.9 + 0.05 * row, pose) for row, pose in enumerate(poses))
    (folder / "groundtruth.txt").write_text("# truth\n" + truth)
    source = check_reader(TumReader(), folder)
    assert len(source.trajectory) == 30
    check_reader(TumReader(every=2), folder)


def test_frames_of_a_folder(folder: Path) -> None:
    source = TumReader(no_depth=(0, 65535)).open(folder)
    assert [(f.frame_id, f.stamp_s) for f in source.frames] == [(0, 10.0), (1, 10.5), (2, 11.25)]
    assert colour_names(source) == ["10.010000.png", "10.510000.png", "11.260000.png"]
    assert source.frames[0].camera == Camera(WIDTH, HEIGHT, 10, 10, 4, 3)
    assert source.frames[0].read_depth().max() < 0.8, "5000 units a metre"
    assert TumReader(depth_scale=1000).open(folder).frames[0].read_depth().max() > 3
    assert source.notes == ("intrinsics from intrinsics.txt", "no ground truth")


@pytest.mark.parametrize("lists", [("depth.txt",), ("rgb.txt",), ("depth.txt", "rgb.txt")])
def test_lists_that_are_missing_are_made_from_the_names_of_the_images(folder: Path, lists: tuple[str, ...]) -> None:
    expected = TumReader().open(folder)
    for name in lists:
        (folder / name).unlink()
    assert TumReader().sniff(folder).confidence >= 0.5
    assert guess_reader(folder).__class__.__name__ == "TumReader"
    source = TumReader().open(folder)
    assert [frame.stamp_s for frame in source.frames] == [frame.stamp_s for frame in expected.frames]
    assert colour_names(source) == colour_names(expected)
    assert all(any(f"no {name}: the stamps of" in note for note in source.notes) for name in lists)


def test_a_truth_alone_says_what_else_is_needed(tmp_path: Path) -> None:
    (tmp_path / "groundtruth.txt").write_text(tum_line(1.0, some_poses(1)[0]))
    with pytest.raises(SourceError, match=r"no depth\.txt.*unpack the whole sequence"):
        guess_reader(tmp_path).open(tmp_path)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.3),
        ("rgbd_dataset_freiburg2_xyz", 520.9),
        ("fr3_office", 535.4),
        ("office", 525.0),
        ("afr1ca", 525.0),
    ],
)
def test_the_camera_by_the_folder_name(folder: Path, name: str, expected: float) -> None:
    (folder / "intrinsics.txt").unlink()
    renamed = folder.rename(folder.with_name(name))
    source = TumReader().open(renamed)
    assert source.frames[0].camera.fx == pytest.approx(expected * WIDTH / 640)
    assert any("intrinsics " in note and " taken" in note for note in source.notes)


def test_the_camera_by_option(folder: Path) -> None:
    fr2 = resized(Camera(640, 480, 520.9, 521.0, 325.1, 249.7), (WIDTH, HEIGHT))
    assert TumReader(camera="fr2").open(folder).frames[0].camera == fr2
    assert TumReader(camera=(9, 8, 4, 3)).open(folder).frames[0].camera == Camera(WIDTH, HEIGHT, 9, 8, 4, 3)
    (folder / "mine.yaml").write_text(
        "Camera.fx: 7.5\nCamera.fy: 7.5\nCamera.cx: 4\nCamera.cy: 3\nDepthMapFactor: 1000.0\n"
    )
    source = TumReader(camera="mine.yaml").open(folder)
    assert source.frames[0].camera.fx == 7.5 and source.frames[0].read_depth().max() > 1
    with pytest.raises(SourceError, match=r"gone\.yaml"):
        TumReader(camera="gone.yaml").open(folder)


@pytest.mark.parametrize("depth_first", [True, False])
def test_association_files_in_both_orders(folder: Path, depth_first: bool) -> None:
    lines = []
    for stamp_s in (11.25, 10.0):
        depth = f"{stamp_s:.6f} depth/{stamp_s:.6f}.png"
        colour = f"{stamp_s + 0.01:.6f} rgb/{stamp_s + 0.01:.6f}.png"
        lines.append(f"{depth} {colour}\n" if depth_first else f"{colour} {depth}\n")
    (folder / "associations.txt").write_text("".join(lines))
    source = check_reader(TumReader(), folder)
    assert [frame.stamp_s for frame in source.frames] == [10.0, 11.25], "the depth image's stamp, in order"
    assert colour_names(source) == ["10.010000.png", "11.260000.png"]
    assert any("not in order" in note for note in source.notes)


def stamped_lists(folder: Path, stamps_s: list[float]) -> StampedImages:
    """The pairs of numbered images, colour 5 ms after depth, listed in this order, and the notes."""
    for kind, delay_s in (("depth", 0.0), ("rgb", 0.005)):
        (folder / kind).mkdir(parents=True)
        lines = [f"{stamp_s + delay_s:.6f} {kind}/{number}.png\n" for number, stamp_s in enumerate(stamps_s)]
        (folder / f"{kind}.txt").write_text("".join(lines))
        for number in range(len(stamps_s)):
            (folder / kind / f"{number}.png").write_text(str(number))
    return read_pairs(folder, 0.02, [])


def test_frames_of_a_clock_that_jumps_back_stay_in_the_order_of_the_file(tmp_path: Path) -> None:
    """Sorted by their stamps those before and after would be interleaved, and half of them have the other's colour."""
    stamps_s = [100 + number / 30 - 0.4 * (number >= 20) for number in range(40)]
    found = stamped_lists(tmp_path / "jump", stamps_s)
    assert [path.stem for path in found.depth] == [str(number) for number in range(40)]
    assert [path and path.stem for path in found.colour] == [path.stem for path in found.depth]
    assert found.runs.tolist() == [0] * 20 + [1] * 20
    swapped = [*stamps_s[:5], stamps_s[6], stamps_s[5], *stamps_s[7:20]]
    assert np.array_equal(stamped_lists(tmp_path / "swapped", swapped).stamps_s, np.round(sorted(swapped), 6))
    shuffled = np.random.default_rng(0).permutation(stamps_s[:20]).tolist()
    assert np.array_equal(stamped_lists(tmp_path / "shuffled", shuffled).stamps_s, np.round(sorted(shuffled), 6))


def test_the_truth_is_not_taken_where_the_clock_jumped_back(folder: Path) -> None:
    depth = (folder / "depth.txt").read_text().splitlines()
    stamps = [float(line.split()[0]) for line in depth if not line.startswith("#")]
    files = [line.split()[1] for line in depth if not line.startswith("#")]
    again = [(stamp, name) for _ in range(20) for stamp, name in zip(stamps, files, strict=True)]
    again = [(100 + row / 30 - 0.5 * (row >= 20), name) for row, (_, name) in enumerate(again)][:40]
    (folder / "depth.txt").write_text("".join(f"{stamp:.6f} {name}\n" for stamp, name in again))
    truth = [tum_line(100 + row / 30, np.eye(4)) for row in range(40)]
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    source = TumReader().open(folder)
    assert [frame.true_world_from_cam is not None for frame in source.frames] == [True] * 20 + [False] * 20
    assert any("the clock jumps back before image 20:" in note for note in source.notes)
    assert any("before the clock jumps back alone" in note for note in source.notes)


def test_an_association_file_that_does_not_say_which_is_depth(folder: Path) -> None:
    (folder / "associations.txt").write_text("1 a/1.png 1 b/1.png\n")
    with pytest.raises(SourceError, match=r"associations\.txt:1: neither or both"):
        TumReader().open(folder)


def test_stamps_and_names_that_no_clock_and_no_system_knows_are_left_out(folder: Path) -> None:
    whole = len(TumReader().open(folder).frames)
    with open(folder / "depth.txt", "a") as file:
        file.write(f"1e308 depth/1.png\n99999999999999999999 depth/1.png\n12.0 {'a' * 300}.png\n13.0 {'a/' * 5000}\n")
    with open(folder / "groundtruth.txt", "a") as file:
        file.write(tum_line(1.0, np.eye(4)) + "1e308 0 0 0 0 0 0 1\n")
    source = check_reader(TumReader(), folder)
    assert len(source.frames) == whole
    assert "depth.txt: 2 lines that are not `stamp file` left out: 5, 6" in source.notes
    assert "depth.txt: 2 lines that name no file in the folder left out: 7, 8" in source.notes
    assert any(note.startswith("groundtruth.txt: 1 line that is no pose left out") for note in source.notes)


def test_bad_lines_are_left_out_and_noted(folder: Path) -> None:
    with open(folder / "depth.txt", "a") as file:
        file.write("abc depth/1.png\n12.0\nnan depth/1.png\n10.0 depth/10.500000.png\n")
        file.write("13 ../secret.png\n14 /etc/secret.png\n15 depth/../../secret.png\n16 depth/gone.png\n")
    source = check_reader(TumReader(), folder)
    assert len(source.frames) == 3
    assert "depth.txt: 3 lines that are not `stamp file` left out: 5, 6, 7" in source.notes
    assert "depth.txt: 3 lines that name no file in the folder left out: 9, 10, 11" in source.notes
    assert "depth.txt: 1 line with the stamp of an earlier one left out" in source.notes
    assert "1 depth images listed but not there left out: gone.png" in source.notes
    assert str(source.doubts[0]).startswith("1 of 4 listed depth images are missing: ")
    assert not any("secret" in str(file) for file in source.files)


def test_lists_with_semicolons_are_read_as_those_with_blanks(folder: Path) -> None:
    expected = TumReader().open(folder)
    for name in ("depth.txt", "rgb.txt"):
        (folder / name).write_text((folder / name).read_text().replace(" ", ";"))
    found = TumReader().open(folder)
    assert [frame.stamp_s for frame in found.frames] == [frame.stamp_s for frame in expected.frames]
    assert colour_names(found) == colour_names(expected)


def test_names_with_blanks_and_in_quotes(folder: Path) -> None:
    for name, own, other in (("rgb", "rgb/", "my rgb/"), ("depth", " depth/", ' "depth/')):
        text = (folder / f"{name}.txt").read_text().replace(own, other)
        (folder / f"{name}.txt").write_text(text.replace(".png", '.png"') if name == "depth" else text)
    (folder / "rgb").rename(folder / "my rgb")
    frames = TumReader().open(folder).frames
    assert len(frames) == 3
    assert all(frame.read_colour is not None for frame in frames)


def test_an_association_of_absolute_paths(folder: Path) -> None:
    lines = [
        f"{depth.stem} {depth} {rgb.stem} {rgb}\n"
        for depth, rgb in zip(*(sorted((folder / kind).iterdir()) for kind in ("depth", "rgb")), strict=True)
    ]
    (folder / "associations.txt").write_text("".join(lines))
    assert len(TumReader().open(folder).frames) == 3


def test_an_association_may_not_leave_the_folder(folder: Path) -> None:
    (folder / "associations.txt").write_text("1 ../depth/1.png 1 rgb/1.png\n")
    with pytest.raises(SourceError, match=r"associations\.txt: no line .* 1 line that name no file in the folder"):
        TumReader().open(folder)


def test_colour_that_is_absent_or_too_late(folder: Path) -> None:
    (folder / "rgb/10.510000.png").unlink()
    source = check_reader(TumReader(), folder)
    assert colour_names(source) == ["10.010000.png", None, "11.260000.png"]
    assert "1 colour images listed but not there: 10.510000.png" in source.notes
    assert [str(doubt) for doubt in source.doubts[:1]] == [
        "1 of 3 listed colour images are missing: unpack or copy the whole sequence"
    ]
    source = TumReader(max_difference_s=0.005).open(folder)
    assert colour_names(source) == [None] * 3
    assert [note.kind for note in source.doubts][-1:] == ["colour unpaired"]
    assert (
        "3 of 3 depth images have no colour image within 0.005 s, the nearest is 0.01 s away: set max_difference_s, or "
        "are they of two clocks?"
    ) in source.notes
    assert any("colour images have no depth image within 0.005 s" in note for note in source.notes)
    (folder / "rgb.txt").unlink()
    (folder / "rgb").rename(folder / "elsewhere")
    assert "no rgb.txt: frames have no colour" in TumReader().open(folder).notes


@pytest.mark.parametrize("contents", ["", "# only a comment\n", "x y\n"])
def test_a_list_without_images_is_an_error(folder: Path, contents: str) -> None:
    (folder / "depth.txt").write_text(contents)
    with pytest.raises(SourceError, match=r"depth\.txt: no line"):
        TumReader().open(folder)


def test_what_is_no_tum_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "empty").mkdir()
    for name in ("file", "loop", "empty", "absent"):
        assert TumReader().sniff(tmp_path / name).confidence == 0
        with pytest.raises(SourceError, match=name):
            TumReader().open(tmp_path / name)


def test_truth_is_interpolated_only_between_near_neighbours(folder: Path) -> None:
    a, b = some_poses(2)
    (folder / "groundtruth.txt").write_text(
        tum_line(9.98, a) + "9.99 bad line\n" + tum_line(10.06, b) + tum_line(10.5, a) + tum_line(11.0, b)
    )
    source = check_reader(TumReader(), folder)
    quarter, exact, none = (frame.world_from_cam for frame in source.frames)
    np.testing.assert_allclose(quarter, se3.interpolate(a, b, np.array(0.25)), atol=1e-6)
    np.testing.assert_allclose(exact, a, atol=1e-6)
    assert none is None
    assert "1 of 3 frames have no truth within 0.1 s" in source.notes
    assert "groundtruth.txt: 1 line that is no pose left out: 2" in source.notes


def test_truth_by_row(folder: Path) -> None:
    (folder / "truth.txt").write_text("".join(tum_line(100.0 + row, pose) for row, pose in enumerate(some_poses(3))))
    by_stamp = TumReader(truth="truth.txt").open(folder)
    assert any("another clock" in note for note in by_stamp.notes)
    by_row = check_reader(TumReader(truth="truth.txt", truth_match="row"), folder)
    np.testing.assert_allclose(by_row.frames[2].world_from_cam, some_poses(3)[2], atol=1e-6)
    assert by_row.trajectory.stamps_s.tolist() == [10.0, 10.5, 11.25]
    (folder / "truth.txt").write_text(tum_line(1.0, np.eye(4)))
    with pytest.raises(SourceError, match="1 pose for 3 frames"):
        TumReader(truth="truth.txt", truth_match="row").open(folder)
    with pytest.raises(SourceError, match=r"gone\.txt"):
        TumReader(truth="gone.txt").open(folder)


@pytest.mark.parametrize(
    ("depth", "colour", "delay_s"),
    [
        ("aabbccdd", "AABBCCDD", 0.01),  # the copies of each lie nearer to the other's neighbours than its own
        ("aaaaaaaa", "ABCDEFGH", 0.005),  # empty depth
        ("abcdefgh", "AAAAAAAA", 0.005),  # at rest, without noise of colour
    ],
)
def test_copies_are_paired_by_the_stamp_of_the_first(tmp_path: Path, depth: str, colour: str, delay_s: float) -> None:
    for kind, contents, later_s in (("depth", depth, 0.0), ("rgb", colour, delay_s)):
        (tmp_path / kind).mkdir()
        lines = []
        for number, content in enumerate(contents):
            (tmp_path / kind / f"{number}.png").write_text(content)
            lines.append(f"{100 + number / 60 + later_s:.6f} {kind}/{number}.png\n")
        (tmp_path / f"{kind}.txt").write_text("".join(lines))
    found = read_pairs(tmp_path, 0.02, notes := [])
    assert [path and path.read_text() for path in found.colour] == list(colour)
    assert np.allclose(found.colour_delays_s, delay_s, atol=1e-5) and notes == []


def test_the_largest_value_is_no_depth(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "folder")
    values = depth_values()
    values[0, 0] = 65535
    depth = next(iter(sorted((folder / "depth").iterdir())))
    write_depth(depth, values)
    frame = TumReader().open(folder).frames[0]
    assert frame.read_depth is not None and frame.read_depth()[0, 0] == 0 and frame.read_depth().max() < 13


def test_fr1_by_contract_and_convention(data_dir: Path) -> None:
    source = check_reader(TumReader(), data_dir / "tum/fr1_rpy_part")
    assert len(source.frames) == 60 and len(source.trajectory) == 2742
    assert all(frame.world_from_cam is not None and frame.read_colour is not None for frame in source.frames)
    assert source.frames[0].stamp_s == 1305031229.528784 and source.frames[0].camera.fx == 517.3
    first, later = source.frames[0], source.frames[3]
    right = se3.inverse(first.world_from_cam) @ later.world_from_cam
    wrong = first.world_from_cam @ se3.inverse(later.world_from_cam)
    assert agreement(first, later, right) > 5 * agreement(first, later, wrong)


def test_frame_numbers_for_stamps(data_dir: Path) -> None:
    reader = TumReader(truth="truth_cam_poses.txt", truth_match="row")
    source = check_reader(reader, data_dir / "tum/fr3_cabinet_58keyframes")
    assert [frame.frame_id for frame in source.frames] == list(range(58))
    assert source.frames[0].camera == Camera(640, 480, 535.4, 539.2, 320.1, 247.6)
    np.testing.assert_allclose(source.frames[1].world_from_cam[:3, 3], [-2.4691, 1.0757, 1.0996])


def test_lists_of_numbers_take_the_stamps_in_the_names_of_the_images(tmp_path: Path) -> None:
    folder = tum_folder(tmp_path / "sequence", tuple(10 + row / 15 for row in range(6)))
    stamped = TumReader().open(folder)
    for name in ("depth.txt", "rgb.txt"):
        files = [line.split()[1] for line in (folder / name).read_text().splitlines() if line[0] != "#"]
        (folder / name).write_text("".join(f"{row} {file}\n" for row, file in enumerate(files)))
    source = TumReader().open(folder)
    assert [frame.stamp_s for frame in source.frames] == [frame.stamp_s for frame in stamped.frames]
    assert [frame.colour_delay_s for frame in source.frames] == [frame.colour_delay_s for frame in stamped.frames]
    assert is_video(source)
    assert all(
        f"{name}.txt: it holds numbers, so stamps are those in the images' names" in source.notes
        for name in ("depth", "rgb")
    )


@pytest.mark.parametrize("name", ["fr1_rpy_part", "rgbd_dataset_freiburg1_xyz_60"])
def test_a_renamed_folder_is_known_by_its_stamps(name: str, data_dir: Path, tmp_path: Path) -> None:
    for folder in (mine := tmp_path / "mine", other := tmp_path / "freiburg3"):
        folder.mkdir()
        linked(data_dir / "tum" / name, folder)
    source = TumReader().open(mine)
    assert source.frames[0].camera.fx == 517.3
    assert any("intrinsics of fr1 taken: by the day of the stamps" in note for note in source.notes)
    (doubt,) = map(str, TumReader().open(other).doubts)
    assert doubt.startswith("the folder's name says fr3, but the day of the stamps, 2011-05-10, is fr1's: set source.")


@pytest.mark.parametrize("name", ["fr1_rpy_part", "rgbd_dataset_freiburg1_xyz_60"])
def test_two_cameras_that_images_do_not_tell_apart_are_a_doubt_that_names_both(
    name: str, data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "RECORDED_ON", dict.fromkeys(reader.RECORDED_ON, set()))
    source = TumReader().open(linked(data_dir / "tum" / name, tmp_path))
    (note,) = (note for note in source.notes if "tried on the images" in note)
    taken, other = ("fr1", "fr2") if "of fr1 taken" in note else ("fr2", "fr1")
    (doubt,) = map(str, source.doubts)
    assert f"of {taken} taken" in note
    assert doubt.startswith(f"the camera may be {other} in place of {taken}: set source.reader.camera={other} if")


@pytest.mark.parametrize("listed", ["lists", "association"])
def test_stamps_in_nanoseconds(tmp_path: Path, listed: str) -> None:
    folder = tum_folder(tmp_path / "sequence")
    rows = {}
    for name in ("depth", "rgb"):
        lines = [line.split() for line in (folder / f"{name}.txt").read_text().splitlines() if line[0] != "#"]
        rows[name] = [f"{1_700_000_000_000_000_000 + round(float(stamp) * 1e9)} {file}" for stamp, file in lines]
        (folder / f"{name}.txt").write_text("\n".join(rows[name]) + "\n")
    if listed == "association":
        lines = [" ".join(pair) for pair in zip(rows["depth"], rows["rgb"], strict=True)]
        (folder / "associations.txt").write_text("\n".join(lines) + "\n")
    source = TumReader().open(folder)
    np.testing.assert_allclose([frame.stamp_s - 1.7e9 for frame in source.frames], [10.0, 10.5, 11.25], atol=1e-6)
    assert [frame.colour_delay_s for frame in source.frames] == pytest.approx([0.01] * 3, abs=1e-6)
    assert any("read as nanoseconds" in note for note in source.notes)

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.trajectories.readers import KittiPosesReader, TumPosesReader
from hodge_adapters.trajectories.rewriting import TumRewriter
from hodge_adapters.trajectories.text import parse_tum, read_kitti, write_kitti, write_tum
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.stages import FrameReader
from hodge_pipeline.types import Trajectory

IDENTITY = "0 0 0 0 0 0 1"


def trajectory(count: int, seed: int, start_s: float = 1305031229.528784) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamps = start_s + np.cumsum(rng.uniform(0.01, 0.1, count))
    return Trajectory(stamps, se3.exp(rng.normal(0, 1.0, (count, 6)) * [1, 1, 1, 100, 100, 100]))


@given(seed=st.integers(0, 1000), count=st.integers(1, 20))
@settings(max_examples=20, deadline=None)
def test_what_is_written_reads_back(tmp_path_factory: pytest.TempPathFactory, seed: int, count: int) -> None:
    folder, written = tmp_path_factory.mktemp("poses"), trajectory(count, seed)
    write_tum(folder / "poses.tum", written)
    back = parse_tum(folder / "poses.tum").trajectory
    np.testing.assert_array_equal(back.stamps_s, written.stamps_s)
    np.testing.assert_array_equal(back.world_from_cam[:, :3, 3], written.world_from_cam[:, :3, 3])
    np.testing.assert_allclose(back.world_from_cam, written.world_from_cam, atol=1e-14)
    write_kitti(folder / "poses.kitti", written)
    np.testing.assert_allclose(read_kitti(folder / "poses.kitti").world_from_cam, written.world_from_cam, atol=1e-14)
    assert [path.name for path in sorted(folder.iterdir())] == ["poses.kitti", "poses.tum"], "no temporary file is left"


@pytest.mark.parametrize(("unit", "per_second"), [("nano", 10**9), ("micro", 10**6), ("milli", 10**3)])
def test_stamps_too_large_for_seconds_are_read_in_their_unit(tmp_path: Path, unit: str, per_second: int) -> None:
    path, stamps = tmp_path / "poses.txt", [1305031229, 1305031231]
    path.write_text("".join(f"{stamp * per_second} {IDENTITY}\n" for stamp in stamps))
    read = parse_tum(path)
    assert read.trajectory.stamps_s.tolist() == stamps
    assert read.notes == (f"poses.txt: stamps are read as {unit}seconds, too large for seconds",)
    (tmp_path / "out").mkdir()
    moved = Trajectory(read.trajectory.stamps_s, np.tile(se3.exp([0.0, 0, 0, 1, 2, 3]), (2, 1, 1)))
    lines = TumRewriter().rewrite(tmp_path / "out", path, moved).read_text().splitlines()
    assert [line.split()[:2] for line in lines] == [[str(stamp * per_second), "1.0"] for stamp in stamps]


@pytest.mark.parametrize(
    ("reader", "row"),
    [
        (TumPosesReader(), "1 0,5 1 1 0 0 0 1"),  # cut at each comma it reads as a pose with a node's number behind
        (TumPosesReader(), "1,5;0,1;0,2;0,3;0;0;0;1"),
        (KittiPosesReader(), "1 0 0 0,5 0 1 0 0 0 0 1 2"),
    ],
)
def test_decimal_commas_are_told_with_what_writes_points(tmp_path: Path, reader: FrameReader, row: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"# a head, with a comma\n{row}\n")
    for refused in (reader.open, guess_reader):
        with pytest.raises(SourceError, match=r"poses.txt: its numbers have decimal commas: write points, by tr ',;' "):
            refused(path)
    path.write_text(row.replace(",", ".").replace(";", " "))
    assert len(guess_reader(path).open(path).trajectory) == 1


@pytest.mark.parametrize("separator", [";", "; ", " ;\t"])
def test_semicolons_separate_numbers_and_stay(tmp_path: Path, separator: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("# a head; with one\n" + separator.join(["5.5", "1", "2", "3", "0", "0", "0", "1"]) + "\n")
    read = guess_reader(path).open(path).trajectory
    assert read.stamps_s.tolist() == [5.5] and read.world_from_cam[0, :3, 3].tolist() == [1, 2, 3]
    (tmp_path / "out").mkdir()
    line = TumRewriter().rewrite(tmp_path / "out", path, read).read_text().splitlines()[1]
    assert line == separator.join(["5.5", "1.0", "2.0", "3.0", "0.0", "0.0", "0.0", "1.0"])


@pytest.mark.parametrize(
    "head", ["# timestamp tx ty tz qw qx qy qz", "time,x,y,z,q_w,q_x,q_y,q_z", "# t q_RS_w q_RS_x"]
)
def test_a_head_that_names_w_first_is_followed_and_written_again(tmp_path: Path, head: str) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"{head}\n5.5 1 2 3 0.6 0 0 0.8\n")
    read = parse_tum(path)
    np.testing.assert_allclose(se3.to_quat_xyzw(read.trajectory.world_from_cam), [[0, 0, 0.8, 0.6]], atol=1e-15)
    assert "poses.txt: quaternions are read with w first, as its head names them" in read.notes
    (tmp_path / "out").mkdir()
    line = TumRewriter().rewrite(tmp_path / "out", path, read.trajectory).read_text().splitlines()[1]
    np.testing.assert_allclose([float(word) for word in line.split()], [5.5, 1, 2, 3, 0.6, 0, 0, 0.8], atol=1e-15)


def test_a_quarter_turn_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("# comment\r\n5.5, 1 2 3\t0 0 0.70710678118654752 0.70710678118654752\r\n\r\n")
    found = parse_tum(path).trajectory
    expected = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(found.world_from_cam, [expected], atol=1e-15)
    assert found.stamps_s.tolist() == [5.5]


@pytest.mark.parametrize(
    "line",
    [
        "1 0 0 0 0 0 0 0",
        "1 0 0 0 0 0 1",
        "x 0 0 0 0 0 0 1",
        "nan 0 0 0 0 0 0 1",
        "1 inf 0 0 0 0 0 1",
        "1 1 1",
        "1 1e308 0 0 0 0 0 1",
    ],
)
def test_a_line_that_is_no_pose_is_named_or_noted(tmp_path: Path, line: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"# header\n0 {IDENTITY}\n{line}\n2 {IDENTITY}\n")
    parsed = parse_tum(path)
    assert parsed.trajectory.stamps_s.tolist() == [0, 2]
    assert parsed.notes == ("a.tum: 1 line that is no pose left out: 3",)
    path.write_text(line)
    with pytest.raises(SourceError, match=r"a\.tum:1: "):
        parse_tum(path)


def test_a_table_of_other_columns_is_told_how_many_it_has(tmp_path: Path) -> None:
    """The first 80 characters of a line look like a pose where covariances follow it."""
    (tmp_path / "a.tum").write_text(
        "1305031102.160407 1.344379 0.627206 1.661754 0.658249 0.611043 -0.294444 -0.3265 1 2\n"
    )
    with pytest.raises(SourceError, match="of 10 columns is no pose: expected stamp tx"):
        parse_tum(tmp_path / "a.tum")


def test_unsorted_and_repeated_stamps_are_put_in_order_and_noted(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("2 2 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n2 9 0 0 0 0 0 1\n")
    parsed = parse_tum(path)
    assert parsed.trajectory.world_from_cam[:, 0, 3].tolist() == [1, 2], "of equal stamps the first is kept"
    assert len(parsed.notes) == 2


@pytest.mark.parametrize("reader", [parse_tum, read_kitti])
def test_an_empty_or_missing_or_binary_file_is_an_error(tmp_path: Path, reader) -> None:
    path = tmp_path / "a.txt"
    with pytest.raises(SourceError, match=r"a\.txt: cannot be read"):
        reader(path)
    for contents in (b"", b"# only a comment\n", b"\x89PNG\r\n\x1a\n\x00\xff"):
        path.write_bytes(contents)
        with pytest.raises(SourceError, match=r"a\.txt"):
            reader(path)


@pytest.mark.parametrize("row", ["{0} 100.{0} 1 2 3 0 0 0 1", "100.{0} 1 2 3 40 50 60 70"])
def test_columns_that_hold_no_quaternion_are_refused(tmp_path: Path, row: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text("".join(row.format(k) + "\n" for k in range(3)))
    with pytest.raises(SourceError, match=r"a\.tum: no quaternion has a length near 1"):
        parse_tum(path)


def test_two_paths_in_one_file_are_refused(tmp_path: Path) -> None:
    """Every second pose was left out, and those of a refined file got the poses of the first session."""
    path = tmp_path / "two.tum"
    one = [f"{k / 10} {k / 10} 0 0 0 0 0 1" for k in range(30)]
    other = [f"{k / 10} {k / 10} 5 0 0 0 0 1" for k in range(30)]
    for rows in (one + other, [row for pair in zip(one, other, strict=True) for row in pair], one + other[:8]):
        path.write_text("\n".join(rows))
        with pytest.raises(
            SourceError, match=r"two\.tum: \d+ poses have the stamp of an earlier one and lie elsewhere"
        ):
            parse_tum(path)
    rounded = [f"{k // 4} {k / 10} 0 0 0 0 0 1" for k in range(30)]
    still = [f"{k / 10} 1 2 3 0 0 0 1" for k in range(30)]
    for rows, left in (
        (one + one, 30),
        (one + other[:2], 30),
        (one[:3] + other[:1], 3),
        (rounded, 8),
        (still + still, 30),
    ):
        path.write_text("\n".join(rows))
        assert len(parse_tum(path).trajectory) == left


@pytest.mark.parametrize(
    "text", [f"0 {IDENTITY}", "stamp tx ty tz qx qy qz qw\n" + f"0 {IDENTITY}\n", f"1 {IDENTITY}\n2"]
)
def test_few_lines_are_a_trajectory_too(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    reader = guess_reader(tmp_path / "a.txt")
    assert isinstance(reader, TumPosesReader)
    assert reader.open(tmp_path / "a.txt").trajectory.stamps_s.tolist() == [float(text.endswith("2"))]


def test_kitti_refuses_what_is_no_rigid_motion(tmp_path: Path) -> None:
    path = tmp_path / "00.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SourceError, match=r"00\.txt:2: not a rigid motion"):
        read_kitti(path)
    path.write_text("1 0 0 1e308 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SourceError, match=r"00\.txt:1: not a rigid motion"):
        read_kitti(path)


def test_kitti_times_must_fit(tmp_path: Path) -> None:
    poses, times = tmp_path / "00.txt", tmp_path / "times.txt"
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    times.write_text("0.0\n0.1\n")
    assert read_kitti(poses, times).stamps_s.tolist() == [0.0, 0.1]
    times.write_text("0.1\n0.0\n")
    with pytest.raises(SourceError, match="times.txt"):
        read_kitti(poses, times)


def test_real_trajectories(data_dir: Path) -> None:
    folder = data_dir / "trajectories/evo"
    truth = parse_tum(folder / "fr2_desk_groundtruth.txt")
    assert len(truth.trajectory) == 20956 and "stamp of an earlier one" in truth.notes[0]
    assert len(read_kitti(folder / "KITTI_00_gt.txt", folder / "KITTI_00_gt_times.txt")) == 4541
    assert len(parse_tum(folder / "freiburg1_xyz-rgbdslam.txt").trajectory) == 788

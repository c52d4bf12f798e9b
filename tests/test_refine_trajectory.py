"""`hodge refine trajectory` on a small rendered sequence: formats, guard, sparse poses, bad input."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from hodge_adapters.trajectories.text import parse_tum, write_tum
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.cli.main import app, main
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.evaluation.trajectory import absolute_error, relative_error
from hodge_pipeline.report import run_report
from hodge_pipeline.start.clouds import clouds as clouds_step
from hodge_pipeline.start.given import gaps_between
from hodge_pipeline.store.store import stored
from hodge_pipeline.store.workspace import RUN
from hodge_pipeline.types import Floats, Trajectory
from mcap_scene import BEGIN_S, write_clouds
from readers_data import points_in_cam

SMALL = (
    "clouds.voxel_m=0.1", "executor.workers=0", "recording.level=off", "outer_iterations=1", "start.every=2",
    "evaluation.tables=false",
    "edges.builders=[{stage: sequential}, {stage: overlap, min_iou: 0.15}]",
)  # fmt: skip
ROOM = DemoOptions(frames=16, width=160, height=120, noise=0.3)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TUM folder of 16 small frames, going 27 degrees round the room and back."""
    return make_sequence(tmp_path_factory.mktemp("room") / "sequence", ROOM)


@pytest.fixture(scope="module")
def truth(sequence: Path) -> Trajectory:
    frames = TumReader().open(sequence).frames
    return Trajectory(np.array([f.stamp_s for f in frames]), np.array([f.world_from_cam for f in frames]))


@pytest.fixture(scope="module")
def drifted(truth: Trajectory) -> Trajectory:
    """The truth with a drift of 6 cm and 3 degrees from frame 4 to frame 10."""
    share = np.clip((np.arange(len(truth)) - 4) / 6, 0, 1)[:, None]
    drift = se3.exp(share * np.array([0.0, 0.05, 0.0, 0.06, 0.0, 0.0]))
    return Trajectory(truth.stamps_s, truth.world_from_cam @ drift)


def refine(poses: Path, frames: Path, out: Path, *more: str) -> Result:
    sets = [argument for override in SMALL for argument in ("--set", override)]
    arguments = [
        "refine",
        "trajectory",
        str(poses),
        "--frames",
        str(frames),
        "--out",
        str(out),
        *sets,
        *more,
        "--recipe",
        "slam_refine",
    ]
    return CliRunner().invoke(app, arguments)


def outcome(out: Path) -> str:
    return str(json.loads((out / "report.json").read_text())["refinement"]["outcome"])


def error_m(poses: Floats, truth: Trajectory) -> float:
    """The largest error of the motion from the first frame."""
    found, true = (se3.inverse(p[0]) @ p for p in (poses, truth.world_from_cam))
    return float(np.abs((se3.inverse(true) @ found)[:, :3, 3]).max())


@pytest.fixture(scope="module")
def refined(sequence: Path, drifted: Trajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refine")
    write_tum(folder / "slam.txt", drifted)
    found = refine(folder / "slam.txt", sequence, folder / "run")
    assert found.exit_code == 0, found.output
    return folder / "run"


def test_drift_is_taken_out_and_the_stamps_stay(refined: Path, drifted: Trajectory, truth: Trajectory) -> None:
    assert outcome(refined) == "refined"
    found = parse_tum(refined / "refined.txt").trajectory
    np.testing.assert_array_equal(found.stamps_s, drifted.stamps_s)
    assert error_m(drifted.world_from_cam, truth) > 0.05
    assert error_m(found.world_from_cam, truth) < 0.02
    poses = parse_tum(refined / "poses.tum").trajectory
    np.testing.assert_allclose(poses.world_from_cam, found.world_from_cam, atol=1e-9)


def test_the_report_shows_what_the_guard_measured(refined: Path) -> None:
    report = json.loads((refined / "report.json").read_text())
    names = {row["name"] for row in report["refinement"]["measures"]}
    assert {"score of held-out edges", "edge chi2, mean"} <= names and report["verdict"]["outcome"] == "improved"
    assert "Better than the poses given" in (refined / "report.html").read_text()


def test_errors_are_of_the_poses_in_the_file_as_evo_has_them(
    sequence: Path, drifted: Trajectory, truth: Trajectory, tmp_path: Path
) -> None:
    """A pose between the frames too, at stamps 4 ms from those of the truth, and one far from any true pose."""
    middle = (drifted.stamps_s[:-1] + drifted.stamps_s[1:]) / 2
    between = se3.poses_at(drifted, middle, 10.0)
    stamps = np.concatenate([drifted.stamps_s, middle, [drifted.stamps_s[-1] + 1]])
    poses = np.concatenate([drifted.world_from_cam, between, drifted.world_from_cam[-1:]])
    order = np.argsort(stamps)
    write_tum(tmp_path / "slam.txt", Trajectory(stamps[order], poses[order]))
    moments = np.sort(np.r_[truth.stamps_s, middle])
    true = Trajectory(moments + 0.004, se3.poses_at(truth, moments, 10.0))
    write_tum(tmp_path / "true.txt", true)
    found = refine(tmp_path / "slam.txt", sequence, tmp_path / "run", "--truth", str(tmp_path / "true.txt"))
    assert found.exit_code == 0, found.output
    report = json.loads((tmp_path / "run/report.json").read_text())
    rows = {row["name"]: row for row in report["trajectories"]}
    for name, file in (("start", tmp_path / "slam.txt"), ("result", tmp_path / "run/refined.txt")):
        written = parse_tum(file).trajectory.world_from_cam[:-1]
        assert rows[name]["frames"] == len(true) and rows[name]["left_out"] == 1
        assert rows[name]["of"] == "poses of slam.txt"
        error = absolute_error(written, true.world_from_cam)
        assert rows[name]["ate_rmse_m"] == pytest.approx(error.rmse_m, rel=1e-6)
        assert rows[name]["ate_max_m"] == pytest.approx(error.max_m, rel=1e-6)
        step = relative_error(written, true.world_from_cam)
        assert rows[name]["rpe_translation_m"] == pytest.approx(step.translation_rmse_m, rel=1e-6)
    assert rows["result"]["ate_rmse_m"] < rows["start"]["ate_rmse_m"]


def test_the_result_is_the_poses_written_not_the_last_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The report had 4.7 mm where the file was 11.1 mm off: its correction had fewer knots."""
    sets = {"start": np.zeros((2, 4, 4)), "result": np.ones((2, 4, 4))}
    monkeypatch.setattr(run_report, "pose_sets", lambda rounds, source: sets)
    scene = cast("Any", SimpleNamespace(source=None, key_frames=SimpleNamespace(rows=np.array([0, 2]))))
    written = se3.exp(np.arange(18.0).reshape(3, 6))
    found = run_report._shown([], scene, written, is_refined=True)
    np.testing.assert_array_equal(found["result"], written[[0, 2]])
    assert run_report._shown([], scene, written, is_refined=False) is sets


def test_a_single_pose_that_is_far_off_is_not_called_optimal(sequence: Path, truth: Trajectory, tmp_path: Path) -> None:
    """Held-out pairs hardly touch it, since there it overlaps with nothing: images tell."""
    given = truth.world_from_cam.copy()
    given[8] = given[8] @ se3.exp(np.array([0.0, 0.1, 0.0, 0.3, 0.0, 0.1]))
    write_tum(tmp_path / "slam.txt", Trajectory(truth.stamps_s, given))
    assert refine(tmp_path / "slam.txt", sequence, tmp_path / "run", "--set", "start.every=1").exit_code == 0
    assert outcome(tmp_path / "run") == "refined"
    found = parse_tum(tmp_path / "run" / "refined.txt").trajectory
    assert error_m(found.world_from_cam, truth) < 0.04


def test_optimal_poses_come_back_byte_for_byte(refined: Path, sequence: Path, tmp_path: Path) -> None:
    text = "# my own comment\n" + (refined / "refined.txt").read_text()
    (tmp_path / "slam.txt").write_text(text)
    found = refine(tmp_path / "slam.txt", sequence, tmp_path / "run")
    assert found.exit_code == 0 and outcome(tmp_path / "run") == "optimal"
    assert (tmp_path / "run" / "refined.txt").read_text() == text


def test_true_poses_that_registration_cannot_better_come_back_with_exit_code_0_but_with_force(
    sequence: Path,
    truth: Trajectory,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Registration that is told to see nothing nearer than a metre makes true poses worse."""
    write_tum(tmp_path / "slam.tum", truth)
    blind = ("--set", "registration.distances_m=[1.0]", "--set", "registration.source_points=[20]",
             "--set", "acceptance.max_rmse_m=9",
             "--set", "registration.points_per_sample=0.01")  # fmt: skip
    arguments = [str(tmp_path / "slam.tum"), "--frames", str(sequence), "--out", str(tmp_path / "run"), *blind]
    sets = [argument for override in SMALL for argument in ("--set", override)]
    monkeypatch.setattr("sys.argv", ["hodge", "refine", "trajectory", *arguments, *sets, "--recipe", "slam_refine"])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 0 and outcome(tmp_path / "run") == "optimal"
    assert (tmp_path / "run" / "refined.tum").read_bytes() == (tmp_path / "slam.tum").read_bytes()
    poses = parse_tum(tmp_path / "run" / "poses.tum").trajectory
    np.testing.assert_allclose(poses.world_from_cam, truth.world_from_cam, atol=1e-9)
    assert not json.loads((tmp_path / "run/report.json").read_text())["trajectories"], "compared with itself"
    forced = refine(tmp_path / "slam.tum", sequence, tmp_path / "forced", *blind, "--force")
    assert forced.exit_code == 0 and outcome(tmp_path / "forced") == "forced"
    assert (tmp_path / "forced" / "refined.tum").read_bytes() != (tmp_path / "slam.tum").read_bytes()


def test_sparse_poses_are_carried_over_all_frames(
    sequence: Path,
    truth: Trajectory,
    tmp_path: Path,
) -> None:
    every = Trajectory(truth.stamps_s[::6], truth.world_from_cam[::6])
    write_tum(tmp_path / "KeyFrameTrajectory.txt", every)
    found = refine(tmp_path / "KeyFrameTrajectory.txt", sequence, tmp_path / "run")
    assert found.exit_code == 0, found.output
    assert len(parse_tum(tmp_path / "run" / "refined.txt").trajectory) == len(every)
    poses = parse_tum(tmp_path / "run" / "poses.tum").trajectory
    np.testing.assert_array_equal(poses.stamps_s, truth.stamps_s)
    assert error_m(poses.world_from_cam, truth) < 0.03


def test_one_frame_without_a_pose_costs_no_whole_odometry(sequence: Path, truth: Trajectory, tmp_path: Path) -> None:
    kept = np.arange(len(truth)) != 8
    write_tum(tmp_path / "slam.txt", Trajectory(truth.stamps_s[kept], truth.world_from_cam[kept]))
    found = refine(tmp_path / "slam.txt", sequence, tmp_path / "run", "--set", "start.max_gap_s=0.01")
    assert found.exit_code == 0, found.output
    sizes = [len(clouds) for clouds in stored(tmp_path / "run" / RUN, clouds_step)]
    assert min(sizes) == 4 and max(sizes) < len(truth), "the frame, the two before and the one after; key frames"
    poses = parse_tum(tmp_path / "run" / "poses.tum").trajectory
    assert len(poses) == len(truth) and error_m(poses.world_from_cam, truth) < 0.03


def test_gaps_hold_the_frames_without_a_pose_and_those_around_them() -> None:
    known = np.array([True, True, True, False, True, True, True, True, False, True, True, False])
    (first, second), gaps = (np.arange(6), np.arange(6, 12)), gaps_between
    assert [gap.tolist() for gap in gaps(known, [first, second])] == [[1, 2, 3, 4], [6, 7, 8, 9, 10, 11]]
    assert [gap.tolist() for gap in gaps(known[:6], [first])] == [[1, 2, 3, 4]]
    assert [gap.tolist() for gap in gaps(~known[:3], [np.arange(3)])] == [[0, 1, 2]], "a sequence without a pose"


def test_scans_of_a_street_scale_the_recipe_themselves(
    sequence: Path, truth: Trajectory, drifted: Trajectory, tmp_path: Path
) -> None:
    """The room, twenty times as large, as point clouds in an MCAP recording: 1.2 m of drift."""
    size, frames = 20.0, TumReader().open(sequence).frames
    clouds = [size * points_in_cam(frame.read_depth(), frame.camera, 1) for frame in frames if frame.read_depth]
    large = [larger(trajectory, size) for trajectory in (truth, drifted)]
    posed = [replace(frame, world_from_cam=pose) for frame, pose in zip(frames, large[0].world_from_cam, strict=True)]
    log = write_clouds(tmp_path / "log.mcap", posed, clouds)
    for name, trajectory in zip(("true.txt", "slam.txt"), large, strict=True):
        write_tum(tmp_path / name, Trajectory(trajectory.stamps_s + BEGIN_S, trajectory.world_from_cam))
    found = refine(tmp_path / "slam.txt", log, tmp_path / "run", "--truth", str(tmp_path / "true.txt"))
    assert found.exit_code == 0, found.output
    rows = {row["name"]: row for row in json.loads((tmp_path / "run/report.json").read_text())["trajectories"]}
    assert rows["start"]["ate_rmse_m"] > 0.3 and rows["result"]["ate_rmse_m"] < 0.3 * rows["start"]["ate_rmse_m"]


def larger(trajectory: Trajectory, factor: float) -> Trajectory:
    poses = trajectory.world_from_cam.copy()
    poses[:, :3, 3] *= factor
    return Trajectory(trajectory.stamps_s, poses)


def test_given_poses_that_no_frame_tests_are_counted(sequence: Path, drifted: Trajectory, tmp_path: Path) -> None:
    """Two poses a second before the frames; then stamps so late that most frames come before the first pose."""
    early = Trajectory(
        np.r_[drifted.stamps_s[0] - [1.0, 0.9], drifted.stamps_s],
        np.concatenate([drifted.world_from_cam[:1]] * 2 + [drifted.world_from_cam]),
    )
    late = Trajectory(drifted.stamps_s + drifted.stamps_s[12] - drifted.stamps_s[0], drifted.world_from_cam)
    notes, headlines = [], []
    for name, given in (("early", early), ("late", late)):
        write_tum(tmp_path / f"{name}.txt", given)
        refine(tmp_path / f"{name}.txt", sequence, tmp_path / name)
        report = json.loads((tmp_path / name / "report.json").read_text())
        notes.append({note["kind"]: note["text"] for note in report["notes"]})
        headlines.append(report["verdict"]["sentence"])
    told = "2 of 18 given poses have no frame: not tested, and moved as the nearest frame, by up to"
    assert notes[0]["untested"].startswith(told) and headlines[0].startswith("Better than")
    assert notes[1]["mostly untested"].startswith("12 of 16 given poses have no frame")
    assert notes[1]["frames outside"].startswith("12 of 16 frames are from before the first given pose")
    assert headlines[1].startswith("In doubt, since most frames lie outside the time of the poses given and most of")


def test_all_edges_rejected_leaves_the_report_alone(
    sequence: Path,
    drifted: Trajectory,
    tmp_path: Path,
) -> None:
    write_tum(tmp_path / "slam.txt", drifted)
    found = refine(tmp_path / "slam.txt", sequence, tmp_path / "run", "--set", "acceptance.max_rmse_m=1e-6")
    assert found.exit_code != 0 and getattr(found.exception, "exit_code", None) == 3
    assert "points too far apart" in str(found.exception)
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert "report.html" in names and not any(n.startswith(("refined", "poses", "graph", "edges")) for n in names)


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n", "none of its poses is of these frames"),
        ("nan nan nan nan nan nan nan nan\n", "is no pose"),
    ],
)
def test_poses_of_something_else_are_refused(
    sequence: Path,
    tmp_path: Path,
    lines: str,
    complaint: str,
) -> None:
    (tmp_path / "other.txt").write_text(lines)
    found = refine(tmp_path / "other.txt", sequence, tmp_path / "run")
    assert complaint in str(found.exception) and getattr(found.exception, "exit_code", None) == 1
    assert "\n" not in str(found.exception)
    assert not list((tmp_path / "run").glob("refined*"))


def test_a_single_pose_and_nan_poses_do_not_stop_it(
    sequence: Path,
    truth: Trajectory,
    tmp_path: Path,
) -> None:
    write_tum(tmp_path / "one.txt", Trajectory(truth.stamps_s[:1], truth.world_from_cam[:1]))
    text = (tmp_path / "one.txt").read_text() + f"{float(truth.stamps_s[5])!r} nan nan nan nan nan nan nan\n"
    (tmp_path / "one.txt").write_text(text)
    found = refine(tmp_path / "one.txt", sequence, tmp_path / "run")
    assert found.exit_code == 0, found.output
    assert "1 line that is no pose left out" in (tmp_path / "run" / "log.txt").read_text()
    assert (tmp_path / "run" / "refined.txt").read_text().endswith("nan nan nan nan nan nan nan\n")

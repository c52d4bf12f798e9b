import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from hodge_pipeline import se3
from hodge_pipeline.cli.main import app
from hodge_pipeline.refine import given_poses
from hodge_pipeline.refine.given_poses import chi2_measure, first_as_good, spread_corrections
from hodge_pipeline.refine.guard import Measure, PoseChange, decide, mean_noise
from hodge_pipeline.refine.jumps import sure_jumps, without_steps
from hodge_pipeline.refine.path_size import path_size
from hodge_pipeline.scene import KeyFrames
from hodge_pipeline.types.notes import Note

BETTER = Measure("held-out distance", 0.010, 0.009)
WORSE = Measure("held-out score", 0.90, 0.88, better="higher")
MOVED = PoseChange(0.01, 0.5, 0.001, 0.05)
STILL = PoseChange(0.0005, 0.01, 0.001, 0.05)


def test_a_better_result_is_kept():
    decision = decide([BETTER], MOVED)
    assert decision.outcome == "refined" and not decision.keeps_input and decision.exit_code == 0


def test_one_worse_measure_gives_the_input_back_with_exit_code_3():
    decision = decide([BETTER, WORSE], MOVED)
    assert decision.outcome == "worse" and decision.keeps_input and decision.exit_code == 3
    assert "held-out score 0.9000 → 0.8800" in decision.reason and "distance" not in decision.reason


def test_force_writes_a_worse_result():
    decision = decide([WORSE], MOVED, force=True)
    assert decision.outcome == "forced" and not decision.keeps_input and decision.exit_code == 0


def test_a_change_below_its_uncertainty_gives_the_input_back_without_complaint():
    decision = decide([BETTER], STILL)
    assert decision.outcome == "optimal" and decision.keeps_input and decision.exit_code == 0


def test_what_was_held_out_counts_before_a_large_uncertainty():
    held_out = replace(WORSE, before=0.72, after=0.83, tolerance=0.02, is_held_out=True)
    assert decide([held_out], STILL).outcome == "refined"
    assert decide([replace(held_out, after=0.73)], STILL).outcome == "optimal"
    assert decide([WORSE], STILL).outcome == "worse"


def test_poses_that_held_out_measurements_fit_as_well_or_better_are_given_back_without_complaint():
    """True poses: the result fits its own edges better, what was held out worse."""
    for after in (0.88, 0.90, 0.904):
        held_out = replace(WORSE, after=after, tolerance=0.015, is_held_out=True)
        decision = decide([held_out, BETTER], MOVED)
        assert decision.outcome == "optimal" and decision.exit_code == 0
    assert decide([replace(held_out, after=0.91)], STILL).outcome == "optimal"
    assert decide([replace(held_out, after=0.91)], MOVED).outcome == "refined", "fewer pairs tell less"
    failed = replace(BETTER, after=0.02)
    assert decide([held_out, failed], MOVED).outcome == "worse"


@pytest.mark.parametrize(("shift_m", "settled"), [(0.04, True), (0.2, False)])
def test_poses_that_the_last_round_still_moved_are_worse(shift_m: float, settled: bool):
    """A bend of a straight path of 3 m, which no alignment takes away."""
    work = SimpleNamespace(recipe=SimpleNamespace(scale=1.0))
    graph = SimpleNamespace(edges=np.array([[0, 1], [1, 2], [2, 3]]), vertex_count=4)
    rounds = []
    for bend_m in (0.0, 0.0, 2 * shift_m):
        positions = np.outer(np.arange(4.0), [1.0, 0, 0]) + np.outer([1, -1, -1, 1], [0, bend_m, 0]) / 2
        poses = se3.from_parts(np.broadcast_to(np.eye(3), (4, 3, 3)), positions)
        rounds.append(SimpleNamespace(world_from_cam=poses, graph=graph, edited=False))
    measures = given_poses._settled(work, rounds)
    assert (not measures) == settled
    assert decide([BETTER, *measures], MOVED).outcome == ("refined" if settled else "worse")


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_pairs_do_not_tell_their_own_noise(count: int) -> None:
    """Of differences by chance one in 740 exceeds the noise, however few there are; by three standard errors of each
    sample those of two do once in ten times."""
    chance = np.random.default_rng(count).standard_normal((4000, count))
    taken = np.mean([found.mean() > mean_noise(found) for found in chance])
    assert taken < 0.005


def key_frames(count: int) -> tuple[KeyFrames, np.ndarray]:
    """Key frames on a straight line, every frame one, and poses that jump about it by 1 cm."""
    given = np.tile(np.eye(4), (count, 1, 1))
    given[:, 0, 3] = 0.1 * np.arange(count)
    after = given.copy()
    after[:, 1, 3] = 0.01 * (-1.0) ** np.arange(count)
    rows, none, stamps = np.arange(count), np.zeros(count, np.int64), np.arange(count) / 30
    return KeyFrames(rows, given, given, none, stamps, np.ones(count, bool), stamps, none, rows), after


def test_a_wider_correction_keeps_more_of_the_given_steps():
    frames, after = key_frames(33)
    found = spread_corrections(frames, after, np.zeros(0, np.int64))
    np.testing.assert_array_equal(found[-1], after)
    sideways = np.abs(np.diff(found[:, :, 1, 3], axis=1)).max(axis=1)
    assert sideways[-1] == pytest.approx(0.02) and (sideways[:-1] < 1e-9).all(), "even knots moved alike"


def test_the_widest_correction_is_kept_that_fits_as_well_as_the_best():
    pairs = np.random.default_rng(0).normal(0.8, 0.05, 40)
    assert first_as_good(np.array([pairs - 0.02, pairs - 0.001, pairs])) == 1
    noisy = np.random.default_rng(1).normal(0.0, 0.02, 40)
    assert first_as_good(np.array([pairs - 0.02, pairs - 0.002 + noisy, pairs])) == 1


def test_a_measure_within_its_tolerance_is_not_worse_and_a_lost_one_is():
    assert not Measure("x", 1.0, 1.05, tolerance=0.1).is_worse
    assert Measure("x", 1.0, 1.2, tolerance=0.1).is_worse
    assert Measure("x", 1.0, math.nan).is_worse
    assert not Measure("x", math.nan, 1.0).is_worse


def test_chi2_may_grow_by_a_fiftieth():
    assert not chi2_measure(200.0, 203.9).is_worse
    assert chi2_measure(200.0, 204.1).is_worse


def test_an_uncertainty_that_is_unknown_never_calls_a_change_insignificant():
    assert PoseChange(1e-9, 1e-9, math.nan, math.nan).is_significant


def test_the_help_sends_a_graph_file_to_solve():
    found = CliRunner().invoke(app, ["refine", "--help"])
    assert found.exit_code == 0 and "hodge solve" in found.output and "trajectory" in found.output


def test_a_change_is_told_in_millimetres_and_degrees():
    told = str(PoseChange(0.0125, 0.25, 0.004, 0.5))
    assert told == "poses moved by 12.5 mm and 0.25° (RMS), known to 4 mm and 0.5°"


def work_of(
    before: np.ndarray, off_images_m: np.ndarray, monkeypatch: pytest.MonkeyPatch, apart_m: tuple[float, float]
) -> tuple[SimpleNamespace, KeyFrames, list[Note]]:
    """The work, key frames of these poses and its notes, where images lie off each step, before and after, by this (2,)
    or (2, K - 1), and clouds from each other by `apart_m`.
    """
    notes: list[Note] = []
    steps = SimpleNamespace(note=lambda *more: notes.extend(more))
    frames = [SimpleNamespace(frame_id=row) for row in range(len(before))]
    guard = SimpleNamespace(shared_errors=100.0)
    work = SimpleNamespace(
        recipe=SimpleNamespace(scale=1.0, guard=guard),
        steps=steps,
        scene=SimpleNamespace(source=SimpleNamespace(frames=frames)),
    )
    rows, zeros, ones = np.arange(len(before)), np.zeros(len(before), np.int64), np.ones(len(before), bool)
    keys = KeyFrames(rows, before, before, zeros, rows / 30, ones, rows / 30, zeros, rows)
    off_m = np.broadcast_to(off_images_m.reshape(2, -1), (2, len(before) - 1))
    off = np.stack([off_m, np.where(np.isnan(off_m), np.nan, 0.0)], axis=-1)
    monkeypatch.setattr("hodge_pipeline.refine.jumps.off_images", lambda work, firsts, *poses: off[:, firsts])
    apart = np.array(apart_m)[:, None]
    monkeypatch.setattr("hodge_pipeline.refine.jumps.apart_m", lambda work, pairs, *_: np.tile(apart, len(pairs)))
    return work, keys, notes


def sized(
    before: np.ndarray,
    after: np.ndarray,
    off_images_m: np.ndarray,
    monkeypatch: pytest.MonkeyPatch,
    apart_m: tuple[float, float] = (0.1, 0.01),
):
    """The measures of a path's size, and the notes, where images lie off the steps by this (2,), clouds by the last."""
    work, keys, notes = work_of(before, off_images_m, monkeypatch, apart_m)
    return path_size(work, keys, after), notes


def test_a_jump_of_the_given_path_is_no_other_scale(monkeypatch: pytest.MonkeyPatch):
    """From 5 to 6 one metre too long: the refined path is less than half as large, its other steps are as long."""
    true = se3.from_parts(np.broadcast_to(np.eye(3), (12, 3, 3)), np.outer(np.arange(12), [0.05, 0, 0]))
    jumped = true.copy()
    jumped[6:, 0, 3] += 1.0
    nothing = np.full(2, np.nan)
    measures, notes = sized(jumped, true, nothing, monkeypatch)
    assert not measures and [note.kind for note in notes] == ["given jumps"]
    assert "from frame 5 to 6 by 1.05 m, not 5 cm" in str(notes[0])
    twice = jumped.copy()
    twice[9:, 0, 3] += 2.0
    measures, notes = sized(twice, true, nothing, monkeypatch)
    assert not measures and "at 2 steps (from frame 8 to 9 by 2.05 m" in str(notes[0])
    near, far = (0.01, 0.1), (0.1, 0.1)
    for before, after, images, clouds in (
        (true, jumped, nothing, near),
        (jumped, true, np.array([0.0, 1.0]), far),
        (jumped, true, nothing, near),
        (jumped, true, nothing, far),
    ):
        measures, notes = sized(before, after, images, monkeypatch, clouds)
        assert measures and notes[0].kind == "path scaled", "a jump of the refined path, or one that they show"
    measures, notes = sized(se3.rescaled(true, 1.3), true, nothing, monkeypatch)
    assert measures and notes[0].kind == "path scaled" and notes[0].detail == "0.769"


def test_a_pose_that_edges_and_images_put_elsewhere_is_a_sure_jump_there_and_back(monkeypatch: pytest.MonkeyPatch):
    """Pose 5 of twelve lies 30 cm beside the path; images err by 3 mm. Steps back in place, the rest is as it was."""
    true = se3.from_parts(np.broadcast_to(np.eye(3), (12, 3, 3)), np.outer(np.arange(12), [0.05, 0, 0]))
    given = true.copy()
    given[5, 1, 3] += 0.3
    graph, solution = SimpleNamespace(), SimpleNamespace(world_from_cam=true)
    off_m = np.full((2, 11), 0.003)
    monkeypatch.setattr("hodge_pipeline.refine.jumps.far_steps", lambda *_: np.array([5, 4]))
    for images, clouds in (((0.3, 0.003), (0.0, 1.0)), ((np.nan, np.nan), (0.3, 0.003))):
        off_m[:, [4, 5]] = np.array([images]).T
        work, keys, _ = work_of(given, off_m, monkeypatch, clouds)
        rows, mended, (measure,) = sure_jumps(work, keys, graph, solution)
        assert sorted(rows.tolist()) == [4, 5] and measure.is_better and str(measure).endswith("300 → 3 mm")
        np.testing.assert_allclose(mended, true, atol=1e-12)
    for images, clouds in (((0.003, 0.3), (1.0, 0.0)), ((np.nan, np.nan), (0.1, 0.1))):
        off_m[:, [4, 5]] = np.array([images]).T
        work, keys, _ = work_of(given, off_m, monkeypatch, clouds)
        rows, mended, measures = sure_jumps(work, keys, graph, solution)
        assert not len(rows) and not measures and mended is given, "images, or without them clouds, show the given step"


def test_a_jump_that_leads_back_moves_no_other_pose():
    """Pose 5 of twelve lies 30 cm aside; refined steps err by 1 cm. Where the rest is turned or aside, it moves."""
    true = se3.from_parts(np.broadcast_to(np.eye(3), (12, 3, 3)), np.outer(np.arange(12), [0.05, 0, 0]))
    refined = true.copy()
    refined[5:, 1, 3] += 0.01
    given, jumps = true.copy(), np.array([5, 4])
    given[5, 1, 3] += 0.3
    mended = without_steps(given, refined, jumps)
    np.testing.assert_allclose(np.delete(mended, 5, axis=0), np.delete(true, 5, axis=0), atol=1e-12)
    np.testing.assert_allclose(mended[5], refined[5], atol=1e-12)
    turned = given.copy()
    turned[6:] = given[6] @ se3.exp(np.array([0, 0, 0.2, 0, 0, 0])) @ se3.inverse(given[6]) @ given[6:]
    np.testing.assert_allclose(without_steps(turned, refined, jumps), refined, atol=1e-12)
    given[6:, 1, 3] += 0.2
    np.testing.assert_allclose(without_steps(given, refined, jumps), refined, atol=1e-12)


def test_a_hundred_jumps_leave_motions_rigid_and_steps_that_are_mostly_jumps_are_another_path(
    monkeypatch: pytest.MonkeyPatch,
):
    """Rounding of one jump doubled with the next."""
    rng = np.random.default_rng(4)
    true, given = (se3.exp(rng.normal(scale=0.3, size=(200, 6))) for _ in range(2))
    mended = without_steps(given, true, np.arange(0, 198, 2))
    np.testing.assert_allclose(np.linalg.det(mended[:, :3, :3]), 1.0, atol=1e-9)
    steps = [(se3.inverse(poses[:-1]) @ poses[1:])[0:198:2] for poses in (mended, true)]
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-9)
    for count, found in ((99, 99), (100, 0)):
        monkeypatch.setattr("hodge_pipeline.refine.jumps.far_steps", lambda *_, count=count: np.arange(count))
        work, keys, _ = work_of(given, np.array([0.3, 0.003]), monkeypatch, (0.1, 0.1))
        rows, *_ = sure_jumps(work, keys, SimpleNamespace(), SimpleNamespace(world_from_cam=true))
        assert len(rows) == found


@pytest.mark.parametrize("knocked", [False, True])
def test_what_follows_a_turn_keeps_its_steps_or_its_places(knocked: bool):
    """From pose 6 of a path that bends on, all is turned about pose 6 by 5 degrees, or each pose about itself."""
    steps = se3.exp(np.tile([0.0, 0.03, 0.0, 0.05, 0.0, 0.0], (12, 1)))
    true = np.array([np.linalg.multi_dot([np.eye(4), np.eye(4), *steps[:k]]) for k in range(12)])
    turn = se3.exp(np.array([0, 0, np.deg2rad(5), 0, 0, 0]))
    given = true.copy()
    given[6:] = true[6:] @ turn if knocked else true[6] @ turn @ se3.inverse(true[6]) @ true[6:]
    np.testing.assert_allclose(without_steps(given, true, np.array([5])), true, atol=1e-12)
    assert np.abs(given - true)[6:, :3, 3].max() == pytest.approx(0.0) or not knocked


def test_the_widest_correction_still_takes_jumps_out():
    """Pose 5 alone is off, between knots 16 apart."""
    true = se3.from_parts(np.broadcast_to(np.eye(3), (40, 3, 3)), np.outer(np.arange(40), [0.05, 0, 0]))
    given = true.copy()
    given[5, 1, 3] += 0.3
    rows, zeros, ones = np.arange(40), np.zeros(40, np.int64), np.ones(40, bool)
    keys = KeyFrames(rows, given, given, zeros, rows / 30, ones, rows / 30, zeros, rows)
    widest = spread_corrections(keys, true, np.array([4, 5]))[0]
    np.testing.assert_allclose(widest, true, atol=1e-9)

"""Pairs in blocks and odometry: the same on any workers, resumed or not; lost and empty frames are said."""

import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.executors.local import InProcess, LocalExecutor
from hodge_pipeline.registration import odometry as odometry_stage
from hodge_pipeline.registration import pairs as pair_stage
from hodge_pipeline.registration.acceptance import Acceptance
from hodge_pipeline.registration.gaps import gaps, over_gap, told_gaps
from hodge_pipeline.registration.gicp import Gicp, Vgicp
from hodge_pipeline.registration.odometry import OdometryOptions, odometry
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.register import register_edges
from hodge_pipeline.registration.tracking.bridging import bridge
from hodge_pipeline.stages import Registrar, Step, Workers
from hodge_pipeline.types import CloudSet, Edges, Floats, PointCloud, Registration
from test_executors import dask_workers
from test_registration import corner

FRAMES = 12
STEP = np.array([0.01, 0.03, -0.005, 0.03, 0.0, 0.02])
EMPTY = PointCloud(np.zeros((0, 3), np.float32))
HERE = LocalExecutor(workers=0)


def path_of(count: int) -> Floats:
    """A camera that turns and moves by the same step from frame to frame."""
    return se3.exp(np.arange(count)[:, None] * STEP)


def seen_from(world_from_cam: Floats, seed: int) -> PointCloud:
    points, normals, _ = corner(seed, count=3000)
    cam_from_world = se3.inverse(world_from_cam)
    rotated = (normals @ cam_from_world[:3, :3].T).astype(np.float32)
    return PointCloud(se3.transform(cam_from_world, points).astype(np.float32), rotated)


def saved(folder: Path, clouds: list[PointCloud]) -> Path:
    CloudSet.from_clouds(clouds).save(folder)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    clouds = [seen_from(pose, seed) for seed, pose in enumerate(path_of(FRAMES))]
    return saved(tmp_path_factory.mktemp("clouds"), clouds)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pair_stage, "PAIRS_IN_BLOCK", 4)
    monkeypatch.setattr(odometry_stage, "STEPS_IN_BLOCK", 4)


PAIRS = np.array([[k, k + gap] for gap in (1, 2) for k in range(FRAMES - gap)])[::-1]  # not in the order of the blocks


def guesses() -> Floats:
    poses = path_of(FRAMES)
    return se3.inverse(poses[PAIRS[:, 0]]) @ poses[PAIRS[:, 1]] @ se3.exp(np.full(6, 0.01))


def same_bits(a: Edges, b: Edges) -> bool:
    return all(getattr(a, name).tobytes() == getattr(b, name).tobytes() for name in vars(a))


def test_pairs_come_back_in_the_order_given_and_right(folder: Path) -> None:
    done: list[int] = []
    with HERE.open() as workers:
        found = register_pairs(folder, Gicp(), Edges.of(PAIRS), guesses(), workers, done.append)
    truth = path_of(FRAMES)
    i, j = found.pairs.T
    errors = se3.log(se3.inverse(se3.inverse(truth[i]) @ truth[j]) @ found.i_from_j)
    assert np.array_equal(found.pairs, PAIRS)
    assert np.abs(errors).max() < 0.01
    assert sum(done) == len(PAIRS)
    assert (Acceptance().reasons(found) == "").all()
    graph = found.as_graph(np.arange(FRAMES))
    assert (graph.vertex_count, graph.edge_count) == (FRAMES, len(PAIRS))


@pytest.mark.parametrize("make", [LocalExecutor(workers=2).open, dask_workers])
def test_all_workers_give_the_same_bits(folder: Path, make: Callable[[], AbstractContextManager[Workers]]) -> None:
    with HERE.open() as workers:
        here = register_pairs(folder, Gicp(), Edges.of(PAIRS), guesses(), workers)
    with make() as workers:
        elsewhere = register_pairs(folder, Gicp(), Edges.of(PAIRS), guesses(), workers)
    assert same_bits(here, elsewhere)


def test_workers_are_sent_pairs_and_guesses_alone(folder: Path) -> None:
    sent: list[int] = []

    class Told(InProcess):
        def map(self, task: Callable[[Any], Any], blocks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
            sent.extend(len(pickle.dumps(block)) for block in blocks)
            return super().map(task, blocks)

    found = register_pairs(folder, Gicp(), Edges.of(PAIRS, "overlap"), guesses(), Told())
    assert max(sent) < 4 * 8 * (2 + 16) + 500  # a row of the table has 600 bytes and more
    assert set(found.proposed_by) == {"overlap"} and found.counts.all()


def test_finished_blocks_are_not_registered_again(folder: Path) -> None:
    kept: dict[int, Edges] = {}
    with HERE.open() as workers:
        whole = register_pairs(folder, Gicp(), Edges.of(PAIRS), guesses(), workers, on_block=kept.__setitem__)
        assert sorted(kept) == list(range(6))
        some = {block: kept[block] for block in (0, 3, 4)}
        again: dict[int, Edges] = {}
        resumed = register_pairs(
            folder, Gicp(), Edges.of(PAIRS), guesses(), workers, finished=some, on_block=again.__setitem__
        )
    assert sorted(again) == [1, 2, 5]
    assert same_bits(whole, resumed)


def test_a_pair_is_registered_again_only_where_the_poses_moved_it(folder: Path, tmp_path: Path) -> None:
    poses, pairs = path_of(FRAMES), Edges.of(PAIRS, "sequential")
    asked: list[int] = []

    def registered(where: Floats, earlier: Edges | None) -> Edges:
        asked.clear()
        step = Step(tmp_path, asked.append, lambda *notes: None)
        return register_edges(pairs, CloudSet.open(folder), Gicp(), where, earlier, workers=InProcess(), step=step)

    first = registered(poses, None)
    marked = replace(first, fitness=first.fitness + 1.0)
    settled = replace(marked, i_from_j=se3.inverse(poses[PAIRS[:, 0]]) @ poses[PAIRS[:, 1]])
    moved = poses.copy()
    moved[-1, :3, 3] += 0.03
    again = registered(moved, settled)
    fresh = (PAIRS == FRAMES - 1).any(axis=1)
    assert fresh.any() and not fresh.all()
    np.testing.assert_array_equal(again.pairs, PAIRS)
    np.testing.assert_array_equal(again.fitness > 1.0, ~fresh)
    assert sum(asked) == len(PAIRS)
    rejected = replace(settled, status=np.full(len(PAIRS), "rejected"))
    assert same_bits(registered(poses, rejected), first)
    unguessed = replace(rejected, iterations=np.zeros(len(PAIRS), np.int64), converged=np.ones(len(PAIRS), bool))
    assert same_bits(registered(moved, unguessed), replace(unguessed, status=first.status))


def test_a_pair_is_not_registered_again_from_a_guess_nearer_to_where_it_was(folder: Path, tmp_path: Path) -> None:
    """GICP goes down from a guess: half way down it ends where it did. Another registrar may see more from there."""
    poses, pairs = path_of(FRAMES), Edges.of(PAIRS, "sequential")
    first_guess, nearer = poses.copy(), poses.copy()
    first_guess[-1, :3, 3] += 0.04
    nearer[-1, :3, 3] += 0.02

    def registered(where: Floats, earlier: Edges | None, start: Floats | None, registrar: Registrar) -> Edges:
        step = Step(tmp_path, lambda _: None, lambda *notes: None)
        clouds = CloudSet.open(folder)
        return register_edges(
            pairs, clouds, registrar, where, earlier, 1.0, 0.01, start, workers=InProcess(), step=step
        )

    motions = se3.inverse(poses[PAIRS[:, 0]]) @ poses[PAIRS[:, 1]]
    found = registered(first_guess, None, None, Gicp())
    marked = replace(found, i_from_j=motions, fitness=found.fitness + 1.0, status=np.full(len(PAIRS), "used"))
    last = (PAIRS == FRAMES - 1).any(axis=1)
    assert found.converged[last].all()
    np.testing.assert_array_equal(registered(nearer, marked, first_guess, Gicp()).fitness > 1.0, True)
    farther = registered(first_guess, marked, nearer, Gicp())
    np.testing.assert_array_equal(farther.fitness > 1.0, ~last)
    np.testing.assert_array_equal(registered(nearer, marked, first_guess, Vgicp()).fitness > 1.0, ~last)
    flat = marked.information.copy()
    flat[:, 3:, 3:] = np.diag([1.0, 1.0, 0.0])
    sliding = replace(marked, information=flat)
    np.testing.assert_array_equal(registered(nearer, sliding, first_guess, Gicp()).fitness > 1.0, ~last)
    lost = replace(marked, converged=np.zeros(len(PAIRS), bool))
    np.testing.assert_array_equal(registered(nearer, lost, first_guess, Gicp()).fitness > 1.0, ~last)


def test_no_pairs_are_no_edges(folder: Path) -> None:
    with HERE.open() as workers:
        none = register_pairs(folder, Gicp(), Edges.of([]), np.zeros((0, 4, 4)), workers)
    assert none.as_graph(np.arange(FRAMES)).edge_count == 0


def test_rejected_pairs_say_why(folder: Path) -> None:
    far = np.stack([np.eye(4), se3.exp(np.array([0, 0, 0, 90.0, 0, 0]))])
    with HERE.open() as workers:
        found = register_pairs(folder, Gicp(), Edges.of([[0, 1], [0, 2]]), far, workers)
    assert Acceptance().reasons(found).tolist() == ["", "nothing in common"]
    assert Acceptance(min_fitness=1.0, max_rmse_m=1e-6).reasons(found)[0] != ""
    assert Acceptance(min_fitness=0.0, max_rmse_m=1e-6).reasons(found)[0] == "points too far apart"


def test_pairs_that_see_one_bare_wall_slide_and_are_no_edges(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(-1, 1, (4000, 2)), np.full(4000, 2.0)])
    ahead = np.tile(np.float32([0, 0, -1]), (4000, 1))
    clouds = [PointCloud((flat + rng.normal(0, 0.002, flat.shape)).astype(np.float32), ahead) for _ in range(3)]
    with HERE.open() as workers:
        pairs = Edges.of([[0, 1], [1, 2], [0, 2]])
        found = register_pairs(saved(tmp_path, clouds), Gicp(), pairs, np.tile(np.eye(4), (3, 1, 1)), workers)
    said = Acceptance().reasons(found).tolist()
    assert said == ["", "", "what they share lets them slide"], "consecutive frames are held all the same"
    assert set(Acceptance().reasons(found, in_order=False)) == {said[2]}, "of scans in no order none is consecutive"
    assert Acceptance(min_spread=0.0).reasons(found).tolist() == ["", "", ""]


def test_odometry_follows_the_camera(folder: Path) -> None:
    with HERE.open() as workers:
        found = odometry(folder, [np.arange(FRAMES)], np.arange(FRAMES) / 30, OdometryOptions(), workers)
    errors = se3.log(se3.inverse(path_of(FRAMES)) @ found.world_from_cam)
    assert np.abs(errors).max() < 0.02
    assert found.notes == ()
    assert found.steps.pairs.tolist() == [[k, k + 1] for k in range(FRAMES - 1)]


def test_empty_frames_are_bridged_and_a_lost_one_is_said(tmp_path: Path) -> None:
    poses = path_of(8)
    clouds = [seen_from(pose, seed) for seed, pose in enumerate(poses)]
    clouds[3] = EMPTY
    clouds[7] = PointCloud(clouds[7].points_in_cam + np.float32(50))  # nothing in common with the frame before
    with HERE.open() as workers:
        found = odometry(saved(tmp_path, clouds), [np.arange(8)], np.arange(8.0), OdometryOptions(), workers)
    assert [2, 4] in found.steps.pairs.tolist()
    assert 7 not in found.steps.pairs
    assert len(found.notes) == 1
    assert "rows 6 and 7" in found.notes[0]
    good = [0, 1, 2, 4, 5, 6]
    assert np.abs(se3.log(se3.inverse(poses[good]) @ found.world_from_cam[good])).max() < 0.02
    assert np.array_equal(found.world_from_cam[3], found.world_from_cam[2])
    assert np.abs(se3.log(se3.inverse(poses[7]) @ found.world_from_cam[7])).max() < 0.05  # constant velocity


@pytest.mark.parametrize(("share", "pairs"), [(0.0, [[0, 1], [1, 2]]), (0.4, [[0, 1]])])
def test_a_break_of_tracking_is_bridged_by_what_free_space_does_not_refute(
    share: float, pairs: list[list[int]], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tested: Any = lambda edges, *_: replace(edges, seen_through=np.full(len(edges), share))  # noqa: E731
    monkeypatch.setattr("hodge_pipeline.registration.tracking.bridging.with_seen_through", tested)
    poses = path_of(3)
    motions = zip(se3.between(poses, np.array([[0, 1], [1, 2]])), (1.0, 0.0), strict=True)
    found = [Registration(motion, np.eye(6), fitness, 0.01, 100, 1, True) for motion, fitness in motions]
    steps = Edges.of([[0, 1], [1, 2]], "sequential").with_registrations(found)
    with HERE.open() as workers:
        held, _ = bridge(CloudSet.open(folder), [np.arange(3)], steps, poses, OdometryOptions(), workers, 1.0)
    assert held.pairs[:, 1].tolist() == [pair[1] for pair in pairs]


def test_over_a_hole_in_the_recording_a_step_must_be_sure(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stamps = np.arange(FRAMES) / 30
    stamps[7:] += 1.0
    with HERE.open() as workers:
        usual = odometry(folder, [np.arange(FRAMES)], stamps, OdometryOptions(), workers)
        monkeypatch.setattr(odometry_stage, "SURE_FITNESS", 1.0)
        strict = odometry(folder, [np.arange(FRAMES)], stamps, OdometryOptions(), workers)
    assert [6, 7] in usual.steps.pairs.tolist()
    assert [6, 7] not in strict.steps.pairs.tolist()
    assert len(strict.steps.pairs) == FRAMES - 2
    assert "rows 6 and 7 (a hole in the recording" in strict.notes[0]


def test_a_hole_is_a_step_much_longer_than_the_others_of_its_sequence() -> None:
    slow, fast = np.arange(6.0), np.array([0, 0.1, 0.2, 3.0, 3.1])
    rows = [np.arange(6), np.arange(6, 11)]
    stamps = np.concatenate([slow, fast])
    pairs = np.array([[0, 1], [0, 5], [6, 7], [8, 9]])
    assert over_gap(pairs, rows, stamps).tolist() == [False, False, False, True]
    assert gaps(rows, stamps).tolist() == [[8, 9]]
    assert not len(gaps(rows[:1], stamps))
    assert not len(gaps(rows, stamps[::-1]))  # no clock
    assert not len(gaps([], stamps))
    assert not len(gaps([np.arange(6)], np.array([0, 0.001, 0.002, 0.018, 0.019, 0.02]))), "a video's step is no hole"


@pytest.mark.parametrize(
    ("first_s", "step_s", "length"), [(0.0, 1.0, "15 frames"), (0.0, 3.0, "15 frames"), (0.5, 0.1, "1.6 s")]
)
def test_a_hole_in_numbers_of_frames_is_told_in_frames(first_s: float, step_s: float, length: str) -> None:
    numbers = np.concatenate([np.arange(40), np.arange(55, 100)])
    (note,) = told_gaps([np.arange(85)], first_s + step_s * numbers, numbers)
    assert str(note).startswith(f"the recording stops for {length} before 55: ")


def test_sequences_are_not_joined_and_stand_apart(folder: Path) -> None:
    halves = [np.arange(6), np.arange(6, FRAMES)]
    with HERE.open() as workers:
        found = odometry(folder, halves, np.zeros(FRAMES), OdometryOptions(), workers)
    assert [5, 6] not in found.steps.pairs.tolist()
    assert found.world_from_cam[6, 0, 3] - found.world_from_cam[5, 0, 3] > 10
    assert np.array_equal(found.world_from_cam[6, :3, :3], np.eye(3))


def test_odometry_is_the_same_on_two_workers(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> None:
    runs = []
    for executor in (HERE, LocalExecutor(workers=2)):
        with executor.open() as workers:
            runs.append(odometry(folder, [np.arange(FRAMES)], np.arange(FRAMES) / 30, OdometryOptions(), workers))
    assert runs[0].world_from_cam.tobytes() == runs[1].world_from_cam.tobytes()
    assert same_bits(runs[0].steps, runs[1].steps)

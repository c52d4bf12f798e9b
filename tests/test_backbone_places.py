"""Places of loops judged together: those that bend the others are left out, and lost ones are found again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backbone_graphs import Drive, at_one_place, drive, field, round_trip, two_laps, with_weak_steps
from benchmarks.spoilt_graphs import mistaken_cases
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.solvers.backbone.evidence import EVEN, OutlierModel
from hodge_pipeline.solvers.backbone.fit import Fit, Reduced
from hodge_pipeline.solvers.backbone.inference import LoopJudge, _Trial
from hodge_pipeline.solvers.backbone.linear import Linear, linearise
from hodge_pipeline.solvers.backbone.places import Arrangement, Places
from hodge_pipeline.solvers.backbone.scales import Scales
from hodge_pipeline.solvers.backbone.trust import find_backbone
from test_backbone import NEVER_WORSE, chain_of
from test_solver_robust import rings, spoiled


def city(monkeypatch: pytest.MonkeyPatch, seed: int) -> Drive:
    """A long drive whose odometry turns by .7 degrees a step too much or too little, with wrong loops in groups."""
    monkeypatch.setattr("backbone_graphs.STEP", (0.012, 0.03))
    return at_one_place(drive(seed=seed, count=1200, world="town", wrong=0.0, loops=250), 600, group=5, seed=seed)


def test_a_mistaken_place_that_bends_the_others_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its loops vouch for each other where they bent the path: 5.6 m for 4 of odometry."""
    made = city(monkeypatch, 5)
    found = diagnose(made.graph)
    assert not (found.kept & ~made.right).any()
    assert found.kept[made.right].all()
    assert made.error_m(found.world_from_cam) < 2.5


def test_loops_of_little_evidence_wait_for_those_that_say_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """An odometry that turns by a degree a step refutes no loop over hundreds of steps: all that were a little likelier
    right counted at once, and a mistaken place among them bent the path until right ones did not fit, 5.9 m off.
    """
    monkeypatch.setattr("backbone_graphs.STEP", (0.02, 0.05))
    made = drive(world="town", count=1500, loops=500, wrong=0.4, in_groups=True, group=10)
    found = diagnose(made.graph)
    np.testing.assert_array_equal(found.kept, made.right)
    assert made.error_m(found.world_from_cam) < 1.5


def test_scales_by_which_places_are_likelier_count_not_those_of_the_likelier_loops() -> None:
    """By those of the loops 101 that join places a block apart counted, 58 right ones did not: 1.5 m, .4 with these."""
    name = "streets, 67% displaced, sigmas × 10"
    case = next(each for each in mistaken_cases(1) if each.name == name)
    np.testing.assert_array_equal(diagnose(case.graph).kept, case.right)


@pytest.mark.parametrize("seed", [4, 5, 9])
def test_rows_that_are_taken_for_the_next_ones_wait_for_stronger_loops(seed: int) -> None:
    """A wrong loop over many steps is within the odometry's uncertainty, and bent rows where it counted from the start:
    9 and 22 right loops were lost, 5 and 13 wrong ones kept, .7 and 1.1 m for .6 of odometry.
    """
    made = field(seed)
    found = diagnose(made.graph)
    np.testing.assert_array_equal(found.kept, made.right)
    assert made.error_m(found.world_from_cam) < 0.15


def test_places_whose_loops_are_not_confirmed_again_are_not_likely(monkeypatch: pytest.MonkeyPatch) -> None:
    """The log-odds of the places that they were dropped from made them win over a confirmed answer."""
    chain, found, agreed = chain_of(field(0).graph), [], _Trial.agreed

    def once(self: _Trial, *given: Any) -> Any:
        used, *rest = agreed(self, *given)
        found.append(used)
        return used & (len(found) == 1), *rest

    monkeypatch.setattr(_Trial, "agreed", once)
    outliers, none = OutlierModel.of(chain), np.zeros(len(chain.ends), bool)
    trial = _Trial.of(chain, LoopJudge(outliers, none, True), Scales(), EVEN)
    settled = trial.settled(*trial.grown(trial.standing_out, trial.start, trial.shares))
    assert len(found) == 2 and not settled.confirmed
    assert settled.of_places == -np.inf


@pytest.mark.parametrize(
    "made",
    [
        # steps would err by more than they move: 55 m
        lambda: at_one_place(drive(seed=12167, world="town", wrong=0.0, loops=60), 200, group=10, seed=12167),
        # a corridor of 50 steps that is mistaken for another is one testimony: 5 m
        lambda: drive(seed=12143, dimension=3, world="room", wrong=1.0, in_groups=True, group=50, loops=280),
    ],
)
def test_wrong_loops_alone_never_move_the_odometry(made: Callable[[], Drive]) -> None:
    graph = made()
    found = diagnose(graph.graph)
    assert graph.error_m(found.world_from_cam) <= NEVER_WORSE * graph.error_m(graph.odometry())


WEAK: dict[str, Any] = dict(count=500, world="town", loops=0, wrong=0.0)


@pytest.mark.parametrize(
    "made",
    [
        # a weak odometry bends from one mistaken place to the next: 53 m for 34 m
        lambda: at_one_place(with_weak_steps(drive(seed=1, **WEAK), 0.15, 1), 250, group=10, seed=1),
        # its drift hides that the poses meet none of the loops
        lambda: at_one_place(with_weak_steps(drive(seed=1, **WEAK | {"count": 1000}), 0.1, 1), 500, group=10, seed=1),
        # broken at one step, a path folds until loops between any places agree: 50 m for 2.6 m
        lambda: at_one_place(drive(seed=2, misstated=(10.0, 1.0), **WEAK | {"count": 700}), 800, seed=2),
    ],
)
def test_no_loop_is_used_where_loops_agree_between_any_places(made: Callable[[], Drive]) -> None:
    graph = made()
    found = diagnose(graph.graph)
    assert not (found.kept & ~graph.right).any()
    assert graph.error_m(found.world_from_cam) <= NEVER_WORSE * graph.error_m(graph.odometry())


@pytest.mark.parametrize("dimension", [2, 3])
def test_closing_errors_have_the_covariance_of_their_paths_and_loops(dimension: int) -> None:
    """By the factorised normal equations, for loops over parts of the path that are apart: their sum."""
    chain = chain_of(drive(dimension=dimension, wrong=0.0, loops=60).graph)
    linear = linearise(chain, chain.poses)
    first = int(np.argmin(chain.ends[:, 1]))
    apart = np.flatnonzero(chain.ends[:, 0] > chain.ends[first, 1])
    rows = np.sort(np.array([first, *apart[:1]]))
    expected = np.linalg.slogdet(linear.path(*chain.ends[rows].T) + linear.loops[1][rows])[1].sum()
    assert Fit(Reduced.of(chain, rows), linear).log_det == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("seed", [1, 4, 7])
def test_a_second_lap_over_the_first_says_more_than_one_mistaken_corridor(seed: int) -> None:
    """Each loop alone says next to nothing where odometry is off by as much as the lap is wide; with all of the lap one
    testimony none of 45 right loops was used, of seed 7.
    """
    made = two_laps(seed)
    found = diagnose(made.graph)
    assert (found.kept & ~made.right).sum() <= 1 and (found.kept & made.right).sum() >= made.right.sum() - 3
    assert made.error_m(found.world_from_cam) < 1.0 < 30 < made.error_m(made.odometry())


@pytest.mark.parametrize(("bias", "wrong"), [(0.01, 0.2), (0.003, 0.0)])
def test_a_short_lap_over_one_is_used_among_wrong_loops_and_by_stated_errors_far_too_large(
    bias: float, wrong: float
) -> None:
    """One corridor, in which each place counts where unused loops agree with no other, and all loops look random by
    errors of 5 m and .2 rad a step. None was used.
    """
    made = two_laps(1, lap=100, bias=bias, wrong=wrong)
    found = diagnose(made.graph)
    assert found.kept[made.right].all() and not (found.kept & ~made.right).any()
    assert made.error_m(found.world_from_cam) < 0.1 * made.error_m(made.odometry())


def test_many_right_places_are_not_outnumbered_by_wrong_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 2000 right ones over 80,000 steps 3 were used, after 320 CPU s: each alone says little beside 18,000."""
    met = list[tuple[Places, Linear]]()
    best = Places.best

    def noted(places: Places, linear: Linear) -> Arrangement:
        met.append((places, linear))
        return best(places, linear)

    monkeypatch.setattr(Places, "best", noted)
    assert find_backbone(drive(count=3000, world="town", loops=150, wrong=0.3).graph) is not None
    places, linear = met[0]
    places = replace(places, size=np.ones(len(places.size)), unused=np.ones(18_000, np.int64))
    count = len(places.loop)
    # so much that each is less likely than one of the 18,000, but not all of them together
    monkeypatch.setattr(Places, "_density", lambda places, fit: 10.0 * len(fit.reduced.active))
    found = best(places, linear)
    assert found.of_all > 3.0 and found.right.sum() == count > 20 and found.log_odds < 0
    assert found.of_all - found.log_odds == pytest.approx(np.log(np.arange(1, count + 1)).sum())


def test_a_lattice_with_wrong_steps_is_judged_by_its_cycles() -> None:
    """Rings joined to the next without diagonals: a backbone kept up to half of the wrong edges, lost half of the right
    ones and was 4 to 16 m off.
    """
    whole, truth = rings(200, 50)
    graph = whole.select(np.flatnonzero(np.isin(np.diff(whole.edges, axis=1)[:, 0], (1, 50))))
    graph, wrong = spoiled(graph, 0.1, 13)
    found = diagnose(graph)
    assert found.kept[wrong].sum() <= 1 + 0.2 * wrong.sum()  # some are the only edges of a vertex that may be right
    assert found.kept[~wrong].mean() > 0.99
    assert Drive(graph, truth, ~wrong).error_m(found.world_from_cam) < 0.5


def test_loops_between_places_at_random_are_used_by_chance_nowhere(data_dir: Path) -> None:
    """Of so many, some few lie near by chance, and agree with each other."""
    graph = read_graph(data_dir / "pose_graphs/slam_loops/robotcar/short/graph.g2o").graph
    assert graph is not None
    rng, edges = np.random.default_rng(1), graph.edges.copy()
    loops = np.flatnonzero(np.abs(np.diff(edges, axis=1)[:, 0]) != 1)
    edges[loops] = np.sort([rng.choice(graph.vertex_count, 2, replace=False) for _ in loops], axis=1)
    backbone = find_backbone(replace(graph, edges=edges))
    assert backbone is not None and not backbone.used[loops].any()


def test_one_loop_of_two_hundred_that_chance_explains_is_not_used() -> None:
    made = at_one_place(drive(seed=0, dimension=3, loops=1, wrong=0.0), 200, seed=0)
    assert not (diagnose(made.graph).kept & ~made.right).any()


def test_a_loop_of_a_right_place_that_the_poses_contradict_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its place says: loops of probability 0 were used."""
    made = drive(seed=4, wrong=0.1, loops=60)
    loops = np.flatnonzero(np.diff(made.graph.edges, axis=1)[:, 0] != 1)
    of, best = Places.of, Places.best

    def with_wrong_loops(start: Linear, *others: Any) -> Places:
        places = of(start, *others)
        return replace(places, members=np.where(made.right[start.chain.loop_edge], places.members, 0))

    def without_a_place(places: Places, linear: Linear) -> Arrangement:
        found = best(places, linear)
        return replace(found, right=found.right & (np.arange(len(found.right)) + 1 < len(found.right)))

    monkeypatch.setattr(Places, "of", with_wrong_loops)
    monkeypatch.setattr(Places, "best", without_a_place)
    backbone = find_backbone(made.graph)
    assert backbone is not None and backbone.used[loops].any()
    assert not backbone.used[~made.right].any()


def test_loops_that_a_long_way_makes_no_likelier_singly_are_judged_together() -> None:
    """After a circle whose heading errs by a radian nearly any loop fits, and none stood out: 62 m, as the odometry."""
    made = with_weak_steps(round_trip(2, 100, dimension=2, wrong=100), 0.04, 2)
    found = diagnose(made.graph)
    np.testing.assert_array_equal(found.kept, made.right)
    assert made.error_m(found.world_from_cam) < 0.1 * made.error_m(made.odometry())

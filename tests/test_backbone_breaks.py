"""Breaks: a step of the odometry that is wrong, and that confirmed loops contradict, is named, and no other."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from backbone_graphs import WORLDS, broken, drive, spanned
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.solvers.backbone.trust import find_backbone
from hodge_pipeline.types import ViewGraph

BROKEN_TOWNS: dict[str, tuple[int, dict[str, Any]]] = {
    "in places that tell little": (82, {"seed": 323, "count": 200, "dimension": 3, "wrong": 0.6, "in_groups": True}),
    "under every right loop": (143, {"seed": 626, "count": 200, "wrong": 0.2}),
    "at a corner": (259, {"seed": 658, "count": 400, "loops": 200, "wrong": 0.0, "in_groups": True}),
    "under loops of one place": (214, {"seed": 659, "count": 400, "dimension": 3, "loops": 200, "wrong": 0.6}),
}


@pytest.mark.parametrize("where", BROKEN_TOWNS)
def test_a_broken_step_is_named(where: str) -> None:
    step, kind = BROKEN_TOWNS[where]
    made = drive(**{"world": "town", "loops": 100, **kind})
    backbone = find_backbone(broken(made, step, seed=kind["seed"]))
    assert backbone is not None
    assert np.flatnonzero(backbone.steps & ~backbone.used).tolist() == [step]


BROKEN = [
    ("ring", 2, 400, 20, 0.4),
    ("room", 3, 400, 80, 0.4),
    ("corridor", 2, 400, 80, 0.0),
    ("town", 2, 1000, 200, 0.6),
]


@pytest.mark.parametrize(("world", "dimension", "count", "loops", "wrong"), BROKEN)
def test_a_broken_step_is_named_and_no_other(world: str, dimension: int, count: int, loops: int, wrong: float) -> None:
    made = drive(world=world, dimension=dimension, count=count, loops=loops, wrong=wrong)
    step = int(np.random.default_rng(count + loops).choice(spanned(made)))
    found = diagnose(broken(made, step))
    assert np.flatnonzero(found.verdict[: count - 1] == "wrong").tolist() == [step]
    assert "confirmed loops over it contradict" in found.reason[step]
    assert made.error_m(found.world_from_cam) < 1.2 * made.error_m(diagnose(made.graph).world_from_cam)


HIDDEN = [
    ({"seed": 13, "world": "town", "dimension": 3, "count": 200, "loops": 100, "wrong": 0.0}, 187),  # drift hides it
    ({"seed": 14, "world": "town", "count": 1000, "loops": 500, "wrong": 0.4, "in_groups": True}, 230),  # one place
    ({"seed": 15, "world": "town", "count": 1000, "loops": 200, "wrong": 0.4}, 380),  # loops' scale learned too large
]


@pytest.mark.parametrize(("kind", "step"), HIDDEN)
def test_a_broken_step_that_loops_hide_is_named(kind: dict[str, Any], step: int) -> None:
    made = drive(**kind)
    backbone = find_backbone(broken(made, step, seed=kind["seed"]))
    assert backbone is not None
    assert np.flatnonzero(backbone.steps & ~backbone.used).tolist() == [step]


def test_two_broken_steps_are_named() -> None:
    made = drive(loops=200)
    once = broken(made, 90)
    found = diagnose(broken(replace(made, graph=once), 310, seed=1))
    assert np.flatnonzero(found.verdict[:399] == "wrong").tolist() == [90, 310]


@pytest.mark.parametrize("wrong", [0.0, 0.5])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_robot_that_was_carried_or_thought_that_it_stood_still_goes_on_where_loops_say(
    dimension: int, wrong: float
) -> None:
    made = drive(seed=0, count=500, world="town", wrong=wrong, loops=120, dimension=dimension)
    standing = made.graph.i_from_j.copy()
    standing[200:215] = np.eye(4)
    kept = np.delete(np.arange(500), np.arange(200, 215))
    rows = np.isin(made.graph.edges, kept).all(axis=1)
    edges = np.concatenate([made.graph.edges[rows], [[199, 215]]])
    motion = np.concatenate([made.graph.i_from_j[rows], made.graph.i_from_j[199:200]])  # a step like the one before
    information = np.concatenate([made.graph.information[rows], made.graph.information[199:200]])
    carried = ViewGraph.from_edges(
        np.arange(485), np.searchsorted(kept, edges), motion, information, dimension=dimension
    )
    for drove in (
        replace(made, graph=replace(made.graph, i_from_j=standing)),
        replace(made, graph=carried, truth=made.truth[kept]),
    ):
        backbone = find_backbone(drove.graph)
        assert backbone is not None and backbone.chain.broken.any()
        assert drove.error_m(backbone.world_from_cam) < 0.5 * drove.error_m(drove.odometry())


def test_where_odometry_notices_its_breaks_loops_call_no_step_wrong() -> None:
    graph = broken(drive(loops=200), 90)
    assert np.flatnonzero(diagnose(graph).verdict[:399] == "wrong").tolist() == [90]
    assert diagnose(graph, DiagnosisOptions(trust="sequential", most_breaks=0)).kept[:399].all()


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.9, 1.0])
def test_no_right_step_is_called_wrong(wrong: float) -> None:
    for seed in range(4):
        made = drive(seed=seed, world=WORLDS[seed], wrong=wrong, in_groups=bool(seed % 2), count=200, loops=60)
        backbone = find_backbone(made.graph)
        assert backbone is None or backbone.used[:199].all()

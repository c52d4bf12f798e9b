from __future__ import annotations

import numpy as np
import pytest

from benchmarks.edge_scores import precision_and_recall
from diagnosis_graphs import every_pair_tried
from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.scene_model import learn_upright
from hodge_pipeline.types import Bools, Floats, ViewGraph

DOWN = np.array([0.0, 1.0, 0.0])
"""In the axes of a camera: x to the right, y down, z forward."""


def _carried(count: int, tilt: float = 0.3, roll: float = 0.05) -> Floats:
    """Cameras in a world whose z is up, turned anyhow about it."""
    rng = np.random.default_rng(0)
    level = se3.so3_exp(np.array([[-np.pi / 2, 0.0, 0.0]]))[0]
    yaw = se3.so3_exp(np.outer(rng.uniform(-np.pi, np.pi, count), [0, 0, 1]))
    held = se3.so3_exp(np.stack([rng.normal(0, tilt, count), np.zeros(count), rng.normal(0, roll, count)], 1))
    return np.asarray(yaw @ level @ held)


def _groups(count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.arange(count) // 12


def test_the_way_cameras_are_held_is_found() -> None:
    rotations = _carried(60)
    law = learn_upright(rotations, _groups(60))
    assert abs(law.up @ DOWN) > 0.97 and law.share > 0.95
    up = law.world_up(rotations, np.zeros(60, int))
    assert np.degrees(np.arccos(np.abs(up[0, 2]))) < 5, "z is up or down"
    spread = np.sqrt((0.05**2 + 0.3**2) / 2 + 0.2**2)
    assert law.concentration == pytest.approx(spread**-2, rel=0.3)


def test_a_part_laid_on_its_head_stands_out_of_what_its_neighbourhoods_show() -> None:
    rotations = _carried(60)
    over = np.arange(60) >= 40
    rotations[over] = se3.so3_exp(np.array([[0.0, np.pi, 0.0]])) @ rotations[over]
    law = learn_upright(rotations, _groups(60))
    nats = law.log_evidence(rotations, law.world_up(rotations, np.zeros(60, int)))
    assert nats[over].max() < -3 and np.median(nats[~over]) > -1.5
    apart = law.log_evidence(rotations, law.world_up(rotations, over.astype(int)))
    assert np.median(apart[over]) > -1.5, "in a piece of its own it stands as well as any"


def test_cameras_that_turn_freely_say_nothing() -> None:
    rotations = se3.so3_exp(np.random.default_rng(1).normal(0, 2, (60, 3)))
    law = learn_upright(rotations, _groups(60))
    assert law.share == 0
    np.testing.assert_array_equal(law.log_evidence(rotations, law.world_up(rotations, np.zeros(60, int))), 0)


def test_single_views_and_frames_of_one_rotation_are_no_trouble() -> None:
    rotations = np.tile(np.eye(3), (4, 1, 1))
    for piece in (np.arange(4), np.zeros(4, int)):
        law = learn_upright(rotations, piece)
        assert np.abs(law.log_evidence(rotations, law.world_up(rotations, piece))).max() < 0.1


def _hung_on_its_head(seed: int) -> tuple[ViewGraph, Bools]:
    """Half a walk is joined to the other half by many wrong edges that agree to hang it from the ceiling."""
    graph, right, poses = every_pair_tried(seed, wrong_steps=0.0, chance=0.05, alike=0)
    i, j = graph.edges.T
    half = graph.vertex_count // 2
    across = (i < half) & (j >= half)
    over = se3.from_parts(se3.so3_exp(np.array([[np.pi, 0.0, 0.0]])), np.array([[0.5, 0.3, 1.0]]))[0]
    wrong = across & (np.random.default_rng(seed).random(len(i)) < 0.6)
    motion = graph.i_from_j.copy()
    errors = se3.exp(np.random.default_rng(seed + 1).normal(size=(int(wrong.sum()), 6)) * np.repeat([0.015, 0.02], 3))
    motion[wrong] = se3.inverse(poses[i[wrong]]) @ over @ poses[j[wrong]] @ errors
    return ViewGraph.from_edges(graph.vertex_ids, graph.edges, motion), right & ~wrong


def test_many_edges_that_agree_to_hang_a_part_from_the_ceiling_do_not_outvote_fewer_that_stand() -> None:
    graph, right = _hung_on_its_head(1)
    i, j = graph.edges.T
    across = (i < 25) & (j >= 25)
    found = diagnose(graph)
    precision, recall = precision_and_recall(found.kept, right)
    assert (across & ~right).sum() > (across & right).sum() > 10, "the wrong ones are more"
    assert precision > 0.95 and recall > 0.9

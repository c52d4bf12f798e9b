from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.edge_scores import precision_and_recall
from diagnosis_graphs import every_pair_tried, measured, near_pairs, poses_on_a_ring, spoiled
from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import in_vertex_order
from hodge_pipeline.diagnosis import evidence
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.evidence import gather, order_prior
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.scene_model import Joining, learn_joining
from hodge_pipeline.types import Floats


def _poses(count: int, seed: int) -> Floats:
    return se3.exp(np.random.default_rng(seed).normal(size=(count, 6)) * np.repeat([1.0, 2.0], 3))


def test_the_law_of_joining_is_found_again() -> None:
    true = Joining(1.0, np.array([5.0, np.log(2.0), np.log(3.0)]))
    poses = _poses(80, 0)
    joined = np.triu(np.random.default_rng(1).random((80, 80)) < true.between(poses, poses), 1)
    found = learn_joining(poses, np.zeros(80, int), joined | joined.T, 1.0)
    assert np.abs(found.between(poses, poses) - true.between(poses, poses)).mean() < 0.03
    np.testing.assert_allclose(found.x[1:], true.x[1:], atol=0.2)


@pytest.mark.parametrize("joined", [0.3, 0.6, 0.8])
def test_the_order_counts_also_where_most_pairs_are_joined_and_not_where_it_tells_nothing(joined: float) -> None:
    rng = np.random.default_rng(0)
    pairs = np.stack(np.triu_indices(40, 1), 1)
    near = pairs[:, 1] - pairs[:, 0] <= 2
    by_chance = rng.random(len(pairs)) < joined
    edges = pairs[near | by_chance]
    prior = order_prior(edges, 40)
    gap = edges[:, 1] - edges[:, 0]
    assert prior[gap == 1].min() > 0.9 and prior[gap > 20].mean() < 0.3
    assert np.ptp(order_prior(pairs[by_chance], 40)) == 0 and np.ptp(order_prior(pairs, 40)) == 0


def test_the_order_counts_where_every_pair_is_joined() -> None:
    """Each view is right with the next five, and any other pair has an edge all the same."""
    pairs = np.stack(np.triu_indices(24, 1), 1)
    clean = measured(poses_on_a_ring(24), pairs)
    graph, right = spoiled(clean, np.flatnonzero(pairs[:, 1] - pairs[:, 0] > 5))
    found = diagnose(graph)
    precision, recall = precision_and_recall(found.kept, right)
    assert precision > 0.95 and recall > 0.95
    prior = gather(graph, DiagnosisOptions())[0].prior
    gap = pairs[:, 1] - pairs[:, 0]
    assert prior[gap == 1].min() > 0.8 and prior[gap > 8].max() < 0.2
    shuffled = in_vertex_order(replace(graph, edges=np.random.default_rng(0).permutation(24)[pairs]))[0]
    assert np.ptp(gather(shuffled, DiagnosisOptions())[0].prior) == 0


def test_the_order_is_that_of_the_ids_and_not_of_the_rows() -> None:
    """A file may list its frames in any order: half of the edges kept were wrong ones."""
    graph, _, _ = every_pair_tried(0, views=30)
    order = np.random.default_rng(0).permutation(graph.vertex_count)
    shuffled = replace(graph, vertex_ids=graph.vertex_ids[order], edges=np.argsort(order)[graph.edges])
    found, expected = diagnose(shuffled), diagnose(graph)
    np.testing.assert_array_equal(found.verdict, expected.verdict)
    np.testing.assert_array_equal(found.probability, expected.probability)
    np.testing.assert_allclose(found.world_from_cam, expected.world_from_cam[order], atol=1e-9)


def test_a_wrong_step_between_consecutive_views_does_not_outvote_the_loops() -> None:
    graph, right, poses = every_pair_tried(3)
    found = diagnose(graph)
    precision, recall = precision_and_recall(found.kept, right)
    assert precision > 0.95 and recall > 0.95
    i, j = graph.edges[right].T
    relative = se3.inverse(found.world_from_cam[i]) @ found.world_from_cam[j]
    left = relative[:, :3, 3] - (se3.inverse(poses[i]) @ poses[j])[:, :3, 3]
    assert (np.linalg.norm(left, axis=1) < 0.3).mean() > 0.95


def test_edges_that_repeat_or_join_a_vertex_to_itself_tell_nothing_of_the_order() -> None:
    """One of the latter a vertex took a graph without an order for a sequence: priors from .05 to .98."""
    rng, count = np.random.default_rng(0), 60
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    edges = pairs[rng.random(len(pairs)) < 0.3]
    near = edges[np.diff(edges, axis=1)[:, 0] <= 4]
    own = np.repeat(np.arange(count), 2).reshape(-1, 2)
    for more in (own, np.repeat(near, 4, axis=0)):
        prior = order_prior(np.concatenate([edges, more]), count)[: len(edges)]
        np.testing.assert_array_equal(prior, order_prior(edges, count))


def test_a_far_pair_that_repeats_is_tried_once() -> None:
    """Twelve loops stated thirty times made a walk one of which every pair was tried."""
    steps = np.arange(40)[:, None] + [0, 1]
    far = np.stack([np.arange(12), np.arange(12) + 28], axis=1)
    assert not evidence.every_pair_tried(np.concatenate([steps, np.repeat(far, 30, axis=0)]), 41)


def test_unknown_information_is_unknown_of_half_angles_too() -> None:
    graph, _ = spoiled(measured(poses_on_a_ring(40), near_pairs(40, 3), 0, noise=3), np.arange(0, 120, 4), 0)
    halves = replace(graph, information=np.tile(np.diag([0.25] * 3 + [1.0] * 3), (120, 1, 1)))
    whole = replace(graph, information=np.tile(np.eye(6), (120, 1, 1)))
    found, other = (diagnose(each, DiagnosisOptions(trust="none")) for each in (whole, halves))
    np.testing.assert_array_equal(found.probability, other.probability)

"""Clusters of poses moved as rigid bodies, and graphs whose pieces drift while they grow."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from diagnosis_graphs import SIGMA, measured, near_pairs, poses_on_a_ring
from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis import robust_poses
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.diagnosis.result import CONSISTENT
from hodge_pipeline.diagnosis.robust_poses import Quotient, clustered
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import ViewGraph


@given(seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_clusters_that_were_moved_are_moved_back(seed: int) -> None:
    rng, count = np.random.default_rng(seed), 40
    true, edges = poses_on_a_ring(count, seed), near_pairs(count, 3)
    graph = measured(true, edges, noise=0.0)
    ones, cluster = np.ones(len(edges)), np.arange(count) // 8
    astray = se3.exp(0.2 * rng.normal(size=(5, 6)))[cluster] @ true
    parts = Quotient.of(graph, Noise(SIGMA[0] * ones, SIGMA[3] * ones), ones > 0, cluster, astray)
    found = parts.whole(solve(parts.graph, start=parts.poses).world_from_cam)
    np.testing.assert_allclose(se3.inverse(found[:1]) @ found, se3.inverse(true[:1]) @ true, atol=1e-6)


def test_clusters_hold_together_and_none_reaches_over_an_edge_that_is_not_firm(monkeypatch) -> None:
    monkeypatch.setattr(robust_poses, "CLUSTERS", 6)
    edges, firm = near_pairs(60, 2), np.ones(120, bool)
    firm[(edges.min(axis=1) < 30) != (edges.max(axis=1) < 30)] = False
    found = clustered(edges, firm, 60)
    assert not set(found[:30]) & set(found[30:]) and 2 <= found.max() + 1 < 20
    inside = edges[firm & (found[edges[:, 0]] == found[edges[:, 1]])]
    assert len(np.unique(connected_components(inside, 60))) == found.max() + 1


def test_a_long_loop_that_drifted_is_closed_and_nobody_blamed(monkeypatch) -> None:
    monkeypatch.setattr(robust_poses, "CLUSTERS", 60)
    k = np.arange(600)
    angle = 2 * np.pi * k / 600
    turn = se3.so3_exp(np.outer(angle, [0, 0, 1]))
    poses = se3.from_parts(turn, 60 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    graph = measured(poses, near_pairs(600, 2), noise=2.0)
    found = diagnose(ViewGraph.from_edges(k, graph.edges, graph.i_from_j))
    assert set(found.verdict) == {CONSISTENT} and found.piece.max() == 0

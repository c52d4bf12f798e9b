"""Pairs that slide on each other along a tunnel stay at their guess in that direction, whichever solver follows."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.complex.free_directions import free_direction_notes
from hodge_pipeline.registration.acceptance import Acceptance
from hodge_pipeline.registration.sliding import held_where_sliding
from hodge_pipeline.solvers.maximum_likelihood import MaximumLikelihoodSolver
from hodge_pipeline.types import Edges, Floats, Frame, PointCloud, Registration, ViewGraph
from hodge_pipeline.uses.trajectory import refine_trajectory

WEAK_X = np.diag([100.0, 100, 100, 1, 40, 40])


def registered(information: Floats, shift_m: float) -> Edges:
    motion = se3.from_parts(np.eye(3), np.array([shift_m, 0.1, 0.0]))
    found = Registration(motion, information, 0.9, 0.01, 500, 5, True)
    return Edges.of(np.array([[0, 1], [0, 4]]), "sequential").with_registrations([found, found])


def test_what_slides_stays_at_its_guess_and_the_rest_is_measured() -> None:
    guesses = np.tile(se3.from_parts(np.eye(3), np.array([1.0, 0.0, 0.0])), (2, 1, 1))
    held = held_where_sliding(registered(WEAK_X, 0.2), guesses, 0.02)
    assert held.i_from_j[:, :3, 3] == pytest.approx(np.tile([1.0, 0.1, 0.0], (2, 1)), abs=1e-12)
    firm = registered(np.diag([100.0, 100, 100, 10, 40, 40]), 0.2)
    assert np.array_equal(held_where_sliding(firm, guesses, 0.02).i_from_j, firm.i_from_j)
    reasons = Acceptance(min_spread=0.02).reasons(registered(WEAK_X, 0.2)).tolist()
    assert reasons == ["", "what they share lets them slide"]


def rings(world_from_scan: Floats, seed: int) -> PointCloud:
    """What 16 beams see of a smooth tunnel along x, 4 m wide, 3 m high, as far as 12 m."""
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    up = np.radians(np.linspace(-24, 24, 16))
    rays = np.stack(
        [np.outer(np.cos(up), np.cos(turn)), np.outer(np.cos(up), np.sin(turn)), np.outer(np.sin(up), np.ones(400))],
        axis=2,
    ).reshape(-1, 3)
    across = rays @ world_from_scan[:3, :3].T
    origin = world_from_scan[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = (np.sign(across[:, 1]) * 2.0 - origin[1]) / across[:, 1]
        floor = (np.sign(across[:, 2]) * 1.5 - origin[2]) / across[:, 2]
    ranges = np.minimum(wall, floor) + np.random.default_rng(seed).normal(0, 0.02, len(rays))
    seen = ranges < 12.0
    return PointCloud((rays[seen] * ranges[seen, None]).astype(np.float32))


@pytest.mark.parametrize("solver", ["poisson", "maximum_likelihood"])
def test_a_tunnel_makes_a_trajectory_no_worse(solver: str) -> None:
    count = 14
    truth = np.tile(np.eye(4), (count, 1, 1))
    truth[:, 0, 3] = 0.5 * np.arange(count)
    sigma = np.array([0.002, 0.002, 0.002, 0.01, 0.04, 0.04])
    given = truth @ se3.exp(np.random.default_rng(1).normal(0, 1, (count, 6)) * sigma)
    frames = [Frame(row, float(row), read_points=partial(rings, truth[row], row)) for row in range(count)]
    overrides = [f"solver.stage={solver}", "recording.level=off", "start.distance_m=0", "executor.workers=0"]
    found = refine_trajectory(given, frames, overrides=overrides)
    along, aside = (slice(0, 1), slice(1, 3))
    error_m, before_m = (np.abs(poses[:, :3, 3] - truth[:, :3, 3]) for poses in (np.asarray(found.poses), given))
    assert found.decision.change is not None and found.decision.change.translation_m < 0.1  # metres, where they slid
    assert error_m[:, along].max() < before_m[:, along].max() + 1e-3 and error_m[:, aside].max() < 0.055


@pytest.mark.parametrize("tails", ["gaussian", "student"])
def test_a_frame_that_only_sees_a_wall_is_named_with_the_way_it_slides(tails: str) -> None:
    poses = se3.exp(np.random.default_rng(1).normal(size=(4, 6)))
    edges = np.array([[0, 1], [1, 2], [0, 2], [2, 3]])
    held = np.tile(np.diag([9.0, 9, 9, 4, 4, 4]), (4, 1, 1))
    bare = held.copy()
    bare[3, 4, 4] = 0  # frame 3 lies against a wall: nothing holds it along its own y
    motions = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    graph = ViewGraph.from_edges(np.arange(4), edges, motions, bare)
    notes = MaximumLikelihoodSolver(tails=tails).solve(graph, poses).notes
    (told,) = (note for note in notes if note.startswith("no edge measures"))
    assert "1 frame," in told and "3 (sliding along (0.00, 1.00, 0.00))" in told
    for known in (held, np.tile(np.eye(6), (4, 1, 1))):
        assert free_direction_notes(ViewGraph.from_edges(np.arange(4), edges, motions, known)) == ()
    rest = se3.exp(1e-7 * np.random.default_rng(2).normal(size=(4, 6)))  # a camera at rest: no edge has a length
    assert free_direction_notes(ViewGraph.from_edges(np.arange(4), edges, rest, held)) == ()
    assert "3 (sliding" in free_direction_notes(ViewGraph.from_edges(np.arange(4), edges, rest, bare))[0]

"""Candidates by what a place looks like: found from any heading, beside the old track, whatever the poses say."""

from __future__ import annotations

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.pairs.drift import DriftEdges
from hodge_pipeline.pairs.place import PlaceEdges
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.start.sweeps import SweepsStart
from hodge_pipeline.types import CloudSet, Floats, Frame, PointCloud

PLACES, REACH = 30, 5


def place(number: int) -> Floats:
    """Points (N, 3) on forty poles and walls within 30 m of a place, and on the ground, z up."""
    rng = np.random.default_rng(number)
    turn, range_m = rng.uniform(0, 2 * np.pi, 40), rng.uniform(5, 30, 40)
    foot = np.stack([range_m * np.cos(turn), range_m * np.sin(turn)], axis=1)
    along = rng.uniform(-1, 1, (40, 60, 1)) * rng.uniform(-3, 3, (40, 1, 2))
    height = rng.uniform(0, 1, (40, 60, 1)) * rng.uniform(1, 9, (40, 1, 1))
    stands = np.concatenate([foot[:, None] + along, height], axis=2).reshape(-1, 3)
    ground = np.concatenate([rng.uniform(-30, 30, (2000, 2)), np.zeros((2000, 1))], axis=1)
    return np.concatenate([stands, ground])


def scan(number: int, heading_deg: float = 0.0, aside_m: float = 0.0) -> PointCloud:
    """What a scanner 1.9 m over the ground sees of a place, noise of 3 cm."""
    twist = np.array([0, 0, np.radians(heading_deg), 0, 0, 0])
    at = se3.from_parts(np.eye(3), np.array([0, aside_m, 1.9])) @ se3.exp(twist)
    points = se3.transform(se3.inverse(at), place(number))
    noise = np.random.default_rng([number, 1]).normal(0, 0.03, points.shape)
    return PointCloud((points + noise).astype(np.float32))


def frames(count: int, sequence: str = "") -> list[Frame]:
    return [Frame(row, float(row), sequence=sequence) for row in range(count)]


LOST = np.tile(np.eye(4), (PLACES + 2, 1, 1))
LOST[:, 0, 3] = np.arange(PLACES + 2) * 500.0


@pytest.mark.parametrize(("heading_deg", "aside_m"), [(0.0, 0.0), (180.0, 0.0), (77.0, 1.5), (-130.0, -1.5)])
def test_places_are_found_again_wherever_poses_have_drifted_to(heading_deg: float, aside_m: float) -> None:
    again = [scan(number, heading_deg, aside_m) for number in (3, 17)]
    clouds = CloudSet.from_clouds([*(scan(number) for number in range(PLACES)), *again])
    found = PlaceEdges(reach=REACH).propose(frames(PLACES + 2), clouds, LOST)
    best = found.overlap[(found.pairs == [3, PLACES]).all(axis=1) | (found.pairs == [17, PLACES + 1]).all(axis=1)]
    assert len(best) == 2 and (best >= 0.8).all()
    strangers = set(map(tuple, found.pairs.tolist())) - {(3, PLACES), (17, PLACES + 1)}
    assert len(strangers) <= 3  # of 435 pairs of places that have nothing in common
    nothing_near = DriftEdges().propose(frames(PLACES + 2), clouds, LOST)
    assert not (nothing_near.pairs[:, 1] >= PLACES).any()


def test_neighbours_in_a_sequence_are_no_loop_but_those_of_another_are() -> None:
    clouds = CloudSet.from_clouds([scan(number, 10.0 * copy) for number in range(3) for copy in range(3)])
    assert not len(PlaceEdges(reach=9).propose(frames(9), clouds, LOST[:9]))
    mixed = [*frames(3, "monday"), *frames(9, "tuesday")[3:6], *frames(9, "friday")[6:]]
    same = [scan(5, heading) for heading in (0.0, 50.0, 100.0)]
    clouds = CloudSet.from_clouds([*same, *(scan(5, heading) for heading in (20.0, 90.0, 200.0)), *same])
    pairs = PlaceEdges(reach=9).propose(mixed, clouds, LOST[:9]).pairs
    assert len(pairs) and (pairs[:, 0] // 3 != pairs[:, 1] // 3).all()


def test_the_recipe_for_sweeps_looks_for_places() -> None:
    start = load_recipe("lidar", []).start
    assert isinstance(start, SweepsStart)
    assert [type(each) for each in start.unordered.loops] == [DriftEdges, PlaceEdges]

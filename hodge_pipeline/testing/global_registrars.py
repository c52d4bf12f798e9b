"""The contract of global registrars, one named property after the other."""

from __future__ import annotations

import pickle

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.stages import GlobalRegistrar
from hodge_pipeline.testing.stage import PAIR, TURNED, Contract, nothing, off_by, room, seen_from
from hodge_pipeline.types import Match, PointCloud

ROUGH = 0.05, 0.1
"""Radians and metres from which every registrar finds the motion."""


def _matched(registrar: GlobalRegistrar, target: PointCloud, source: PointCloud) -> Match:
    """The match, after asserting that it has the form of one and that nothing given was changed."""
    before = pickle.dumps((target, source))
    found = registrar.match(registrar.describe(target), registrar.describe(source))
    assert pickle.dumps((target, source)) == before, "it changes the clouds that it is given"
    assert isinstance(found, Match), f"match gives a {type(found).__name__}"
    assert found.i_from_j.shape == (4, 4) and found.i_from_j.dtype == np.float64, "i_from_j is float64 (4, 4)"
    assert se3.is_motion(found.i_from_j, 1e-6), "i_from_j is not a rigid motion"
    assert 0 <= found.inliers <= found.matches, f"{found.inliers} inliers of {found.matches} matches"
    return found


def _finds_the_motion(registrar: GlobalRegistrar) -> None:
    scene = room()
    poses = scene.world_from_cam[list(PAIR)]
    truth = se3.inverse(poses[0]) @ poses[1] @ se3.inverse(TURNED)
    found = _matched(registrar, scene.clouds[PAIR[0]], seen_from(scene.clouds[PAIR[1]], TURNED))
    angle, distance_m = off_by(found.i_from_j, truth)
    near = angle <= ROUGH[0] and distance_m <= ROUGH[1]
    assert near, f"two views of a room, far from each other's axes: off by {angle:.2g} rad and {distance_m:.2g} m"
    assert found.inliers > 0, "found, but without an inlier"


def _repeats_itself(registrar: GlobalRegistrar) -> None:
    target, source = (room().clouds[row] for row in PAIR)
    one, two = (_matched(registrar, target, source) for _ in range(2))
    assert pickle.dumps(one) == pickle.dumps(two), "the same pair gives another answer when matched again"


def _describes_in_what_can_be_stored(registrar: GlobalRegistrar) -> None:
    described = [registrar.describe(room().clouds[row]) for row in PAIR]
    stored = pickle.loads(pickle.dumps(described))
    one, two = registrar.match(*described), registrar.match(*stored)
    assert pickle.dumps(one) == pickle.dumps(two), "described clouds that were stored match otherwise"


def _finds_nothing_in_nothing(registrar: GlobalRegistrar) -> None:
    cloud = room().clouds[PAIR[0]]
    few = PointCloud(cloud.points_in_cam[:3], None, None, nothing().landmarks)
    for what, other in (("an empty cloud", nothing()), ("a cloud of three points", few)):
        for target, source in ((cloud, other), (other, cloud)):
            found = _matched(registrar, target, source)
            assert found.inliers == 0, f"{what}: {found.inliers} matches agree"
            assert np.array_equal(found.i_from_j, np.eye(4)), f"{what}: the motion is not the identity"


check_global_registrar = Contract(
    GlobalRegistrar,
    {
        "known motion": _finds_the_motion,
        "the same answer again": _repeats_itself,
        "stored descriptions": _describes_in_what_can_be_stored,
        "nothing in common": _finds_nothing_in_nothing,
    },
)
"""Checks a global registrar on two views of a room."""

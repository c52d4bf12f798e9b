"""The contract of refiners, one named property after the other."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.stages import Refiner
from hodge_pipeline.testing.stage import Contract, room
from hodge_pipeline.types import Floats


def _refined(refiner: Refiner, given: Floats) -> Floats:
    """The poses, after asserting that there is one for each frame and that nothing given was changed."""
    before, advanced = given.copy(), list[int]()
    poses = refiner.refine(room().frames, given, advanced.append)
    assert np.array_equal(given, before), "it changes the poses that it is given"
    assert sum(advanced) == len(given), f"`advance` heard of {sum(advanced)} of {len(given)} frames"
    assert poses.shape == given.shape and poses.dtype == np.float64, f"poses are {poses.dtype} {poses.shape}"
    assert se3.is_motion(poses, 1e-6).all(), "a pose is not a rigid motion"
    return poses


def _repeats_itself(refiner: Refiner) -> None:
    one, two = (_refined(refiner, room().world_from_cam) for _ in range(2))
    assert np.array_equal(one, two), "the same poses give other bits when refined again"


def _does_no_harm(refiner: Refiner) -> None:
    truth = room().world_from_cam
    noise = np.random.default_rng(0).normal(size=(len(truth), 6))
    given = truth @ se3.exp(0.01 * noise)
    before, after = (_error(poses, truth) for poses in (given, _refined(refiner, given)))
    assert after <= before, f"poses that are {before:.2g} off (radians and metres) are {after:.2g} off afterwards"


def _error(poses: Floats, truth: Floats) -> float:
    """RMS of what the motion from each frame to the next is off by."""
    steps, true_steps = (se3.inverse(given[:-1]) @ given[1:] for given in (poses, truth))
    return float(np.sqrt(np.mean(se3.log(se3.inverse(true_steps) @ steps) ** 2)))


check_refiner = Contract(
    Refiner,
    {
        "the same bits again": _repeats_itself,
        "no harm": _does_no_harm,
    },
)
"""Checks a refiner on twelve frames of a room."""

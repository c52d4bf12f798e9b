"""Given poses that were read in another convention than they were written in."""

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.refine.conventions import ROBOT_FROM_CAM, explained
from hodge_pipeline.types import Floats, Ints


def registered(seed: int) -> tuple[Floats, Ints, Floats]:
    """A path of 20 poses that turns and moves, and the true motions of its steps."""
    rng = np.random.default_rng(seed)
    steps = se3.exp(rng.normal(0, 1, (20, 6)) * np.repeat([0.08, 0.05], 3))
    poses = steps.copy()
    for row in range(1, len(poses)):
        poses[row] = poses[row - 1] @ steps[row]
    edges = np.column_stack([np.arange(19), np.arange(1, 20)])
    return poses, edges, steps[1:]


def without_turns(poses: Floats) -> Floats:
    return se3.from_parts(np.broadcast_to(np.eye(3), (len(poses), 3, 3)), poses[:, :3, 3])


def w_first(poses: Floats) -> Floats:
    """What a reader of x first makes of quaternions written w first."""
    return se3.from_quat_xyzw(poses[:, :3, 3], np.roll(se3.to_quat_xyzw(poses), 1, axis=1))


WRITTEN = {
    "quaternions with w first": w_first,
    "OpenGL's": lambda poses: poses @ np.diag([1.0, -1, -1, 1]),
    "a robot": lambda poses: poses @ se3.inverse(ROBOT_FROM_CAM),
    "beside a scanner": lambda poses: poses @ ROBOT_FROM_CAM,
    "camera from world": se3.inverse,
    "millimetres": lambda poses: se3.rescaled(poses, 1000),
    "all have the same rotation": without_turns,
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", WRITTEN)
def test_a_wrong_convention_is_named(name: str, seed: int) -> None:
    poses, edges, motions = registered(seed)
    noisy = poses @ se3.exp(np.random.default_rng(9).normal(0, 0.005, (20, 6)))
    assert name in explained(WRITTEN[name](noisy), edges, motions, 1.0).wrong
    right = explained(noisy, edges, motions, 1.0)
    assert not right.wrong and right.missed < 0.5


@pytest.mark.parametrize("times", [5.0, 8.0])
def test_poses_of_another_scale_are_no_millimetres(times: float) -> None:
    """Of a camera that turns more than it moves, lengths of next to nothing miss less than those of a wrong scale."""
    poses, edges, motions = registered(0)
    assert not explained(se3.rescaled(poses, times), edges, motions, 1.0).wrong


def test_poor_poses_are_of_no_other_convention() -> None:
    """Noise larger than the steps; a camera that stands still, or slides without a turn."""
    poses, edges, motions = registered(0)
    noisy = poses @ se3.exp(np.random.default_rng(1).normal(0, 0.2, (20, 6)))
    found = explained(noisy, edges, motions, 1.0)
    assert found.is_unlike and not found.wrong
    still = np.tile(np.eye(4), (20, 1, 1))
    assert not explained(still, edges, motions, 1.0).wrong
    rng = np.random.default_rng(2)
    slid = without_turns(poses)
    rough = se3.inverse(slid[:-1]) @ slid[1:] @ se3.exp(rng.normal(0, 0.002, (19, 6)))
    assert not explained(slid, edges, rough, 1.0).wrong
    assert not explained(se3.inverse(poses), edges[:3], motions[:3], 1.0).wrong, "too few edges"

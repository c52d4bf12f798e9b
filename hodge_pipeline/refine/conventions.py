"""Whether given poses explain the registered ones as they were read, or as another program would have written them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.text import counted

EXPLAINS = 0.5
"""Poses explain edges of which they miss less than half of the motion, in the median, and another reading explains them
better where it misses less than half of what this one does; still poses miss all of it. It must be
better than their turns alone, too: poses of any wrong scale miss less where their lengths are next to nothing.
"""
FEWEST_EDGES = 6
"""So that their median stands though two of them are wrong."""
SAME_RAD = 1e-6
"""Rotations nearer to each other are written alike."""
TURNED_DEG = 1.0
"""The median turn of edges of a camera that turns: those of one that does not are registered to some tenths."""

ROBOT_FROM_CAM = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""A camera has z ahead and y down, a robot x ahead and z up."""


@dataclass(frozen=True)
class Reading:
    """Another way to read given poses: the poses (K, 4, 4) so read, what they look like, and what to do."""

    of: Callable[[Floats], Floats]
    looks: str
    advice: str


def _w_first(world_from_cam: Floats) -> Floats:
    as_read = se3.to_quat_xyzw(world_from_cam)
    return se3.from_quat_xyzw(world_from_cam[:, :3, 3], np.roll(as_read, -1, axis=1))


READINGS = (
    Reading(
        _w_first,
        "quaternions with w first",
        "write them as qx qy qz qw, or name the columns in the first line: # stamp tx ty tz qw qx qy qz",
    ),
    Reading(
        lambda poses: np.asarray(poses @ se3.OPENGL_FROM_CAM),
        "poses of OpenGL's or Blender's camera, y up and z back",
        "turn them to a camera with y down and z ahead: world_from_cam @ diag(1, -1, -1, 1)",
    ),
    Reading(
        lambda poses: np.asarray(poses @ ROBOT_FROM_CAM),
        "poses of a robot, x ahead and z up",
        "give those of the camera: world_from_robot @ robot_from_cam",
    ),
    Reading(
        lambda poses: np.asarray(poses @ se3.inverse(ROBOT_FROM_CAM)),
        "poses of a camera, z ahead and y down, beside a scanner with x ahead and z up",
        "give those of the scanner: world_from_cam @ cam_from_scanner (KITTI's Tr; if only turned, "
        "[[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])",
    ),
    Reading(se3.inverse, "inverse poses, camera from world", "invert each"),
    Reading(lambda poses: se3.rescaled(poses, 1e-3), "lengths in millimetres", "divide them by 1000"),
)


@dataclass(frozen=True)
class Explained:
    """The share of the registered motion that given poses miss, in the median over edges (1: as if they stood still),
    and what is wrong with how they were read, in one line; empty where nothing is known to be.
    """

    missed: float
    wrong: str = ""

    @property
    def is_unlike(self) -> bool:
        """Whether still poses would explain the edges better."""
        return self.missed > 1


def explained(
    world_from_key: Floats, edges: Ints, i_from_j: Floats, arm_m: float, poses: str = "poses given"
) -> Explained:
    """How poses (K, 4, 4), called `poses`, explain registered edges (E, 2) with motions (E, 4, 4); a turn counts at
    `arm_m`.
    """
    motion_m = float(np.median(se3.displacement_m(i_from_j, arm_m))) if len(edges) else 0.0
    if len(edges) < FEWEST_EDGES or not motion_m > 0:
        return Explained(0.0)
    given = se3.between(world_from_key, edges)
    missed = _missed_m(given, i_from_j, arm_m) / motion_m
    if not missed > EXPLAINS:
        return Explained(missed)
    of = f"of {counted(len(edges), 'registered pair')}"
    turned_deg = float(np.rad2deg(np.median(se3.rotation_angle(i_from_j))))
    if se3.rotation_angle(given).max() < SAME_RAD and np.any(given[:, :3, 3]) and turned_deg > TURNED_DEG:
        told = f"the {poses} all have the same rotation, and the camera turned by {turned_deg:.2g}° (median {of})"
        return Explained(missed, f"{told}: give poses with their rotations; positions alone go to positions.path")
    as_others = [
        _missed_m(se3.between(reading.of(world_from_key), edges), i_from_j, arm_m) / motion_m for reading in READINGS
    ]
    best = int(np.argmin(as_others))
    without_lengths = _missed_m(se3.between(se3.rescaled(world_from_key, 0.0), edges), i_from_j, arm_m) / motion_m
    if as_others[best] >= EXPLAINS * min(missed, without_lengths, 1.0):
        return Explained(missed)
    shares = f"as such they miss {as_others[best]:.2f} of the motion (median {of}), as they were read {missed:.2f}"
    looks = f"the {poses} look like {READINGS[best].looks}"
    return Explained(missed, f"{looks}: {shares}: {READINGS[best].advice}")


def _missed_m(given: Floats, i_from_j: Floats, arm_m: float) -> float:
    turned = se3.rotation_angle(se3.inverse(i_from_j) @ given)
    return float(np.median(turned * arm_m + np.linalg.norm((given - i_from_j)[:, :3, 3], axis=1)))

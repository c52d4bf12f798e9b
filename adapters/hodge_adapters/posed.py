"""The poses that a source gives, wherever it keeps them, for writers of trajectories."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Frame, Source, Trajectory

UNIT_TOLERANCE = 1e-3
"""Three decimals of a quaternion leave as much; more is another mistake."""


def length_notes(quats: Floats, what: str) -> list[str]:
    """A note where quaternions (N, 4) are not of length 1: they are normalised."""
    lengths = np.linalg.norm(quats, axis=1)
    wrong = np.abs(lengths - 1) > UNIT_TOLERANCE
    if not wrong.any():
        return []
    worst = lengths[np.argmax(np.abs(lengths - 1))]
    return [f"{int(wrong.sum())} of {len(quats)} {what} have a quaternion of another length than 1 (as {worst:.4g})"]


def trajectory_of(source: Source) -> Trajectory:
    """The source's trajectory, else the poses of its frames. Raises `SourceError` where it has neither."""
    if source.trajectory is not None:
        return source.trajectory
    found = posed_frames(source.frames)
    if found is None:
        raise SourceError(f"{source.path}: has no poses to write: convert one that has a trajectory")
    return found


def posed_frames(frames: Sequence[Frame]) -> Trajectory | None:
    """The poses of the frames that have one, as a trajectory; None where none has."""
    posed = [(frame.stamp_s, frame.world_from_cam) for frame in frames if frame.world_from_cam is not None]
    return Trajectory(np.array([stamp for stamp, _ in posed]), np.array([pose for _, pose in posed])) if posed else None

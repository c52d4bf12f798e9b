"""Associate given poses with frames: by stamp, by frame number or by row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.scene import given_poses
from hodge_pipeline.types import Bools, Floats, Frame, Source, Trajectory, number_of
from hodge_pipeline.types.text import counted

Match: TypeAlias = Literal["auto", "stamp", "number", "row"]
LIKELY_SHARE = 0.5
"""Of the frames: fewer numbers in common may be a coincidence, since small numbers occur in every sequence."""


@dataclass(frozen=True)
class Matched:
    """Poses on the frames: `frame_times (N,)` and `pose_times (P,)` on one clock, `world_from_cam (N, 4, 4)` at the
    frames, NaN where there is none, and how they were matched.
    """

    frame_times: Floats
    pose_times: Floats
    world_from_cam: Floats
    how: str

    @property
    def spacing(self) -> float:
        """The usual time from frame to frame; 0 of a single one."""
        return float(np.median(np.diff(np.sort(self.frame_times)))) if len(self.frame_times) > 1 else 0.0

    def has_frame(self, max_gap_s: float) -> Bools:
        """Which poses (P,) lie among the frames: none more than half a frame before the first or after the last, or
        farther from the nearest one than frames usually are from each other, and than `max_gap_s` where it is time.
        """
        times, spacing = np.sort(self.frame_times), self.spacing
        after = np.clip(np.searchsorted(times, self.pose_times), 1, max(len(times) - 1, 1))
        after = np.minimum(after, len(times) - 1)
        nearest = np.minimum(np.abs(self.pose_times - times[after - 1]), np.abs(self.pose_times - times[after]))
        farthest = max(spacing, max_gap_s if self.how == "stamp" else 0.0)
        inside = (self.pose_times >= times[0] - spacing / 2) & (self.pose_times <= times[-1] + spacing / 2)
        return np.asarray(inside & (nearest <= farthest))

    def outside(self) -> int:
        """How many frames without a pose lie before the first pose or after the last one."""
        missing = self.frame_times[~se3.has_pose(self.world_from_cam)]
        return int(((missing < self.pose_times.min()) | (missing > self.pose_times.max())).sum())


def own_poses(source: Source) -> Matched:
    """The frames' own poses."""
    poses = given_poses(source)
    times = np.arange(len(poses), dtype=float)
    return Matched(times, times[se3.has_pose(poses)], poses, "the frames' own")


def match_poses(trajectory: Trajectory, frames: Sequence[Frame], match: Match, max_gap_s: float, where: str) -> Matched:
    """The trajectory's poses on the frames.

    Raises `SourceError` where they have nothing in common, or `match` asks for what is not there.
    """
    rows = len(trajectory)
    usable = se3.has_pose(trajectory.world_from_cam) & np.isfinite(trajectory.stamps_s)
    trajectory = replace(
        trajectory, stamps_s=trajectory.stamps_s[usable], world_from_cam=trajectory.world_from_cam[usable]
    )
    if not len(trajectory):
        raise SourceError(f"{where}: no pose in it: give a trajectory")
    if match != "auto":
        matched = _matched(match, trajectory, frames, max_gap_s)
        if matched is None or not np.isfinite(matched.world_from_cam).any():
            raise SourceError(f"{where}: no frame finds a pose by {match}: {_ranges(trajectory, frames)}")
        return matched
    if not trajectory.has_stamps and rows != len(frames):
        raise SourceError(
            f"{where}: {counted(rows, 'pose')} without stamps for {counted(len(frames), 'frame')}: nothing tells which "
            "pose is of which frame: give poses with stamps (TUM), or one for each frame; if row n, from 0, is the "
            "pose of the frame of that number, --match number"
        )
    rows_for_stamps = len(trajectory) == len(frames) and np.array_equal(
        trajectory.stamps_s, np.arange(len(frames), dtype=float)
    )
    for how in ("row", "stamp", "number") if rows_for_stamps else ("stamp", "number"):
        matched = _matched(how, trajectory, frames, max_gap_s)
        found = 0 if matched is None else int(se3.has_pose(matched.world_from_cam).sum())
        if matched is not None and found and (how != "number" or found >= LIKELY_SHARE * len(frames)):
            return matched
    raise SourceError(
        f"{where}: none of its poses is of these frames: {_ranges(trajectory, frames)}: give the poses of this "
        "sequence, or say how they belong together: --match row, --match number"
    )


def _matched(how: str, trajectory: Trajectory, frames: Sequence[Frame], max_gap_s: float) -> Matched | None:
    """The poses matched in one way, None where it does not apply."""
    if how == "stamp":
        stamps = np.array([frame.stamp_s for frame in frames], float)
        return Matched(stamps, trajectory.stamps_s, se3.poses_at(trajectory, stamps, max_gap_s), "stamp")
    return _by_number(trajectory, frames) if how == "number" else _by_row(trajectory, frames)


def _by_number(trajectory: Trajectory, frames: Sequence[Frame]) -> Matched | None:
    numbers = np.array([number_of(frame) for frame in frames])
    whole = np.equal(np.mod(trajectory.stamps_s, 1), 0).all()
    if numbers.dtype.kind not in "iu" or not whole or (np.diff(numbers) <= 0).any():
        return None
    numbers = numbers.astype(float)
    return Matched(numbers, trajectory.stamps_s, se3.poses_at(trajectory, numbers, 0.0), "number")


def _by_row(trajectory: Trajectory, frames: Sequence[Frame]) -> Matched | None:
    if len(trajectory) != len(frames):
        return None
    rows = np.arange(len(frames), dtype=float)
    return Matched(rows, rows, trajectory.world_from_cam, "row")


def _ranges(trajectory: Trajectory, frames: Sequence[Frame]) -> str:
    stamps = [frame.stamp_s for frame in frames]
    return (
        f"{counted(len(trajectory), 'pose')} at {trajectory.stamps_s[0]:.10g} to {trajectory.stamps_s[-1]:.10g}, "
        f"{counted(len(frames), 'frame')} at {min(stamps):.10g} to {max(stamps):.10g}"
    )

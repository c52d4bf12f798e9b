"""Whether the truth that a run is measured by is read as it was written: its convention, and its clock."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.clock import Clock, other_clock
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.evaluation.trajectory import align
from hodge_pipeline.refine.conventions import Explained, explained
from hodge_pipeline.scene import KeyFrames, Round, has_real_stamps, has_truth, true_poses
from hodge_pipeline.start.truth import MAX_GAP_S
from hodge_pipeline.types import Floats, Source
from hodge_pipeline.types.notes import Note

SAME_POSE = 1e-6
"""Entries of poses that differ by less are the same: rounding."""


def truth_doubts(
    whole: Source, key_frames: KeyFrames, last: Round, world_from_cam: Floats, arm_m: float
) -> tuple[Note, ...]:
    """A note where the truth contradicts the registered motions of the last round, by another convention or clock, or
    for no known reason; `world_from_cam (N, 4, 4)` are the final poses, and a rotation counts at `arm_m`.
    """
    assert last.solution is not None
    true = true_poses(whole)[key_frames.rows]
    found = _explained(last, true, arm_m)
    if found.wrong:
        return (Note("truth convention", detail=found.wrong),)
    component = key_frames.of_frames(last.solution.component)
    clock = None
    if _is_clocked(whole):
        stamps_s = np.array([frame.stamp_s for frame in whole.frames])
        assert whole.trajectory is not None
        clock = other_clock(world_from_cam, stamps_s, whole.trajectory, component, arm_m, MAX_GAP_S)
    if clock is not None:
        return (Note("truth clock", detail=_told(clock, "truth" if has_truth(whole) else "trajectory")),)
    known = se3.has_pose(true) & se3.has_pose(last.world_from_cam)
    if not found.is_unlike or not known.any():
        return ()
    scale = align(last.world_from_cam[known], true[known], with_scale=True).scale
    missed = _explained(last, se3.rescaled(true, 1 / scale), arm_m) if scale > 0 else found
    return (Note("truth unlike", detail=f"{missed.missed:.2g}"),) if missed.is_unlike else ()


def _explained(last: Round, true: Floats, arm_m: float) -> Explained:
    """How true poses (K, 4, 4) explain the edges that the last solve used."""
    assert last.solution is not None
    edges = last.graph.edges
    rows = (last.solution.weights > 0) & se3.has_pose(true)[edges].all(axis=1)
    return explained(true, edges[rows], last.graph.i_from_j[rows], arm_m, "true poses")


def _is_clocked(source: Source) -> bool:
    """Whether the source's trajectory is its truth, or is of none of its frames, and on a clock as these are."""
    if source.trajectory is None or not source.trajectory.has_stamps or not has_real_stamps(source.frames):
        return False
    true = true_poses(source)
    known = se3.has_pose(true)
    if not known.any():
        return all(frame.world_from_cam is None for frame in source.frames)
    stamps_s = np.array([frame.stamp_s for frame in source.frames])[known]
    return bool(np.nanmax(np.abs(se3.poses_at(source.trajectory, stamps_s, np.inf) - true[known])) < SAME_POSE)


def _told(clock: Clock, reference: str) -> str:
    side = "late" if clock.late_s > 0 else "early"
    as_read = f"ATE {length(clock.ate_m)}," if np.isfinite(clock.ate_m) else "no frame has a pose near, ATE"
    shifted = f"{length(clock.shifted_ate_m)} with its stamps shifted"
    return f"the {reference}'s clock is {abs(clock.late_s):.2f} s {side}: {as_read} {shifted}"

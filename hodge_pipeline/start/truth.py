"""Ground-truth poses that the user names: a file of poses, or the poses that come with the frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.scene import given_poses
from hodge_pipeline.stages import Steps
from hodge_pipeline.start.given import read_trajectory
from hodge_pipeline.start.match_poses import match_poses
from hodge_pipeline.types import Bools, Source
from hodge_pipeline.types.notes import Note

OWN = "frames"
MAX_GAP_S = 0.1
"""Seconds to the true poses around a frame's stamp, as for given poses."""


def with_truth(source: Source, truth: Path | None, steps: Steps) -> Source:
    """The source with the true poses of a file, or with its own where `truth` is `frames`; itself where it is None.

    Raises `SourceError` where the frames have no poses, or the file's are not of these frames.
    """
    if truth is None:
        return source
    if str(truth) == OWN:
        poses, trajectory, files = given_poses(source), source.trajectory, source.files
        if not np.isfinite(poses).any():
            raise SourceError(f"{source.path}: its frames have no poses: name a file of true ones")
    else:
        trajectory, files = read_trajectory(truth, steps), (*source.files, truth)
        matched = match_poses(trajectory, source.frames, "auto", MAX_GAP_S, str(truth))
        poses = matched.world_from_cam
        trajectory = trajectory if matched.how == "stamp" else None
    known: Bools = se3.has_pose(poses)
    steps.note(Note("truth", int(known.sum()), str(len(known))))
    frames = tuple(
        replace(frame, true_world_from_cam=pose if true else None)
        for frame, pose, true in zip(source.frames, poses, known, strict=True)
    )
    found = replace(source, frames=frames, trajectory=trajectory, files=files)
    steps.remember(found, steps.key([source, poses]))
    return found

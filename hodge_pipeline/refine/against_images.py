"""Given and refined poses beside the motions that optical flow of corners shows: a guard apart from the clouds.

A sensor may warp all clouds alike: they then fit each other best at wrong poses. Depth enters by the parallax alone, so
depth that is 5 % off makes a step 5 % longer or shorter.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.refine.guard import NOISE_SIGMAS, Measure
from hodge_pipeline.registration.tracking.flow import FlowImage, find_corners, flow_image, follow
from hodge_pipeline.rounds.one_round import Work
from hodge_pipeline.scene import KeyFrames
from hodge_pipeline.stages import Step
from hodge_pipeline.types import Floats, Frame, Ints, Source
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.notes import Note

STEP_TOLERANCE, STEP_TOLERANCE_MM = 1.0, 5.0
"""Share, and millimetres in a room, by which steps may get farther from those of images. Registered steps may be
rougher than a visual odometry's and yet drift less; steps twice as far off belong to other poses."""
ROUGHER = 0.1
"""Share from which on rougher steps are reported."""
FEWEST_STEPS = 6
"""Steps that images measure: fewer are not judged."""
MOST_STEPS = 100
"""Steps that are tested, evenly over the sequence: 30 ms each at 640x480."""
RANGE_M = (0.1, 100.0)
"""Depth that counts, in units of the recipe's scale."""


def first_of_steps(key_frames: KeyFrames) -> Ints:
    """The rows, among the key frames, of those that another one of their sequence follows."""
    sequence = key_frames.sequence[key_frames.rows]
    return np.flatnonzero(sequence[1:] == sequence[:-1])


def off_images(work: Work, firsts: Ints, before: Floats, after: Floats) -> Floats:
    """How far (2, S, 2) the steps from these key frames to the next, before and after, lie from those that images show,
    metres and radians; NaN where there are none.
    """
    source, scale = work.scene.source, float(work.recipe.scale)
    if not len(firsts) or not all(frame.read_colour and frame.read_depth for frame in source.frames):
        return np.full((2, len(firsts), 2), np.nan)
    pairs, poses = np.column_stack([firsts, firsts + 1]), np.stack([before, after])
    return work.steps.step(step_errors, source, pairs, poses, scale, title="guard: images", total=len(pairs))


def against_images(work: Work, key_frames: KeyFrames, after: Floats) -> list[Measure]:
    """How far steps from key frame to key frame lie from those of optical flow; empty without images or depth."""
    firsts, scale = first_of_steps(key_frames), float(work.recipe.scale)
    firsts = firsts[evenly(len(firsts), MOST_STEPS)]
    off_m = off_images(work, firsts, key_frames.world_from_key, after)[..., 0]
    before_mm, after_mm = off_m[:, np.isfinite(off_m).all(axis=0)] * 1000
    if len(before_mm) < FEWEST_STEPS:
        return []
    error_mm = float((after_mm - before_mm).std() / np.sqrt(len(before_mm)))
    mean = float(before_mm.mean()), float(after_mm.mean())
    if mean[1] > (1 + ROUGHER) * mean[0] + error_mm:
        work.steps.note(Note("rougher", detail=f"{mean[1]:.3g} mm off, before {mean[0]:.3g} mm"))
    tolerance_mm = max(NOISE_SIGMAS * error_mm, STEP_TOLERANCE * mean[0], STEP_TOLERANCE_MM * scale)
    return [Measure("steps off those of images", *mean, tolerance=tolerance_mm, unit="mm")]


def step_errors(source: Source, pairs: Ints, pose_sets: Floats, unit_m: float, *, step: Step) -> Floats:
    """Step: how far (S, P, 2) steps between pairs (P, 2) of frames, under sets of poses (S, K, 4, 4), lie from those
    that images show, metres and radians.

    NaN where a pair has no readable images, or too few of its corners agree on a motion, whichever set they are
    followed from: one that is 30 cm off may lose them. `unit_m`: the recipe's scale.
    """
    off = np.full((len(pose_sets), len(pairs), 2), np.nan)
    images: dict[int, FlowImage | None] = {}
    for column, (i, j) in enumerate(pairs.tolist()):
        images = {row: images[row] if row in images else _read(source.frames[row], unit_m) for row in (i, j)}
        one, other = images[i], images[j]
        i_from_j = se3.inverse(pose_sets[:, i]) @ pose_sets[:, j]
        if one is not None and other is not None:
            corners = find_corners(one)
            found = next(filter(None, (follow(corners, other, motion) for motion in i_from_j)), None)
            if found is not None:
                off[:, column] = step_difference(found.key_from_view, i_from_j)
        step.advance(1)
    return off


def step_difference(one: Floats, other: Floats) -> Floats:
    """How far (..., 2) motions (..., 4, 4) lie from each other, metres and radians."""
    between = se3.inverse(one) @ other
    return np.stack([np.linalg.norm(between[..., :3, 3], axis=-1), se3.rotation_angle(between)], axis=-1)


def _read(frame: Frame, unit_m: float) -> FlowImage | None:
    try:
        return flow_image(frame, (RANGE_M[0] * unit_m, RANGE_M[1] * unit_m), unit_m)
    except (SourceError, OSError):
        return None

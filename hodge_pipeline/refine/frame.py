"""The frame of a refined model: bundle adjustment leaves it free, and the input's is the user's."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import tail_weight
from hodge_pipeline.evaluation.trajectory import align
from hodge_pipeline.refine.pieces import parts
from hodge_pipeline.types import Floats
from hodge_pipeline.types.tracked_model import TrackedModel

ROUNDS, MEDIANS = 10, 3.0
"""Fits of the frame, and the medians of the distances within which bodies take part: Gaussian noise leaves out one of
10^4."""
NO_BASELINE = 1e-9
"""Share of the model's size below which a sensor's distance from its rig's origin is rounding."""
LEAST_BODIES = 3
"""Bodies of a part that is laid by itself: with two, its positions are no more numbers than its size and place take."""


def in_frame_of(start: TrackedModel, model: TrackedModel, *, keeps_size: bool = False) -> TrackedModel:
    """The model laid on the start by its bodies, in the start's size unless it `keeps_size`, as one with rigs does.

    Bodies that moved much farther than most are left out: an image that was wrong must not draw the world with it.
    """
    keeps_size |= _has_baselines(start)
    before, after = start.world_from_body, model.world_from_body
    near = np.ones(len(before), bool)
    for _ in range(ROUNDS):
        found = align(after[near], before[near], with_scale=not keeps_size)
        if not found.scale > 0:  # the start's positions are all one
            return model
        off = np.linalg.norm(found.apply(after)[:, :3, 3] - before[:, :3, 3], axis=1)
        near = off <= MEDIANS * np.median(off)
    return model.scaled(found.scale, found.reference_from_estimate)


def parts_laid_on(world_from_body: Floats, model: TrackedModel) -> TrackedModel:
    """The model with each of its parts laid by itself on its bodies at these poses (B, 4, 4); as it is of one part."""
    part, keeps_size = parts(model), _has_baselines(model)
    sizes = np.bincount(part[part >= 0])
    if len(sizes) < 2:
        return model
    row, factors, motions = np.zeros(len(part), np.int64), [1.0], [np.eye(4)]
    for number in np.flatnonzero(sizes >= LEAST_BODIES):
        own = part == number
        factor, motion = similarity(model.world_from_body[own], world_from_body[own], keeps_size)
        if factor > 0:
            row[own] = len(factors)
            factors.append(factor)
            motions.append(motion)
    return model.scaled_parts(row, np.array(factors), np.array(motions)) if len(factors) > 1 else model


def _has_baselines(model: TrackedModel) -> bool:
    """Whether rigs hold their cameras apart, and so a model's size."""
    baselines = np.abs(model.body_from_cam[:, :3, 3]).max()
    return bool(baselines > NO_BASELINE * np.ptp(model.world_from_body[:, :3, 3], axis=0).max())


def similarity(after: Floats, before: Floats, keeps_size: bool) -> tuple[float, Floats]:
    """The factor and then the motion (4, 4) that lay poses after on those before (B, 4, 4); not positive where the size
    is free and the latter are all in one place.

    The most likely one by positions and turns whose errors follow Student's t, of sizes that the fit tells: a row
    of cameras leaves the turn about its axis to their turns, and its other turns to their positions.
    """
    x, y = after[:, :3, 3], before[:, :3, 3]
    turns = before[:, :3, :3] @ np.swapaxes(after[:, :3, :3], 1, 2)
    of_position = of_turn = np.ones(len(x))
    scale, off2, turn2 = 1.0, float(np.sum((y - y.mean(axis=0)) ** 2)) or 1.0, 1.0  # at first 1 rad for the extent
    for _ in range(ROUNDS):
        centre_x, centre_y = (np.average(one, axis=0, weights=of_position) for one in (x, y))
        covariance = (y - centre_y).T @ (of_position[:, None] * (x - centre_x))
        spread = float(of_position @ np.sum((x - centre_x) ** 2, axis=1))
        # a turn by θ moves a rotation's numbers by θ √2
        rotation = se3.project_to_so3(turn2 * scale * covariance + off2 * np.tensordot(of_turn, turns, 1) / 2)
        if not keeps_size:
            scale = float(np.sum(rotation * covariance)) / spread if spread > 0 else 0.0
        motion = se3.from_parts(rotation, centre_y - scale * rotation @ centre_x)
        if not scale > 0:
            break
        offs2 = np.sum((scale * x @ rotation.T + motion[:3, 3] - y) ** 2, axis=1)
        turns2 = se3.rotation_angle(se3.from_parts(rotation.T @ turns, np.zeros((len(x), 3)))) ** 2
        # per axis; of the positions' numbers the fit takes 7
        off2, turn2 = float(of_position @ offs2) / (3 * len(x) - 7), float(of_turn @ turns2) / (3 * len(x))
        if not off2 * turn2 > 0:  # one of them fits exactly
            break
        of_position, of_turn = tail_weight(offs2 / off2, 3), tail_weight(turns2 / turn2, 3)
    return scale, motion

"""Frame-to-frame odometry: each frame registered to the one before it, from a constant-velocity guess."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.registration.assessment import MOST_VIOLATION
from hodge_pipeline.registration.gaps import over_gap
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.pairs import prepared_clouds
from hodge_pipeline.registration.seen_through import is_refuted, with_seen_through
from hodge_pipeline.registry import plugin_errors
from hodge_pipeline.stages import OPTIONS, Advance, Registrar, Workers, no_progress
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, Registration

STEPS_IN_BLOCK, WARM_UP_STEPS = 32, 2
"""Steps that a worker registers at once, and those before them that give it its first velocity."""
SURE_FITNESS = 0.7
"""Below it a second registration starts from no motion, and the fitter one is kept. Over a hole in the recording (a
step ten times as long as usual), and where optical flow could tell a motion and finds none, it must be reached, or
tracking is lost: of 42 such steps of red kitchen and fr1/rpy at 5 to 10 Hz those above it are right to 5 cm, and of
those below one is 33 degrees off."""
REACHES_APART = 4.0
"""Gap between unconnected components in the layout, times the reach of a cloud, so that no two clouds meet."""


@dataclass(frozen=True, config=OPTIONS)
class OdometryOptions:
    """How the first poses are found."""

    registration: Registrar = Field(default=Gicp(), description="how two consecutive frames are registered")
    min_fitness: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="below it tracking is lost: no edge, the motion is the one before it, and it is said",
    )
    tail: float | None = Field(
        default=0.01,
        gt=0,
        lt=1,
        description="share of right pairs that are lost because odometry contradicts them: a pair is no edge where it "
        "is that unlikely by the covariance of the path between its frames and its own (Student's distribution with 4 "
        "degrees of freedom: 9.5 sigma for 0.01). Of 2300 right pairs on four real sequences it rejects none. null: "
        "odometry rejects no pair",
    )
    max_seen_through: float | None = Field(
        default=MOST_VIOLATION,
        gt=0,
        lt=1,
        description="share of the points in view that the other depth image of a step saw through, at most: beyond it "
        "the step slid, and tracking is lost; null: any",
    )


@plain_dataclass(frozen=True)
class Odometry:
    """The first poses (N, 4, 4), the steps that led to them, and what went wrong, one line each."""

    world_from_cam: Floats
    steps: Edges
    notes: tuple[str, ...]


@plain_dataclass(frozen=True)
class _Block:
    """Consecutive rows of one sequence with their stamps; the first `warm_up` steps belong to the block before."""

    rows: Ints
    stamps_s: Floats
    warm_up: int


def odometry(
    folder: Path,
    sequences: Sequence[Ints],
    stamps_s: Floats,
    options: OdometryOptions,
    workers: Workers,
    advance: Advance = no_progress,
    scale: float = 1.0,
) -> Odometry:
    """Poses of every frame; each sequence begins with the identity rotation, beside the sequence before it.

    Frames without points are bridged, and keep the pose of the frame before them. A block of steps starts two steps
    early to know its velocity, so that blocks run side by side and the result does not depend on the workers.
    `advance` counts frames; `scale` multiplies lengths that are for rooms.
    """
    clouds = CloudSet.open(folder)
    sizes = clouds.sizes
    blocks = [block for rows in sequences for block in _blocks(rows[sizes[rows] > 0], stamps_s)]
    results: dict[int, Edges] = {}
    for number, result in workers.map(partial(_run_block, folder, options), blocks):
        results[number] = result
        advance(len(result.pairs))
    steps = Edges.joined([results[number] for number in range(len(blocks))])
    gap = over_gap(steps.pairs, sequences, stamps_s)
    lost = ~(steps.fitness >= np.where(gap, max(SURE_FITNESS, options.min_fitness), options.min_fitness))
    steps = with_seen_through(steps, clouds, scale)
    slid = ~lost & is_refuted(steps, options.max_seen_through)
    poses = chained(len(sizes), sequences, steps, REACHES_APART * clouds.reach_m)
    notes = tuple(
        f"tracking was lost between rows {i} and {j} ({'a hole in the recording, ' if hole else ''}fitness "
        f"{fitness:.2f}): no edge there, the motion is guessed"
        for (i, j), fitness, hole in zip(steps.pairs[lost], steps.fitness[lost], gap[lost], strict=True)
    )
    notes += tuple(
        f"tracking was lost between rows {i} and {j} (surfaces fit, but one camera saw through what the other saw): no "
        "edge there, its motion is as good as a guess"
        for i, j in steps.pairs[slid]
    )
    return Odometry(poses, steps.select(~lost & ~slid), notes)


def _blocks(rows: Ints, stamps_s: Floats) -> list[_Block]:
    out = []
    for start in range(0, len(rows) - 1, STEPS_IN_BLOCK):
        first = max(0, start - WARM_UP_STEPS)
        part = rows[first : start + STEPS_IN_BLOCK + 1]
        out.append(_Block(part, stamps_s[part], start - first))
    return out


@plugin_errors()
def _run_block(folder: Path, options: OdometryOptions, block: _Block) -> Edges:
    """The steps of one block, without its warm-up."""
    prepared = prepared_clouds(folder, options.registration)
    durations = _durations(block.stamps_s)
    velocity, found = np.zeros(6), []
    for (i, j), duration in zip(_steps(block.rows), durations, strict=True):
        step = options.registration.register(prepared[i], prepared[j], se3.exp(velocity * duration))
        if step.fitness < SURE_FITNESS:
            again = options.registration.register(prepared[i], prepared[j], np.eye(4))
            step = again if again.fitness > step.fitness else step
        if step.fitness < options.min_fitness:
            step = Registration(se3.exp(velocity * duration), np.zeros((6, 6)), step.fitness, step.rmse_m, 0, 0, False)
        velocity = se3.log(step.i_from_j) / duration
        found.append(step)
    return Edges.of(_steps(block.rows)[block.warm_up :], "sequential").with_registrations(found[block.warm_up :])


def _steps(rows: Ints) -> Ints:
    return np.stack([rows[:-1], rows[1:]], axis=1)


def _durations(stamps_s: Floats) -> Floats:
    """Time of each step; 1 each where stamps do not ascend, for then they are no clock."""
    durations = np.diff(stamps_s)
    return np.where((durations > 0).all(), durations, 1.0)


def chained(count: int, sequences: Sequence[Ints], steps: Edges, space_m: float) -> Floats:
    """Poses (count, 4, 4) that steps between rows of each sequence lead to; a sequence begins `space_m` beside
    the one before.
    """
    motion_to = {int(j): (int(i), motion) for (i, j), motion in zip(steps.pairs, steps.i_from_j, strict=True)}
    poses: Floats = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
    begin_x = 0.0
    for rows in sequences:
        before = None
        for row in rows:
            if int(row) in motion_to:
                i, motion = motion_to[int(row)]
                poses[row] = poses[i] @ motion
            elif before is not None:
                poses[row] = poses[before]
            else:
                poses[row, 0, 3] = begin_x
            before = row
        begin_x = float(poses[rows, 0, 3].max()) + space_m
    return poses

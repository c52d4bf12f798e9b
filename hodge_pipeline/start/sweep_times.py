"""How the times of points in sweeps are read: as told, or as the sweeps that skew moves farthest are sure of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.following import sense_of_times
from hodge_pipeline.registration.sweeps import (
    BACKWARDS,
    FORWARDS,
    UNUSED,
    deskewed_frame,
    first_after_s,
    retimed_frame,
    velocities_along,
)
from hodge_pipeline.scene import is_clock, sequences_of, stamps_of
from hodge_pipeline.stages import Advance, Steps, no_progress
from hodge_pipeline.start.sweep_reading import NO_CLOCK_S, Look, begun_s, first_look, timed_sweeps
from hodge_pipeline.types import Floats, Frame, Ints, Source
from hodge_pipeline.types.notes import Note

VOXELS_IN_REACH = 100
"""The reach of the scanner over the finest voxel: 0.8 m at 80 m, as in KISS-ICP (Vizzo et al., RA-L 2023)."""
SMALLEST_VOXEL_M = 0.08
"""Four times the usual noise of a range, 2 cm: smaller voxels, as in a room, would hold noise in place of surfaces."""
WARM_UP = 20
"""Sweeps that the first velocity is found on, and that times are judged by at a time."""
AS_TOLD = 0.0, FORWARDS
"""How the times of points are read (`retimed_frame`) where nothing is sure to be better."""


def finest_voxel_m(reach_m: float) -> float:
    """The finest voxel of the map of a scanner that sees so far."""
    return max(reach_m / VOXELS_IN_REACH, SMALLEST_VOXEL_M)


def notes_of_times(revolution_s: Floats, sense: Ints) -> list[Note]:
    """How many sweeps have times of points other than those told, by `retimed_frame`."""
    counts = {
        "times by order": revolution_s > 0,
        "times backwards": sense == BACKWARDS,
        "times unused": sense == UNUSED,
    }
    return [Note(kind, int(where.sum()), str(len(sense))) for kind, where in counts.items() if where.any()]


def deskewed_along(source: Source, world_from_scan: Floats, clouds: CloudOptions, steps: Steps) -> Source:
    """The source with sweeps whose points have times deskewed to their stamps, by velocities from poses (N, 4, 4).

    The poses may be noisy, see `velocities_along`. Notes where sweeps in motion have no times, or other ones than told.
    """
    count, stamps, is_untimed = len(source.frames), stamps_of(source), False
    velocity, revolution_s, sense = np.zeros((count, 6)), np.zeros(count), np.ones(count, np.int64)
    for rows in sequences_of(source).values():
        frames = [source.frames[row] for row in rows]
        halfway = frames[len(rows) // 2]
        if len(rows) < 2 or halfway.read_points is None:
            continue
        turns = is_clock(stamps[rows]) and np.median(np.diff(stamps[rows])) < NO_CLOCK_S
        look = first_look([halfway], stamps[rows], clouds)
        if look.turn_s and (turns or not (look.revolution_s and is_clock(stamps[rows]))):
            times = begun_s(stamps[rows], look.turn_s)
            middle_s = first_after_s(halfway.read_points(), halfway.stamp_s) + look.turn_s / 2
            velocity[rows] = velocities_along(world_from_scan[rows], times, times + middle_s, look.reach_m)
            voxel_m = finest_voxel_m(look.reach_m)
            revolution_s[rows], sense[rows] = times_along(frames, velocity[rows], times, clouds, voxel_m, look)
        in_use = revolution_s[rows[0]] > 0 if look.revolution_s else look.turn_s > 0 and sense[rows[0]] != UNUSED
        is_untimed |= bool(turns and not in_use)
    for note in notes_of_times(revolution_s, sense) + [Note("sweeps untimed")] * is_untimed:
        steps.note(note)
    if not velocity.any():
        return source
    timed = map(retimed_frame, source.frames, revolution_s.tolist(), sense.tolist())
    return replace(source, frames=tuple(map(deskewed_frame, timed, velocity)))


def times_along(
    frames: list[Frame],
    velocity: Floats,
    times: Floats,
    clouds: CloudOptions,
    voxel_m: float,
    look: Look,
    advance: Advance = no_progress,
) -> tuple[float, int]:
    """How the times of points are read (`retimed_frame`): others than those told only where the map is sure of the same
    ones in both of the two parts that skew moves farthest, of up to `WARM_UP` sweeps each.

    The sweeps of a part share a map, and with it their errors: by one part of 33 right times were called deskewed.
    """
    if not look.turn_s or not len(frames):
        return AS_TOLD
    skew_m = np.abs(velocity) @ np.repeat([look.reach_m, 1.0], 3)
    told, count = UNUSED if look.revolution_s else FORWARDS, min(WARM_UP, max(1, len(frames) // 2))
    parts = skew_m[: len(frames) // count * count].reshape(-1, count)
    senses = set[int]()
    for first in count * np.argsort(-np.median(parts, axis=1), kind="stable")[:2]:
        part = [retimed_frame(frame, look.revolution_s) for frame in frames[first : first + count]]
        sweeps = timed_sweeps(part, times[first:], clouds, look.reach_m)
        senses.add(sense_of_times(voxel_m, velocity[first], told, sweeps, advance))
        if len(senses) > 1 or told in senses:
            return AS_TOLD
    return look.revolution_s, senses.pop()

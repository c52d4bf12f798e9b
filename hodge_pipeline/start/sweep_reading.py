"""Sweeps of a LiDAR as a start reads them: what is odd about each, when it began, and when its points were measured."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.cloud_set import FACTOR_OF_UNITS
from hodge_pipeline.registration.clouds import CloudOptions, Oddity, in_range, make_cloud, out_of_range, reach_m
from hodge_pipeline.registration.sweeps import turns_by_order
from hodge_pipeline.scene import is_clock
from hodge_pipeline.types import Floats, Floats32, Frame, PointCloud

LEFT_OUT = "the sweep is left out"
LOOKS = 9
"""Sweeps, spread over a sequence, that tell how far its scanner sees: any one may face a wall."""
MOST_SKIPPED = 20
"""Revolutions, 2 s of most scanners: numbers of files that are farther apart as a rule count something else."""
NO_CLOCK_S = 1.0
"""Time of a step where neither stamps nor times of points give one: velocities are then per sweep."""
REVOLUTION_S = 0.1
"""A revolution where only the order of points tells that there was one: what most scanners are set to. Closer stamps
tell a faster one; of a slower one half the skew is left."""


class ReadSweep(NamedTuple):
    """The points in range of a sweep, None where it cannot be read or repeats the one before it, and what is odd."""

    cloud: PointCloud | None
    odd: Oddity | None = None
    is_copy: bool = False


def read_sweeps(frames: Iterable[Frame], clouds: CloudOptions, usual_m: float | None = None) -> Iterator[ReadSweep]:
    """Each sweep in range; without points where it cannot be read, repeats the last one, or has a reach far from
    `usual_m`, which means other units.
    """
    before: Frame | None = None
    points: Floats32 = np.zeros((0, 3), np.float32)
    for frame in frames:
        try:
            # The points as measured; the cloud of a frame that has a depth image in their place.
            cloud = make_cloud(frame, clouds)[0] if frame.read_points is None else frame.read_points()
            near = in_range(cloud, clouds)
        except (SourceError, OSError) as error:
            yield ReadSweep(None, Oddity(frame.frame_id, LEFT_OUT, str(error)))
            continue
        if not len(near):
            yield ReadSweep(None, Oddity(frame.frame_id, LEFT_OUT, out_of_range(cloud, clouds)))
        elif usual_m is not None and not 1 / FACTOR_OF_UNITS < (reach := reach_m(cloud)) / usual_m < FACTOR_OF_UNITS:
            why = f"it reaches {reach:.3g} m, the others {usual_m:.3g} m: has it other units (millimetres)?"
            yield ReadSweep(None, Oddity(frame.frame_id, LEFT_OUT, why))
        elif before is not None and np.array_equal(near.points_in_cam, points):
            why = f"it is given the pose of {before.frame_id}"
            yield ReadSweep(None, Oddity(frame.frame_id, "holds the same points as the sweep before it", why), True)
        else:
            before, points = frame, near.points_in_cam
            yield ReadSweep(near)


class Look(NamedTuple):
    """What a few sweeps tell: their median reach in metres, `max_range_m` where none can be read; the time from the
    first to the last point in seconds, 0 where unknown; the duration of a revolution where the order of the points
    tells their times, 0 where they have times or no such order.
    """

    reach_m: float
    turn_s: float
    revolution_s: float


def first_look(frames: Sequence[Frame], stamps_s: Floats, clouds: CloudOptions) -> Look:
    """What a few of the sweeps tell, by the stamps (N,) of all."""
    looks = [s.cloud for s in read_sweeps(frames[:: max(1, len(frames) // LOOKS)], clouds) if s.cloud is not None]
    looks = looks or [s.cloud for s in read_sweeps(frames, clouds) if s.cloud is not None][:1]
    if not looks:
        return Look(clouds.max_range_m, 0.0, 0.0)
    reach = float(np.median([reach_m(look) for look in looks]))
    turn_s = float(np.median([0.0 if look.times_s is None else look.times_s.max() for look in looks]))
    if any(look.times_s is not None for look in looks):
        return Look(reach, turn_s, 0.0)
    found = [turns_by_order(look.points_in_cam) for look in looks]
    turns = [float(one[-1]) for one in found if one is not None]
    if len(turns) <= len(looks) / 2:
        return Look(reach, 0.0, 0.0)
    usual = float(np.median(turns))
    step_s = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 and is_clock(stamps_s) else np.inf
    revolution_s = min(REVOLUTION_S, step_s / usual) if step_s > 0 else REVOLUTION_S
    return Look(reach, usual * revolution_s, revolution_s)


def timed_sweeps(
    frames: Sequence[Frame], times: Floats, clouds: CloudOptions, usual_m: float
) -> list[tuple[int, float, PointCloud]]:
    """Row, time of its beginning and points of each sweep that can be read."""
    every = enumerate(read_sweeps(frames, clouds, usual_m))
    return [(row, times[row], sweep.cloud) for row, sweep in every if sweep.cloud]


def begun_s(stamps_s: Floats, turn_s: float) -> Floats:
    """When sweeps (N,) began, in seconds after the first: by their stamps, or by their numbers, a revolution each."""
    after: Floats = stamps_s - stamps_s[0]
    if len(after) < 2 or is_clock(stamps_s):
        return after
    step = float(np.median(np.diff(after)))
    return np.asarray((after if step <= MOST_SKIPPED else after / step) * (turn_s or NO_CLOCK_S))

"""Deskewing of the sweeps of a spinning scanner, with constant velocity within one revolution."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.clouds import CloudOptions, in_range
from hodge_pipeline.scene import UNIX_STAMP_S
from hodge_pipeline.types import Floats, Floats32, Frame, PointCloud

STEPS_A_SWEEP = 64
"""Motions that a revolution is cut into: 1.6 cm each at 10 m/s and 10 revolutions a second."""
FORWARDS, BACKWARDS, UNUSED = 1, -1, 0
"""Senses of the times of points: as told or by their order; the other way; sweeps were deskewed before."""
HALF_WINDOWS = (0, 1, 2, 5)
"""Steps on both sides of one whose median is a sweep's velocity: the step alone, to a second, in which cars hardly
change their speed but hand-held and walking scanners turn to and fro."""
USUAL_AROUND, FEWEST_STEADY = 10, 8
"""Poses before and after one that tell how evenly a scanner moves there: a second; and poses that it takes to tell."""
BLOCKS, FEWEST_IN_BLOCK = 128, 4
"""Blocks of points, in their order, that tell how a scanner spun: 3 degrees each, wider than the azimuths at which the
lasers of one firing look apart."""
NARROW = 0.9
"""Length of the mean of a block's directions, at the median, below which it is of all around: 0.9 is of 90 degrees."""
SLACK = 0.1
"""Revolution that noise turns a block back by at most; what seems to turn back farther went on round."""
LEAST_TURNS, MOST_TURNS = 0.5, 1.5
"""Revolutions of a sweep: a planar scanner sees 0.7, some drivers cut after 1.1; ring after ring there are as many as
rings, row after row of a camera's image none."""
READS_KEPT = 3
"""Sweeps kept as read, of two key frames in a row: one, and the last lent to the other; and one to come."""


def deskewed(cloud: PointCloud, velocity: Floats, after_s: float = 0.0) -> PointCloud:
    """The points as seen from the scanner's pose `after_s` seconds after the first point; unchanged without times.

    `velocity (6,)` is the scanner's twist per second in its own axes.
    """
    if cloud.times_s is None or not len(cloud):
        return cloud
    last_s = max(float(cloud.times_s.max()), 1e-9)
    step = np.minimum(cloud.times_s / last_s * STEPS_A_SWEEP, STEPS_A_SWEEP - 1).astype(np.int64)
    middle_s = (np.arange(STEPS_A_SWEEP) + 0.5) / STEPS_A_SWEEP * last_s
    motions = se3.exp((middle_s - after_s)[:, None] * velocity).astype(np.float32)
    x, y, z = cloud.points_in_cam.T
    points = np.empty((len(cloud), 3), np.float32)
    for axis in range(3):  # by columns: a matrix for each point takes five times as long
        a, b, c, d = (np.ascontiguousarray(entry)[step] for entry in motions[:, axis].T)
        points[:, axis] = a * x + b * y + c * z + d
    points[(x == 0) & (y == 0) & (z == 0)] = 0.0  # no returns stay what they are
    return replace(cloud, points_in_cam=points, normals_in_cam=None, times_s=None)


def turned(cloud: PointCloud) -> PointCloud:
    """The cloud with the times of its points running the other way."""
    if cloud.times_s is None or not len(cloud):
        return cloud
    return replace(cloud, times_s=cloud.times_s.max() - cloud.times_s)


def timed_by_order(cloud: PointCloud, revolution_s: float) -> PointCloud:
    """The cloud with times by the order of its points, for a scanner that spins once in so many seconds; unchanged
    where the order is not that of a revolution.
    """
    turns = turns_by_order(cloud.points_in_cam)
    return cloud if turns is None else replace(cloud, times_s=turns * np.float32(revolution_s), first_s=0.0)


def retimed(cloud: PointCloud, revolution_s: float, sense: int = FORWARDS) -> PointCloud:
    """The cloud whose points have times by their order (see `timed_by_order`; 0: their own) in this sense."""
    cloud = timed_by_order(cloud, revolution_s) if revolution_s else cloud
    return {FORWARDS: cloud, BACKWARDS: turned(cloud), UNUSED: replace(cloud, times_s=None)}[sense]


def retimed_frame(frame: Frame, revolution_s: float, sense: int = FORWARDS) -> Frame:
    """The frame, its points retimed whenever they are read (see `retimed`)."""
    if frame.read_points is None or (not revolution_s and sense == FORWARDS):
        return frame
    return replace(frame, read_points=partial(_read_retimed, frame.read_points, revolution_s, sense))


def _read_retimed(read: Callable[[], PointCloud], revolution_s: float, sense: int) -> PointCloud:
    return retimed(read(), revolution_s, sense)


def first_after_s(cloud: PointCloud, stamp_s: float) -> float:
    """Seconds from the stamp of a sweep to its first point, negative where the stamp is that of a later one; 0 where
    the points are counted from another moment: then the stamp is taken as that of the first.
    """
    if cloud.times_s is None or not len(cloud):
        return 0.0
    after_s = cloud.first_s - (stamp_s if cloud.first_s > UNIX_STAMP_S else 0.0)
    turn_s = float(cloud.times_s.max())
    return after_s if abs(after_s + turn_s / 2) <= turn_s else 0.0


def deskewed_frame(frame: Frame, velocity: Floats) -> Frame:
    """The frame, its points deskewed to the moment of its stamp whenever they are read."""
    if frame.read_points is None:
        return frame
    read = partial(_read_deskewed, frame.read_points, frame.stamp_s, tuple(velocity.tolist()))
    return replace(frame, read_points=read)


def _read_deskewed(read: Callable[[], PointCloud], stamp_s: float, velocity: tuple[float, ...]) -> PointCloud:
    cloud = read()
    return deskewed(cloud, np.array(velocity), -first_after_s(cloud, stamp_s))


def joined_frame(frame: Frame, others: Sequence[Frame], frame_from_other: Floats, options: CloudOptions) -> Frame:
    """The frame with the points of the others (M) that are in range of their own scanner, moved by (M, 4, 4)."""
    reads = [other.read_points for other in others if other.read_points is not None]
    if frame.read_points is None or len(reads) < len(others):
        return frame
    return replace(frame, read_points=partial(_read_joined, frame.read_points, reads, frame_from_other, options))


@lru_cache(maxsize=READS_KEPT)
def _read_once(read: Callable[[], PointCloud]) -> PointCloud:
    """The sweep, which the key frames before and after it are lent too."""
    return read()


def _read_joined(
    read: Callable[[], PointCloud], reads: list[Callable[[], PointCloud]], motions: Floats, options: CloudOptions
) -> PointCloud:
    own, whole = _read_once(read), [_read_once(one) for one in reads]
    others = [in_range(one, options) for one in whole]
    no_returns = sum(one.no_numbers + int((~one.points_in_cam.any(axis=1)).sum()) for one in whole)
    moved = [
        se3.transform(motion, np.asarray(one.points_in_cam, float)) for motion, one in zip(motions, others, strict=True)
    ]
    colours = [one.colours for one in (own, *others) if one.colours is not None]
    return replace(
        own,
        points_in_cam=np.concatenate([own.points_in_cam, *moved]).astype(np.float32),
        normals_in_cam=None,
        colours=np.concatenate(colours) if len(colours) == 1 + len(others) else None,
        times_s=None,
        no_numbers=own.no_numbers + no_returns,  # of as many sweeps as the points
    )


def velocities(poses: Floats, times_s: Floats) -> Floats:
    """The twist a second (N, 6) of each of N poses (N, 4, 4), in its own axes, from the one before to the one after."""
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    here = np.arange(len(poses))
    before, behind = np.maximum(here - 1, 0), np.minimum(here + 1, len(poses) - 1)
    moved = se3.log(se3.inverse(poses[before]) @ poses[behind])
    return np.asarray(moved / (times_s[behind] - times_s[before])[:, None])


def velocities_along(poses: Floats, times_s: Floats, at_s: Floats, reach_m: float) -> Floats:
    """The twist a second (N, 6), each in its body's axes, at the times (N,) on a path of noisy poses (N, 4, 4), N > 1.

    The median over the steps around: so many of them that the noise of poses and the change of the velocity, of points
    `reach_m` away, add up to the least. Independent noise of poses cancels between the mean of three steps or more and
    its middle one. So they differ by the squared error of the mean and that of one step together.
    """
    steps = np.diff(times_s)
    rates = se3.log(se3.inverse(poses[:-1]) @ poses[1:]) / steps[:, None]
    lengths = np.repeat([reach_m, 1.0], 3)
    of_step = 2 * _noise(rates, lengths)
    errors = [of_step]
    for half in HALF_WINDOWS[1:]:
        off = (_windows(rates, half).mean(axis=1) - rates) * lengths
        errors.append(float(np.median((off**2).sum(axis=1))) - of_step)
    found = np.median(_windows(rates, HALF_WINDOWS[int(np.argmin(errors))]), axis=1)
    middles = times_s[:-1] + steps / 2
    return np.stack([np.interp(at_s, middles, column) for column in found.T], axis=1)


def _noise(rates: Floats, lengths: Floats) -> float:
    """The squared error of poses a step, by third differences of the rates (S, 6): fourth ones of the path, which its
    motion hardly changes. The squares of 1, 4, 6, 4, 1 add up to 70. Infinite where there are too few.
    """
    fourth = np.diff(rates * lengths, 3, axis=0)
    return float(np.median((fourth**2).sum(axis=1))) / 70 if len(fourth) else float("inf")


def _windows(rates: Floats, half: int) -> Floats:
    """Each rate (S, 6) with `half` ones on both sides: (S, 2 half + 1, 6); itself in place of those beyond an end."""
    rows = np.arange(len(rates))
    reach = np.minimum(half, np.minimum(rows, rows[::-1]))
    offsets = np.arange(-half, half + 1)
    inside = np.abs(offsets) <= reach[:, None]
    return np.asarray(rates[rows[:, None] + np.where(inside, offsets, 0)])


def turns_by_order(points: Floats32) -> Floats32 | None:
    """Revolutions (N,) of the scanner from the first of the points (N, 3) to each, where their order is that in which
    a scanner that spins about z measured them; None where it is another, as ring after ring.

    Azimuths of blocks that follow each other turn one way, through about one revolution. Points without a return have
    no azimuth.
    """
    seen = np.flatnonzero((points[:, 0] != 0) | (points[:, 1] != 0))
    if len(seen) < FEWEST_IN_BLOCK * BLOCKS:
        return None
    firsts = np.linspace(0, len(seen), BLOCKS, endpoint=False).astype(np.int64)
    counts = np.diff(np.append(firsts, len(seen)))
    x, y = points[seen, 0].astype(float), points[seen, 1].astype(float)
    towards = np.add.reduceat((x + 1j * y) / np.hypot(x, y), firsts) / counts
    steps = np.angle(towards[1:] / towards[:-1]) / (2 * np.pi)
    steps *= np.sign(np.median(steps)) or 1.0
    steps = np.where(steps < -SLACK, steps + 1, steps)  # a gap of more than half a revolution
    if np.median(np.abs(towards)) < NARROW or not LEAST_TURNS <= steps.sum() <= MOST_TURNS:
        return None
    turns = np.append(0, np.cumsum(np.maximum(steps, 0)))
    at = np.append(seen[firsts + counts // 2], len(points) - 1)
    turns = np.append(turns, turns[-1] + np.median(steps) / 2)
    return np.asarray(np.interp(np.arange(len(points)), at, turns), np.float32)


def off_neighbours_m(poses: Floats, times_s: Floats) -> tuple[Floats, Floats]:
    """Metres (N,) by which each of N poses (N, 4, 4) is off the motion at constant velocity from the one before to the
    one after, 0 at the ends; and what it is off for the usual changes of velocity around there, `USUAL_AROUND` poses to
    each side.
    """
    off, usual = np.zeros(len(poses)), np.zeros(len(poses))
    if len(poses) < FEWEST_STEADY:
        return off, usual
    before, after = np.diff(times_s)[:-1, None], np.diff(times_s)[1:, None]
    moved = se3.log(se3.inverse(poses[:-2]) @ poses[2:]) * before / (before + after)
    off[1:-1] = np.linalg.norm((se3.inverse(poses[:-2] @ se3.exp(moved)) @ poses[1:-1])[:, :3, 3], axis=1)
    longer = np.maximum(1, before * after / np.median(np.diff(times_s)) ** 2).ravel()
    change = off[1:-1] / longer
    for row in range(len(change)):
        around = np.delete(change[max(0, row - USUAL_AROUND) : row + USUAL_AROUND + 1], min(row, USUAL_AROUND))
        usual[row + 1] = np.median(around) * longer[row]
    return off, usual

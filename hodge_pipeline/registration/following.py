"""A sequence of sweeps followed: strange ones told, the velocity it begins with, and how times of points are read."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from hodge_pipeline.registration.scan_to_map import UNKNOWN, ScanToMap, Step
from hodge_pipeline.registration.sweep_map import FEWEST_USUAL, START_LEVELS, START_SAMPLE_M
from hodge_pipeline.registration.sweeps import BACKWARDS, FORWARDS, UNUSED, retimed
from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types import Floats, PointCloud

MOST_PASSES = 4
"""Passes over the first sweeps, forwards and backwards, for their velocity, at most."""
SURE, FEWEST_TIMED = 2.5, 10
"""Standard errors by which more points lie on the map by other times than those told, over as many sweeps and more,
before these are taken, where another part of the sequence says the same. Of 37 parts of streets with right times one is
above it, at 4.2; they lie about -2.0 with a standard deviation of 2.2, so that two of a sequence are in one of 1,800.
"""
NO_MAP = 2
"""Sweeps at the beginning that have no map of sweeps placed yet."""
WORSE = 2.0
"""Standard errors by which fewer points lie on the map by other times than those told before no more sweeps are asked:
sweeps that wrong times blur take longest. Of 178 judgements of simulated and real sequences it changes none.
"""


def followed(tracker: ScanToMap, sweeps: Iterable[tuple[int, float, PointCloud]]) -> Iterator[tuple[int, Step | None]]:
    """Each sweep's row and where it is; None for one that is strange where the next one fits again, or the last.

    Of sweeps, with row and time, two strange ones in a row are a scene that changed, and join the map.
    """
    held: tuple[int, float, PointCloud] | None = None
    for row, time_s, cloud in sweeps:
        step = tracker.place(cloud, time_s)
        if tracker.is_strange(step):
            if held is None:
                held = (row, time_s, cloud)
                continue
            tracker.accept(first := tracker.place(held[2], held[1]))
            yield held[0], first
            step = tracker.place(cloud, time_s)
        elif held is not None:
            yield held[0], None
        held = None
        tracker.accept(step)
        yield row, step
    if held is not None:
        yield held[0], None


def first_velocity(
    voxel_m: float, sweeps: Sequence[tuple[int, float, PointCloud]]
) -> tuple[Floats, Floats, frozenset[int]]:
    """The twist per second (6,) at the first of these sweeps, each with its row and time, with the covariance (3, 3) of
    its translation: tracked forwards and backwards until it converges. The rows of strange ones among the first, which
    only the way back can tell, unless all of the first are: these are a scene that changed.

    A first pass from rest gives too small a velocity, since rings on the ground look the same ahead. It has converged
    where one end of the sweeps has the velocity that it had before: each pass depends on the one that it begins with.
    What a pass knows of the velocity goes on into the next: with nothing known, one of a narrow field leapt by metres a
    second from pass to pass.
    """
    ends: list[Floats] = [np.zeros(6)]  # in turn at the first and at the last of the sweeps
    spreads: list[Floats] = [UNKNOWN]
    early, strange = {row for row, _, _ in sweeps[: FEWEST_USUAL + 1]}, frozenset[int]()
    while len(sweeps) > 1 and len(ends) <= 2 * MOST_PASSES:
        tracker = ScanToMap(voxel_m, ends[-1], spreads[-1], START_LEVELS, START_SAMPLE_M)
        if len(ends) % 2:
            for _, time_s, cloud in (sweep for sweep in sweeps if sweep[0] not in strange):
                tracker.follow(cloud, time_s)
        else:
            strange = _strange_at_end(tracker, sweeps[::-1], early)
        ends.append(tracker.velocity)
        spreads.append(tracker.spread)
        step_m = np.linalg.norm((ends[-1] - ends[max(0, len(ends) - 3)])[3:]) * (sweeps[1][1] - sweeps[0][1])
        if len(ends) > 2 and step_m < voxel_m / 2:
            break
    at_first = (len(ends) - 1) // 2 * 2
    return ends[at_first], spreads[at_first], strange


def _strange_at_end(
    tracker: ScanToMap, sweeps: Sequence[tuple[int, float, PointCloud]], last: set[int]
) -> frozenset[int]:
    """Those of the last rows of sweeps that are strange to the sweeps before them; none where all of these are."""
    for _ in followed(tracker, (sweep for sweep in sweeps if sweep[0] not in last)):
        pass
    strange, ends = set[int](), [sweep for sweep in sweeps if sweep[0] in last]
    for row, time_s, cloud in ends:
        step = tracker.place(cloud, time_s)
        if tracker.is_strange(step):
            strange.add(row)
        else:
            tracker.accept(step)
    if len(strange) < len(ends):
        return frozenset(strange)
    for _, time_s, cloud in ends:
        tracker.follow(cloud, time_s)
    return frozenset()


def sense_of_times(
    voxel_m: float,
    velocity: Floats,
    told: int,
    sweeps: Sequence[tuple[int, float, PointCloud]],
    advance: Advance = no_progress,
) -> int:
    """The sense of the times of points in these sweeps, which began with this velocity: `told`, unless surely more
    points lie on the map by another: right times put points where they were, wrong ones blur it.

    Sweeps tell where the alignment holds both ways. Along what it leaves loose, as a narrow field does in a corridor,
    paths slide, and points lie on the map by chance: followed so, right times were called backwards.

    `advance` goes back by what is followed again, and in the end is where it was.
    """
    if len(sweeps) < FEWEST_TIMED:
        return told

    def on_map(sense: int) -> Iterator[float]:
        return _shares(voxel_m, velocity, ((row, at, retimed(cloud, 0.0, sense)) for row, at, cloud in sweeps))

    nearest = UNUSED if told == FORWARDS else FORWARDS
    shares = defaultdict[int, list[float]](list, {told: [], nearest: []})
    advance(NO_MAP - len(sweeps))
    for count, (of_told, of_nearest) in enumerate(zip(on_map(told), on_map(nearest), strict=True), 1):
        advance(1)
        shares[told].append(of_told)
        shares[nearest].append(of_nearest)
        if _gain(shares[nearest], shares[told])[1] < -WORSE:
            advance(len(sweeps) - NO_MAP - count)
            return told
    if _gain(shares[nearest], shares[told])[0] > 0:  # else what skews points the other way fits less still
        advance(NO_MAP - len(sweeps))
        for share in on_map(BACKWARDS):
            advance(1)
            shares[BACKWARDS].append(share)
    gains = {sense: _gain(of_sense, shares[told], FEWEST_TIMED - NO_MAP) for sense, of_sense in shares.items()}
    best = max(gains, key=lambda sense: gains[sense][0])
    return best if gains[best][1] > SURE else told


def _gain(shares: list[float], of_told: list[float], fewest: int = FEWEST_USUAL) -> tuple[float, float]:
    """Mean by which the shares of sweeps are greater, and this in its standard errors; 0 where fewer tell."""
    gain = np.subtract(shares, of_told)
    gain = gain[np.isfinite(gain)]
    if len(gain) < fewest:
        return 0.0, 0.0
    mean = float(gain.mean())
    return mean, mean / max(float(gain.std(ddof=1)) / np.sqrt(len(gain)), 1e-12)


def _shares(voxel_m: float, velocity: Floats, sweeps: Iterable[tuple[int, float, PointCloud]]) -> Iterator[float]:
    """The share of points on the map of each sweep but the first `NO_MAP`; NaN where the alignment is loose."""
    tracker = ScanToMap(voxel_m, velocity)
    for number, (_, time_s, cloud) in enumerate(sweeps):
        tracker.accept(step := tracker.place(cloud, time_s))
        if number >= NO_MAP:
            yield np.nan if step.is_loose else step.on_map

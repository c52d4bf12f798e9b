"""The poses of a run, round by round."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.registration.pairs import Registered
from hodge_pipeline.types import Bools, Candidates, Floats, Ints, Solution, Source, ViewGraph


def _no_pairs() -> Ints:
    return np.zeros((0, 2), np.int64)


def _no_reasons() -> NDArray[np.str_]:
    return np.zeros(0, "U1")


@dataclass(frozen=True)
class Verdicts:
    """What the diagnosis says of each edge (E,): its verdict, how probably it is right (NaN: untestable), and why."""

    verdict: NDArray[np.str_]
    probability: Floats
    reason: NDArray[np.str_]


@dataclass(frozen=True)
class Round:
    """One outer iteration: its edges, and the poses (N, 4, 4) that they led to. Round 0 holds the first poses, which
    `name` tells: odometry, or start where they were given.

    `registered` holds every pair that was, in the order of `candidates`; of them `rejected_pairs (R, 2)` were not
    accepted, for `rejected_reasons (R,)`. Only the last round has `verdicts`; `disabled (E,)` are edges that a person
    switched off.
    """

    graph: ViewGraph
    world_from_cam: Floats
    candidates: Candidates | None = None
    registered: Registered | None = None
    solution: Solution | None = None
    rejected_pairs: Ints = field(default_factory=_no_pairs)
    rejected_reasons: NDArray[np.str_] = field(default_factory=_no_reasons)
    verdicts: Verdicts | None = None
    disabled: Bools | None = None
    name: str = "odometry"

    @property
    def rejected_counts(self) -> Mapping[str, int]:
        """How many pairs were rejected for each reason."""
        return dict(sorted(Counter(self.rejected_reasons.tolist()).items()))


def pose_sets(rounds: Sequence[Round]) -> dict[str, Floats]:
    """The poses by name: odometry (or start), round 1, …, result."""
    names = [rounds[0].name, *(f"round {number}" for number in range(1, len(rounds) - 1)), "result"]
    return {name: one.world_from_cam for name, one in zip(names, rounds, strict=True)}


def true_poses(source: Source) -> Floats:
    """The source's own poses (N, 4, 4), NaN where a frame has none."""
    poses = np.full((len(source.frames), 4, 4), np.nan)
    for row, frame in enumerate(source.frames):
        if frame.world_from_cam is not None:
            poses[row] = frame.world_from_cam
    return poses


def has_truth(source: Source) -> bool:
    """Whether there are at least two poses of the source's own to compare with."""
    return sum(frame.world_from_cam is not None for frame in source.frames) > 1


def sequences_of(source: Source) -> dict[str, Ints]:
    """The rows of each sequence, in the order of the source."""
    names = np.array([frame.sequence for frame in source.frames])
    return {str(name): np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())}

"""Loop closures along the path: where the camera revisits a place, its clouds are registered to those of before.

A camera that revisits known places is off only by its drift since the last of them. So the path is followed once, and
each loop closure corrects the poses after it.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hodge_pipeline import se3
from hodge_pipeline.complex.occupancy import voxels
from hodge_pipeline.pairs.candidates import NO_PAIRS
from hodge_pipeline.pairs.drift import median_range_m, path_length_m
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.pairs import PreparedClouds
from hodge_pipeline.stages import OPTIONS, Advance, Registrar, no_progress
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, Registration

REVISIT = "revisit"
"""The reason in `proposed_by`."""
LOOP_RANGES = 4.0
"""Least length of the path between two views that close a loop, in median ranges, a turn as the arc at that range: two
thirds of a full turn. Nearer ones are found by edge builders."""
REACH_RANGES = 2.0
"""Median ranges, a turn as above, beyond which two views share too little."""
VIEWS_APART, COMPARED = 3, 12
"""Least number of key frames between the earlier views that a view is compared with, so that their errors are
independent; and how many, the nearest."""
LARGEST_DRIFT_SHARE = 0.03
"""Bound on drift as a share of the path since the last loop closure."""
VOXEL_RANGES = 0.1
"""Least side, in median ranges, of the voxels in which overlap is measured: .2 m in a room."""


@dataclass(frozen=True, config=OPTIONS)
class Revisits:
    """How loops are closed along the path, before any pair is proposed."""

    every_m: float = Field(
        default=1.0, gt=0, description="metres of the path, a turn as the arc at the scene, between two attempts"
    )
    most_m: float = Field(
        default=1.5, gt=0, description="metres that a place may be off at most: rooms that look alike may lie near"
    )
    longest_way_m: float = Field(
        default=65.0,
        gt=0,
        description="metres of that path beyond which no place is looked for by the poses; where a path is longer, "
        "frames that look alike are matched",
    )
    agree_m: float = Field(
        default=0.2,
        gt=0,
        description="metres, a turn as above: two views of before must put a view so near to the same place",
    )
    min_iou: float = Field(
        default=0.25, ge=0, lt=1, description="share of the space of two views that both must see, to be registered"
    )
    min_fitness: float = Field(default=0.3, ge=0, le=1, description="share of a cloud with a point of the other nearby")
    registration: Registrar = Field(
        default=Gicp(distances_m=(1.0, 0.5, 0.2, 0.1, 0.05), source_points=(1000, 1000, 1000, 2000, 4000)),
        description="how a view is registered to one of before, from a guess that may be half a metre off",
    )


def find_revisits(
    clouds: CloudSet,
    world_from_cam: Floats,
    part: Ints,
    options: Revisits,
    advance: Advance = no_progress,
    known: Edges | None = None,
) -> Edges:
    """The pairs that close loops, registered, from poses (K, 4, 4) in the order of the path; `advance` counts poses.

    No loop is looked for between two parts (K,), as no odometry joins them. A loop closure is accepted where two
    earlier views place a view alike, within the drift along the shortest path of steps and loops between them. The
    `known` loops come first.
    """
    return _Path(clouds, world_from_cam, part, options, known or Edges.of(NO_PAIRS)).found(advance)


class _Path:
    """The path so far: its poses as corrected by loops, and the lengths of steps between its views."""

    def __init__(self, clouds: CloudSet, world_from_cam: Floats, part: Ints, options: Revisits, known: Edges) -> None:
        self._options = options
        self._prepared, self._has_points = PreparedClouds(clouds.folder, options.registration), clouds.sizes > 0
        self._clouds, self._range_m = clouds, median_range_m(clouds, np.flatnonzero(self._has_points))
        self._steps = se3.inverse(world_from_cam[:-1]) @ world_from_cam[1:]
        self._at_m = path_length_m(world_from_cam, self._range_m)
        self._way_m = np.where(part[1:] == part[:-1], np.diff(self._at_m), np.inf)
        self._poses = world_from_cam.copy()
        self._known = known
        self._loops: list[tuple[int, int, Registration]] = []

    def found(self, advance: Advance) -> Edges:
        tried_m = 0.0
        for row in range(1, len(self._poses)):
            self._poses[row] = self._by_known(row)
            advance(1)
            if self._at_m[row] - tried_m < self._options.every_m or not self._has_points[row]:
                continue
            near, allowed_m = self._candidates(row)
            if len(near) == 2:
                tried_m = self._at_m[row]
                self._try(row, near, allowed_m)
        pairs = np.array([(i, j) for i, j, _ in self._loops], np.int64).reshape(-1, 2)
        found = Edges.of(pairs, REVISIT).with_registrations([loop for _, _, loop in self._loops])
        return Edges.joined([self._known.put(slice(None), proposed_by=REVISIT), found])

    def _by_known(self, row: int) -> Floats:
        """The pose that a known loop, or else the step from the pose before, leads to."""
        ending = np.flatnonzero(self._known.pairs[:, 1] == row)
        if len(ending):
            return np.asarray(self._poses[self._known.pairs[ending[0], 0]] @ self._known.i_from_j[ending[0]])
        return np.asarray(self._poses[row - 1] @ self._steps[row - 1])

    def _candidates(self, row: int) -> tuple[Ints, Floats]:
        """The two earlier views that overlap most with this one, and how far off each may be, metres."""
        options = self._options
        before = int(np.searchsorted(self._at_m, self._at_m[row] - LOOP_RANGES * self._range_m))
        way_m = self._ways(row, options.longest_way_m)[:before]
        allowed_m = np.minimum(options.agree_m + LARGEST_DRIFT_SHARE * way_m, options.most_m)
        shift_m = np.linalg.norm(self._poses[:before, :3, 3] - self._poses[row, :3, 3], axis=1)
        usable = np.flatnonzero(
            (shift_m < REACH_RANGES * self._range_m) & np.isfinite(way_m) & self._has_points[:before]
        )
        apart = self._far(se3.inverse(self._poses[usable]) @ self._poses[row])
        near = _spaced(usable[np.argsort(apart, kind="stable")][: int((apart < REACH_RANGES * self._range_m).sum())])
        shared = np.array([self._shared(int(one), row, float(allowed_m[one])) for one in near])
        best = near[np.argsort(-shared, kind="stable")][:2][: int((shared > options.min_iou).sum())]
        return best, allowed_m[best]

    def _shared(self, one: int, other: int, drift_m: float) -> float:
        """The IoU of the voxels of two views, as wide as the drift."""
        voxel_m = max(VOXEL_RANGES * self._range_m, drift_m)
        origin = np.floor(self._poses[one, :3, 3] / voxel_m).astype(np.int64)
        a, b = (
            voxels(se3.transform(self._poses[row], self._clouds[row].points_in_cam.astype(float)), voxel_m, origin)
            for row in (one, other)
        )
        common = len(np.intersect1d(a, b, assume_unique=True))
        return common / max(len(a) + len(b) - common, 1)

    def _ways(self, row: int, limit_m: float) -> Floats:
        """The shortest path (row + 1,) by steps and loops from a view to each before it, metres; ∞ beyond the limit."""
        i, j = np.arange(row), np.arange(1, row + 1)
        loops = np.array([loop[:2] for loop in self._loops], np.int64).reshape(-1, 2)
        loops = np.concatenate([loops, self._known.pairs[self._known.pairs[:, 1] <= row]])
        a, b = np.concatenate([i, loops[:, 0]]), np.concatenate([j, loops[:, 1]])
        cost = np.concatenate([self._way_m[:row], np.zeros(len(loops))]) + 1e-9
        ways = csr_matrix((cost, (a, b)), shape=(row + 1, row + 1))
        return np.asarray(dijkstra(ways, directed=False, indices=row, limit=limit_m))

    def _try(self, row: int, near: Ints, allowed_m: Floats) -> None:
        found = list[Registration]()
        for at, most_m in zip(near, allowed_m, strict=True):
            one = self._register(int(at), row, float(most_m))
            if one is None:
                return
            found.append(one)
        places = [self._poses[at] @ one.i_from_j for at, one in zip(near, found, strict=True)]
        if self._far(se3.inverse(places[0]) @ places[1]) > self._options.agree_m:
            return
        self._loops += [(int(at), row, one) for at, one in zip(near, found, strict=True)]
        self._poses[row] = places[0]

    def _register(self, target: int, source: int, allowed_m: float) -> Registration | None:
        """The earlier view `target` registered with `source`; None where fitness or correction fail their limits."""
        guess = se3.inverse(self._poses[target]) @ self._poses[source]
        found = self._options.registration.register(self._prepared[target], self._prepared[source], guess)
        moved_m = self._far(se3.inverse(guess) @ found.i_from_j)
        return found if found.fitness >= self._options.min_fitness and moved_m <= allowed_m else None

    def _far(self, motions: Floats) -> Floats:
        """How far (...,) motions move what is seen, metres."""
        return se3.displacement_m(motions, self._range_m)


def _spaced(rows: Ints) -> Ints:
    """The first `COMPARED` of the rows that are `VIEWS_APART` from each earlier one."""
    kept: list[int] = []
    for row in rows.tolist():
        if all(abs(row - other) >= VIEWS_APART for other in kept):
            kept.append(row)
        if len(kept) == COMPARED:
            break
    return np.array(kept, np.int64)

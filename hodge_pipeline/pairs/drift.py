"""Loop candidates of drifted poses: overlap, with a tolerance that grows with the path between two frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.pairs.candidates import NO_PAIRS, usable_rows
from hodge_pipeline.pairs.overlap import pairwise_iou
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Ints

DRIFT_SHARE = 0.05
"""Drift as a share of the path, where a turn counts as the arc at the scene: odometry of RGB-D frames drifts by 1 to 5
%, of lidar by less.
"""
OCTAVES = 8
"""Sizes of voxels, each twice the last."""
SAMPLED_FRAMES = 50
"""Of a median range: a limit on cost."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DriftEdges:
    """Pairs the frames whose clouds may share space, however far odometry has drifted between them.

    Two frames are compared in voxels as wide as the drift to expect between them: small ones after a short path, large
    ones after a long path.
    """

    min_iou: float = Field(
        default=0.2, ge=0, lt=1, description="share in [0, 1): a pair's IoU in such voxels exceeds it"
    )
    voxel_m: float = Field(
        default=0.2,
        gt=0,
        description="metres: the smallest voxels, which forgive as much drift; the largest are 128 times",
    )
    per_frame: int = Field(
        default=6, ge=1, description="pairs of a frame with earlier ones, at most: those of the largest IoU"
    )
    reach: int = Field(
        default=5,
        ge=1,
        description="frames: of so many consecutive ones only the best is paired, and none so near: odometry has "
        "joined them",
    )

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Pairs of one sequence, with their IoU; between sequences the poses say nothing."""
        names = np.array([frame.sequence for frame in frames], dtype=np.str_)
        usable = usable_rows(clouds, world_from_cam)
        found = [
            self._of_one(usable[names[usable] == name], clouds, world_from_cam) for name in np.unique(names[usable])
        ]
        pairs = np.concatenate([NO_PAIRS, *(pairs for pairs, _ in found)])
        return Edges.proposed(pairs, "drift", np.concatenate([np.zeros(0), *(overlap for _, overlap in found)]))

    def _of_one(self, rows: Ints, clouds: CloudSet, world_from_cam: Floats) -> tuple[Ints, Floats]:
        """The pairs of one sequence's rows, in their order, and their IoU."""
        if len(rows) < 2:
            return NO_PAIRS, np.zeros(0)
        poses = world_from_cam[rows]
        way_m = path_length_m(poses, median_range_m(clouds, rows))
        pairs, overlap = [NO_PAIRS], [np.zeros(0)]
        for octave in range(OCTAVES):
            voxel_m = self.voxel_m * 2**octave
            iou = pairwise_iou(clouds.read(rows), poses, voxel_m, above=self.min_iou).tocoo()
            i, j = iou.row.astype(np.int64), iou.col.astype(np.int64)
            drift_m = DRIFT_SHARE * (way_m[j] - way_m[i])
            mine = (j - i > self.reach) & (drift_m <= voxel_m) & ((drift_m > voxel_m / 2) | (octave == 0))
            pairs.append(np.stack([i, j], axis=1)[mine])
            overlap.append(iou.data[mine])
            if DRIFT_SHARE * way_m[-1] <= voxel_m:
                break
        every, scores = np.concatenate(pairs), np.concatenate(overlap)
        kept = best_of_each(every, scores, self.per_frame, self.reach)
        return rows[every[kept]], scores[kept]


def best_of_each(pairs: Ints, scores: Floats, most: int, reach: int) -> Ints:
    """Rows of the pairs (P, 2), i < j: for each j the `most` best, no two of them within `reach` of each other."""
    kept: list[int] = []
    taken: dict[int, list[int]] = {}
    for row in np.lexsort((pairs[:, 0], -scores)).tolist():
        i, j = int(pairs[row, 0]), int(pairs[row, 1])
        partners = taken.setdefault(j, [])
        if len(partners) < most and all(abs(i - other) > reach for other in partners):
            partners.append(i)
            kept.append(row)
    return np.sort(np.array(kept, np.int64))


def path_length_m(world_from_cam: Floats, range_m: float) -> Floats:
    """The path length (N,) up to each pose: steps, and turns as the arc at the scene's median distance."""
    motions = se3.inverse(world_from_cam[:-1]) @ world_from_cam[1:]
    return np.concatenate([[0.0], np.cumsum(se3.displacement_m(motions, range_m))])


def median_range_m(clouds: CloudSet, rows: Ints) -> float:
    """The median distance of points from their cameras, metres, of a sample of these rows; 1 where there are none."""
    some = rows[:: max(1, len(rows) // SAMPLED_FRAMES)].tolist()
    return float(np.median([np.median(np.linalg.norm(clouds[row].points_in_cam, axis=1)) for row in some] or [1.0]))

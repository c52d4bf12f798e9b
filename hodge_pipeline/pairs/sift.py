"""Pairs of frames whose images show the same: SIFT landmarks that one relative pose explains (paper, Section 4)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import SourceError
from hodge_pipeline.pairs.candidates import NO_PAIRS, usable_rows
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.pairs.vlad import global_descriptors, most_similar, vocabulary
from hodge_pipeline.registration.descriptors import CONFIDENCE, LOWE_RATIO, MOST_RANSAC_STEPS, match, root_sift
from hodge_pipeline.types import CloudSet, Edges, Floats, Floats32, Frame
from hodge_pipeline.types.text import counted

log = logging.getLogger("hodge_pipeline")

WORDS = 32
"""Of the global descriptors' vocabulary: 16 kB a frame."""
MAX_ERROR_PX = 1.5
"""From the epipolar line, for a match to be an inlier."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SiftEdges:
    """Pairs the frames with more than `min_inliers` matches of landmarks that agree with one relative pose.

    Pairs are proposed before anything is matched: the neighbours in the sequence, and the frames whose global
    descriptors (VLAD over the sequence's own landmarks) are the most similar. Poses play no part, so every outer
    iteration gets the same pairs. `clouds.landmarks` says how many landmarks a frame has; 1000 serve.
    """

    min_inliers: int = Field(
        50,
        ge=8,
        description="a pair has more verified matches than this; 50 is the paper's, which does not say if it verifies",
    )
    reach: int = Field(5, ge=1, description="frames: neighbours up to this far in the sequence are always matched")
    similar_per_frame: int = Field(
        10,
        ge=0,
        description="the most similar frames beyond the reach that are matched too, at most one of every `reach` "
        "consecutive ones; about 5 ms a pair",
    )

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Verified pairs; `overlap` is the share of the poorer frame's landmarks that are inliers.

        None for frames without points or landmarks. Raises `SourceError` where no frame has any.
        """
        rows = usable_rows(clouds)
        if len(rows) < 2:
            return Edges.proposed(NO_PAIRS, "sift")
        local = _Local(clouds)
        seen = np.array([row for row in rows.tolist() if len(local.points(row))], np.int64)
        if not len(seen):
            raise SourceError(
                f"no image of the {counted(len(rows), 'frame')} gave a SIFT landmark: set clouds.landmarks to 1000, or "
                "use edges that need no images, such as centroid or overlap"
            )
        near = SequentialEdges(reach=self.reach).propose(frames, clouds, world_from_cam).pairs
        return _verified(self, clouds, seen.tobytes(), near[np.isin(near, seen).all(axis=1)].tobytes())


@lru_cache(maxsize=1)  # the next outer iteration asks the same; rows travel as bytes, which can be hashed
def _verified(options: SiftEdges, clouds: CloudSet, seen: bytes, near: bytes) -> Edges:
    """The pairs that one motion explains, of the neighbours `near` and those that look alike.

    `seen`: rows of the frames with landmarks, int64; `near`: pairs of them (P, 2), int64.
    """
    local, rows = _Local(clouds), np.frombuffer(seen, np.int64)
    vectors = global_descriptors(local, rows, vocabulary(local, rows, WORDS, 0))
    similar = np.sort(rows[most_similar(vectors, options.similar_per_frame, options.reach)], axis=1)
    proposed = np.unique(np.concatenate([np.frombuffer(near, np.int64).reshape(-1, 2), similar]), axis=0)
    shares = np.zeros(len(proposed))
    for at, (i, j) in enumerate(proposed.tolist()):
        matches = match(local.descriptors(i), local.descriptors(j), LOWE_RATIO)
        if len(matches) <= options.min_inliers:
            continue
        points_i, points_j = local.points(i)[matches[:, 0]], local.points(j)[matches[:, 1]]
        inliers = count_inliers(points_i, points_j, local.pixel_rad((i, j)))
        if inliers > options.min_inliers:
            shares[at] = inliers / min(len(local.points(i)), len(local.points(j)))
    kept = shares > 0
    log.info("sift: %d of %d proposed pairs have more than %d matches", kept.sum(), len(kept), options.min_inliers)
    return Edges.proposed(proposed[kept], "sift", shares[kept])


class _Local:
    """The landmarks of frames, by their rows."""

    def __init__(self, clouds: CloudSet) -> None:
        self._clouds = clouds

    def descriptors(self, row: int) -> Floats32:
        """Unit RootSIFT descriptors (n, 128) (Arandjelović and Zisserman 2012)."""
        marks = self._clouds.marks
        return root_sift(np.asarray(self._clouds.mark_descriptors[marks[row] : marks[row + 1]]))

    def points(self, row: int) -> Floats32:
        """The slopes x/z, y/z (n, 2) of their rays."""
        marks = self._clouds.marks
        points = np.asarray(self._clouds.mark_points[marks[row] : marks[row + 1]])
        return np.asarray(points[:, :2] / points[:, 2:])

    def pixel_rad(self, rows: Sequence[int]) -> float:
        """The mean angle of a pixel of these frames."""
        return float(np.mean([self._clouds.mark_pixel_rad[self._clouds.marks[row]] for row in rows]))


def count_inliers(slopes_i: Floats32, slopes_j: Floats32, pixel_rad: float) -> int:
    """How many matched rays (M, 2) one essential matrix explains (RANSAC with five points, Nistér 2004); 0 of fewer
    than eight. `pixel_rad`: the angle of a pixel. OpenCV seeds RANSAC itself: the same rays give the same number.
    """
    if len(slopes_i) < 8:
        return 0
    model, inlier = cv2.findEssentialMat(
        slopes_i, slopes_j, np.eye(3), method=cv2.RANSAC, prob=CONFIDENCE, threshold=MAX_ERROR_PX * pixel_rad,
        maxIters=MOST_RANSAC_STEPS,
    )  # fmt: skip
    return 0 if model is None or inlier is None else int(np.count_nonzero(inlier))

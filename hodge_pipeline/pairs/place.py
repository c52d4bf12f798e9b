"""Loop candidates by what a place looks like, whatever the poses say: scan contexts (Kim and Kim, IROS 2018)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from hodge_pipeline.pairs.candidates import NO_PAIRS, usable_rows
from hodge_pipeline.pairs.drift import best_of_each
from hodge_pipeline.types import CloudSet, Edges, Floats, Floats32, Frame, Ints, PointCloud

RINGS, SECTORS = 20, 60
"""Of a context, as Kim and Kim have them: 6 degrees, and 4 m for a scanner that sees 80 m."""
GROUND_QUANTILE = 0.05
"""Heights are counted from the lowest points, which noise does not reach."""
SAMPLED_CLOUDS = 50
"""Of the median range that the rings divide: a limit on cost."""
RANGE_QUANTILE = 0.99
"""Of a cloud's horizontal distances: farther points are few, and would leave the outer rings empty."""
FEWEST_COMMON = SECTORS / 4
"""Columns over which a mean cosine is taken at least: fewer common ones count as so many, the others at 0."""
BLUR_CELLS = 1.0
"""Sigma: two metres aside a facade stands in the next ring, where unblurred columns have nothing in common."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PlaceEdges:
    """Pairs the scans whose contexts are alike after a turn about the scanner's z axis.

    A context holds the height of what stands in each cell of a polar grid about the scanner. Of the scans whose rings
    are alike, which no turn changes, a tree gives the nearest; those are compared in every turn. The poses play no
    part: a loop is found however far odometry has drifted, and places that look alike are found as well.
    """

    min_similarity: float = Field(
        default=0.8, ge=0, le=1, description="mean cosine of the columns of two contexts, from which a pair is proposed"
    )
    per_frame: int = Field(default=2, ge=1, description="pairs of a frame with earlier ones, at most: the most alike")
    reach: int = Field(
        default=20, ge=1, description="frames: of so many consecutive ones only the best is paired, and none so near"
    )
    thinned: int = Field(
        default=3,
        ge=1,
        description="frames: of the pairs between so many consecutive ones and as many others, the best",
    )
    compared: int = Field(default=40, ge=1, description="scans with the most similar rings that are compared with each")

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Pairs at least `reach` apart where one sequence has both, with their similarity as overlap."""
        rows = usable_rows(clouds)
        if len(rows) < 2:
            return Edges.proposed(NO_PAIRS, "place")
        some = clouds.read(rows[:: max(1, len(rows) // SAMPLED_CLOUDS)])
        ranges_m = [np.quantile(np.hypot(*cloud.points_in_cam[:, :2].T), RANGE_QUANTILE) for cloud in some]
        reach_m = float(np.median(ranges_m))
        contexts = np.array([context(cloud, reach_m) for cloud in clouds.read(rows)])
        names = np.array([frames[row].sequence for row in rows], dtype=np.str_)
        near = _nearest_rings(contexts, min(self.compared, len(rows)))
        pairs = near[(names[near[:, 0]] != names[near[:, 1]]) | (near[:, 1] - near[:, 0] > self.reach)]
        alike = _similarity(contexts, pairs)
        pairs, alike = pairs[alike >= self.min_similarity], alike[alike >= self.min_similarity]
        kept = best_of_each(pairs, alike, self.per_frame, self.reach)
        kept = kept[np.argsort(-alike[kept], kind="stable")]
        kept = kept[np.unique(pairs[kept] // self.thinned, axis=0, return_index=True)[1]]
        return Edges.proposed(rows[pairs[kept]], "place", alike[kept])


def context(cloud: PointCloud, reach_m: float) -> Floats32:
    """The scan context (RINGS, SECTORS): the greatest height over the ground in each cell of a polar grid about the
    scanner's z axis, up to `reach_m` away, blurred; metres, 0 where nothing stands.
    """
    points = cloud.points_in_cam
    flat_m = np.hypot(points[:, 0], points[:, 1])
    inside = flat_m < reach_m
    ring = (flat_m[inside] * (RINGS / reach_m)).astype(np.int64)
    turn = np.arctan2(points[inside, 1], points[inside, 0]) / (2 * np.pi) % 1.0
    heights = points[inside, 2] - np.quantile(points[:, 2], GROUND_QUANTILE)
    cells = np.zeros((RINGS, SECTORS), np.float32)
    np.maximum.at(cells, (ring, (turn * SECTORS).astype(np.int64) % SECTORS), heights.astype(np.float32))
    return np.asarray(gaussian_filter(cells, BLUR_CELLS, mode=("constant", "wrap")))


def _nearest_rings(contexts: Floats32, count: int) -> Ints:
    """Pairs (P, 2), i < j, of each context and those `count` whose rings are the most alike."""
    keys = contexts.mean(axis=2)
    _, nearest = cKDTree(keys).query(keys, count)
    nearest = nearest.reshape(len(keys), count)
    pairs = np.stack([np.repeat(np.arange(len(keys)), count), nearest.ravel()], axis=1)
    return np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)


def _similarity(contexts: Floats32, pairs: Ints) -> Floats:
    """The mean cosine (P,) of the columns that both contexts of a pair have, in the turn where it is greatest.

    All turns at once: the sums over columns are circular correlations, products after a Fourier transform.
    """
    norms = np.linalg.norm(contexts, axis=1)
    unit = contexts / np.maximum(norms, 1e-9)[:, None]
    columns, filled = np.fft.rfft(unit, axis=2), np.fft.rfft(norms > 0, axis=1)
    out = np.zeros(len(pairs))
    for at, (i, j) in enumerate(pairs.tolist()):
        cosines = np.fft.irfft((columns[i].conj() * columns[j]).sum(axis=0), SECTORS)
        common = np.fft.irfft(filled[i].conj() * filled[j], SECTORS)
        out[at] = (cosines / np.maximum(common, FEWEST_COMMON)).max()
    return np.clip(out, 0.0, 1.0)

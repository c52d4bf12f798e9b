"""Pairs of frames that see the same space: the intersection over union of their voxels, of all pairs at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy.sparse import csr_matrix

from hodge_pipeline.complex.occupancy import voxel_occupancy
from hodge_pipeline.pairs.candidates import NO_PAIRS, row_blocks, usable_rows
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Ints, PointCloud

FRAMES_OF_A_PLACE, DIRECTIONS = 16, 4
"""Nine edges a frame are kept in the end: 16 of each place leave a choice. Cells to a unit of the view's direction."""


def pairwise_iou(
    clouds: Iterable[PointCloud],
    world_from_cam: Floats,
    voxel_m: float,
    above: float = 0.0,
    partners: Ints | None = None,
) -> csr_matrix:
    """The CSR matrix (N, N) of the intersection over union of all pairs i < j, where it exceeds `above`.

    |A ∩ B| of all pairs is one sparse product of the frames-by-voxels occupancy with its transpose, made in blocks
    of rows, so that memory holds the answer and one block; |A ∪ B| = |A| + |B| − |A ∩ B|. The clouds are voxelised
    in the world frame under the poses (N, 4, 4), on the lattice through the world's origin. Where `partners (R,)`,
    ascending rows, are named, only pairs with one of them.
    """
    seen, sizes = voxel_occupancy(clouds, world_from_cam, voxel_m, partners)
    count = len(sizes)
    partners = np.arange(count) if partners is None else partners
    is_partner = np.isin(np.arange(count), partners)
    rows, columns, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    others = seen[partners]
    for block in row_blocks(count):
        first = int(np.searchsorted(partners, block.start)) if len(partners) == count else 0
        common = (others[first:] @ seen[block].T).tocoo()  # the right side is copied
        i, j = common.col + block.start, partners[common.row.astype(np.int64) + first]
        iou = common.data / (sizes[i] + sizes[j] - common.data)
        keep = ((i < j) | ((i > j) & ~is_partner[i])) & (iou > above)
        rows.append(np.minimum(i, j)[keep])
        columns.append(np.maximum(i, j)[keep])
        values.append(iou[keep])
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csr_matrix(entries, shape=(count, count))


def some_of_each_place(world_from_cam: Floats, side_m: float) -> Ints:
    """Rows of at most `FRAMES_OF_A_PLACE` poses (N, 4, 4) of each place, evenly over its own, ascending.

    A place is a cube of this side and a direction of view, about 15° wide. However often a camera comes back, a frame
    is compared with so many of each place that it may see: what is compared grows with the frames and with the space.
    """
    cells = np.concatenate([world_from_cam[:, :3, 3] / side_m, world_from_cam[:, :3, 2] * DIRECTIONS], axis=1)
    _, place = np.unique(np.floor(np.nan_to_num(cells)).astype(np.int64), axis=0, return_inverse=True)
    order = np.argsort(place.ravel(), kind="stable")
    sizes = np.bincount(place.ravel())
    rank = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    share = np.repeat(np.minimum(FRAMES_OF_A_PLACE / sizes, 1.0), sizes)
    return np.sort(order[np.floor(rank * share) != np.floor((rank - 1) * share)])


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class OverlapEdges:
    """Pairs the frames whose clouds share voxels in the world frame (the paper's intersection over union)."""

    min_iou: float = Field(0.5, ge=0, lt=1, description="share in [0, 1): a pair's IoU exceeds it; 0.5 is the paper's")
    voxel_m: float = Field(
        0.1,
        gt=0,
        description="metres: side of a voxel. It decides how many pairs there are and how much drift is forgiven: "
        "with 11 cm of drift in a room, 0.1 finds half of the pairs whose true IoU exceeds 0.3, and 0.3 finds 97 %",
    )

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Pairs whose IoU exceeds `min_iou`, with it; none for frames without points or a finite pose."""
        if len(usable_rows(clouds, world_from_cam)) < 2:
            return Edges.proposed(NO_PAIRS, "overlap")
        partners = some_of_each_place(world_from_cam, 2 * self.voxel_m)
        iou = pairwise_iou(clouds, world_from_cam, self.voxel_m, above=self.min_iou, partners=partners).tocoo()
        return Edges.proposed(np.stack([iou.row, iou.col], axis=1), "overlap", iou.data)

"""Candidate pairs: nearest neighbours by global descriptors (VLAD) of local features."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hodge_pipeline.pairs.sift_similarity import global_descriptors, most_similar, vocabulary
from hodge_pipeline.registration.global_features import DescribedCloud, describe
from hodge_pipeline.registration.global_landmarks import DescribedImage
from hodge_pipeline.registration.global_pairs import load_description
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.types import CloudSet, Floats32, Ints


class LocalDescriptors:
    """Unit local descriptors of each row, whatever they were made of: RootSIFT, or the roots of FPFH histograms."""

    def __init__(self, described: Path, clouds: CloudSet, voxel_m: float) -> None:
        self._described, self._clouds, self._voxel_m = described, clouds, voxel_m

    def descriptors(self, row: int) -> Floats32:
        """Descriptors (n, D) of one frame."""
        found = load_description(self._described, row)
        if isinstance(found, DescribedImage):
            return found.descriptors
        if not isinstance(found, DescribedCloud):  # another registrar's own: geometry is compared by FPFH all the same
            found = describe(self._clouds[row], self._voxel_m)
        features = max((found, *found.coarser), key=len).features
        positive = np.maximum(features, 0)
        return np.asarray(np.sqrt(positive / np.maximum(positive.sum(axis=1, keepdims=True), 1e-12)))


def all_pairs(rows: Ints) -> Ints:
    """Every pair (P, 2) of these rows, i < j."""
    i, j = np.triu_indices(len(rows), 1)
    return np.stack([rows[i], rows[j]], axis=1).astype(np.int64)


def similar_pairs(local: LocalDescriptors, rows: Ints, options: GlobalStart, ordered: bool) -> Ints:
    """Pairs (P, 2), i < j, of each row and the most similar others, by VLAD (Jégou et al. 2010).

    The vocabulary is learnt from the rows themselves, so indoor and outdoor, near and far need nothing else.
    `ordered`: whether rows that follow each other are joined already; see `GlobalStart.reach`.
    """
    centres = vocabulary(local, rows, options.words, options.seed)
    vectors = global_descriptors(local, rows, centres)
    reach = options.reach if ordered else 0
    return np.asarray(np.sort(rows[most_similar(vectors, options.similar_per_frame, reach)], axis=1))

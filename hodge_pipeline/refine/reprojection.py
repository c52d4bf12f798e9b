"""Reprojection before and after a refinement: the same observations, none of which outweighs all others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline.refine.guard import Measure
from hodge_pipeline.types import Floats, Ints, ModelQuality

BEHIND_TOLERANCE = 0.001
"""Of the observations: a wrong match may put its point on either side of a camera."""


def reprojection_measures(
    before: Sequence[ModelQuality], after: ModelQuality, tolerance: float
) -> tuple[Measure, Measure]:
    """Observations behind a camera, and the mean error (px) of those before the camera both times, each capped.

    Of the observations that both have, by image name and keypoint. The `tolerance` of the mean is relative.
    """
    errors_px = _same_observations(before, after)
    count = errors_px.shape[1]
    behind = np.isinf(errors_px)
    seen = errors_px[:, ~behind.any(axis=0)]
    cap_px = max(quality.cap_px for quality in before)
    mean = np.minimum(seen, cap_px).mean(axis=1) if seen.size else np.full(2, np.nan)
    before_px, after_px = float(mean[0]), float(mean[1])
    lost_before, lost_after = (int(one) for one in behind.sum(axis=1))
    name, most_lost = f"mean reprojection error, capped at {cap_px:.4g} px", BEHIND_TOLERANCE * count
    return (
        Measure("observations behind a camera", lost_before, lost_after, "lower", most_lost, f"of {count}"),
        Measure(name, before_px, after_px, "lower", tolerance * before_px, "px"),
    )


def _same_observations(before: Sequence[ModelQuality], after: ModelQuality) -> Floats:
    """The errors (2, N) of the observations that both have; of one that several models have before, the first's."""
    names = dict.fromkeys(name for quality in (*before, after) for name in quality.image_names)
    number = {name: row for row, name in enumerate(names)}
    keys_before = np.concatenate([_keys(quality, number) for quality in before])
    errors_before = np.concatenate([quality.errors_px for quality in before])
    keys_before, first = np.unique(keys_before, return_index=True)
    _, row_before, row_after = np.intersect1d(keys_before, _keys(after, number), return_indices=True)
    return np.stack([errors_before[first][row_before], after.errors_px[row_after]])


def _keys(quality: ModelQuality, number: dict[str, int]) -> Ints:
    """One number (N,) for each image and keypoint; COLMAP's own keypoints are numbered by 32 bits."""
    image = np.array([number[name] for name in quality.image_names], np.int64)
    return np.asarray((image[quality.keypoints[:, 0]] << 32) + quality.keypoints[:, 1], np.int64)

"""Frames that show the images of the frame before again, as where a camera stalls: they tell of no motion."""

from __future__ import annotations

import filecmp
from collections.abc import Sequence

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Frame, Ints


def find_repeats(frames: Sequence[Frame]) -> Ints:
    """The rows of frames whose colour file and depth image are those of the frame before, in the same sequence."""
    pairs = zip(frames[:-1], frames[1:], strict=True)
    return np.array([row for row, pair in enumerate(pairs, start=1) if _are_same(*pair)], np.int64)


def _are_same(one: Frame, other: Frame) -> bool:
    if one.sequence != other.sequence or not (one.image and other.image and one.read_depth and other.read_depth):
        return False
    try:  # files of two sizes, as nearly all are, are not read
        if not filecmp.cmp(one.image.path, other.image.path, shallow=False):
            return False
        depth = other.read_depth()
        in_the_dark = not depth.any()  # where all frames are alike
        return not in_the_dark and np.array_equal(one.read_depth(), depth, equal_nan=True)
    except (SourceError, OSError):
        return False

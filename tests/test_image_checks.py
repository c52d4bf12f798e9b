"""Frames of images in memory: what cannot be metres, and what cannot be a camera, is refused in a line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from hodge_pipeline import Camera, frames_from_images
from hodge_pipeline.errors import SourceError

DEPTH = np.full((24, 32), 2.0, np.float32)
K = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
NEAR, TALL = np.zeros((24, 32), np.float32), np.full((32, 24), 2.0, np.float32)


def changed(matrix: np.ndarray, at: Any, value: float) -> np.ndarray:
    out = matrix.copy()
    out[at] = value
    return out


def test_what_is_right_is_taken() -> None:
    up = changed(K, (1, 1), -30.0)  # y up, as in ICL-NUIM
    for camera in (K, up, Camera(32, 24, 30, 30, 15.5, 11.5)):
        made = frames_from_images([DEPTH, NEAR], camera, [np.zeros((24, 32, 3), np.uint8)] * 2, [0.0, 0.1])
        assert [frame.stamp_s for frame in made] == [0.0, 0.1]


@pytest.mark.parametrize(
    ("depths", "camera", "message"),
    [
        ([DEPTH * 1000], K, r"depth image 0 has a median of 2000 m: divide .* \(1000 for mm\)"),
        ([DEPTH, (DEPTH * 1000).astype(np.uint16)], K, "depth image 1 holds uint16, as stored by a sensor"),
        ([changed(DEPTH, (3, 4), np.nan)], K, "depth image 0 has values that are not finite or below 0"),
        ([changed(DEPTH, (3, 4), -1)], K, "depth image 0 has values that are not finite or below 0"),
        ([DEPTH, TALL], K, r"depth image 1 has the shape \(32, 24\): expected \(24, 32\)"),
        ([DEPTH[..., None]], K, r"depth image 0 has the shape \(24, 32, 1\): expected \(H, W\)"),
        ([DEPTH], K.T, r"expected K in pixels, \[\[fx, 0, cx\]"),
        ([DEPTH], np.eye(4), r"expected K in pixels, \[\[fx, 0, cx\]"),
        ([DEPTH], changed(K, (0, 1), 2.0), "the camera has the skew 2"),
        ([DEPTH], changed(K, (0, 0), -30.0), "fx -30.* fx above 0"),
        ([DEPTH], changed(K, (0, 2), 320.0), "cx 320.* an image of 32x24"),
        ([DEPTH], Camera(64, 48, 60, 60, 31, 23), "the camera has 64x48 pixels, the depth images 32x24"),
    ],
)
def test_what_is_wrong_is_one_line(depths: Any, camera: Any, message: str) -> None:
    with pytest.raises(SourceError, match=message) as raised:
        frames_from_images(depths, camera)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"colours": [np.zeros((24, 32, 3), np.float32)]}, "colour image 0 is float32"),
        ({"colours": [np.zeros((24, 32), np.uint8)]}, r"shape \(24, 32\): expected uint8 \(24, 32, 3\)"),
        ({"colours": []}, "0 colour images for 1 depth images"),
        ({"stamps_s": [0.0, 1.0]}, "2 stamps for 1 depth images"),
    ],
)
def test_what_does_not_belong_to_the_depth_is_one_line(options: Any, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        frames_from_images([DEPTH], K, **options)

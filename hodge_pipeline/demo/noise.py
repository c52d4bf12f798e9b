"""The errors of a structured-light camera, added to ideal images.

The depth model is the one of ICL-NUIM (Handa et al., A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM,
ICRA 2014, after Barron and Malik): pixels are shifted at random, and depth is measured as a disparity in whole steps,
so that its error grows with the square of depth. Added here: an error that neighbouring pixels share, since the
camera correlates windows, and no measurement where surfaces are grazed, at their edges, and out of range.
"""

from __future__ import annotations

import cv2
import numpy as np

from hodge_pipeline.types import Bools, Bytes, Floats, Floats32

DISPARITY_M = 351.3
"""Disparity steps times metres, for 640 pixels: one step is 2.8 mm at 1 m and 4.6 cm at 4 m."""
WHITE_STEPS = 1 / 6
"""Standard deviation of the disparity of single pixels, in steps."""
SHARED_STEPS = 0.5
"""Standard deviation of the error that neighbours share: 1.3 cm at 3 m, with rounding 1.5 cm, as Khoshelham and
Elberink measured (Sensors 12, 2012)."""
SHARED_SHARE_OF_WIDTH = 0.02
"""Correlation length of that error, as a share of the image's width."""
SHIFT_SHARE_OF_WIDTH = 0.5 / 640
"""Standard deviation of the pixels' shift: half a pixel of 640 (Handa et al.)."""
RANGE_M = (0.4, 4.5)
"""Depth that is measured, about that of the first Kinect."""
GRAZING_COS = 0.17
"""Cosine of incidence below which nothing is measured: 80 degrees."""
EDGE_RATIO, EDGE_DROP = 0.05, 0.7
"""Relative step of depth that is an edge, and the share of its pixels that are not measured."""


def measured_depth(depth_m: Floats32, facing: Floats32, rng: np.random.Generator, scale: float) -> Floats32:
    """The measured depth (H, W) of a true one, metres, 0 where there is none.

    `facing (H, W)` is the cosine of incidence; `scale` multiplies every random error; with 0 only the range is limited.
    """
    if scale == 0:
        return np.where(_in_range(depth_m), depth_m, np.float32(0))
    height, width = depth_m.shape
    shift = rng.normal(0, scale * SHIFT_SHARE_OF_WIDTH * width, (2, height, width))
    rows = np.clip(np.rint(np.arange(height)[:, None] + shift[0]), 0, height - 1).astype(int)
    columns = np.clip(np.rint(np.arange(width)[None, :] + shift[1]), 0, width - 1).astype(int)
    shifted = depth_m[rows, columns]
    error = WHITE_STEPS * rng.standard_normal((height, width)) + SHARED_STEPS * _shared(rng, height, width)
    steps = np.rint(DISPARITY_M / np.maximum(shifted, 1e-3) + scale * error)
    measured = (DISPARITY_M / np.maximum(steps, 1)).astype(np.float32)
    keep = _in_range(measured) & (shifted > 0) & (facing[rows, columns] > GRAZING_COS)
    keep &= ~(_edges(depth_m) & (rng.random((height, width)) < EDGE_DROP))
    return np.asarray(np.where(keep, measured, 0), np.float32)


def photographed(image: Floats32, rng: np.random.Generator, scale: float) -> Bytes:
    """The 8-bit RGB image (H, W, 3) of an ideal one in 0..1: with vignetting and grain, both times `scale`."""
    height, width = image.shape[:2]
    row, column = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    vignette = 1 - 0.1 * scale * (row**2 + column**2)
    grain = rng.normal(0, 0.01 * scale, image.shape)
    return np.asarray(np.clip(255 * (image * vignette[..., None] + grain) + 0.5, 0, 255), np.uint8)


def _in_range(depth_m: Floats32) -> Bools:
    return np.asarray((depth_m > RANGE_M[0]) & (depth_m < RANGE_M[1]))


def _shared(rng: np.random.Generator, height: int, width: int) -> Floats:
    """Smooth noise (H, W) of unit variance."""
    sigma = SHARED_SHARE_OF_WIDTH * width
    smooth = cv2.GaussianBlur(rng.standard_normal((height, width)), (0, 0), sigma)
    return np.asarray(smooth / smooth.std())


def _edges(depth_m: Floats32) -> Bools:
    """Where (H, W) a pixel's neighbours differ from it by more than `EDGE_RATIO` of the depth."""
    near, far = cv2.erode(depth_m, np.ones((3, 3))), cv2.dilate(depth_m, np.ones((3, 3)))
    return np.asarray(far - near > EDGE_RATIO * np.maximum(depth_m, 1e-3))

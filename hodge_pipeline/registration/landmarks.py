"""Landmarks of a frame: SIFT features of its image at the depth that the frame measured there."""

from __future__ import annotations

import cv2
import numpy as np

from hodge_pipeline.registration.pixels import back_project, sound_depth
from hodge_pipeline.types import Bytes, Floats, Frame, Landmarks

WIDE_PX, SHRUNK = 640, 0.7
"""An image at least so wide is shrunk first: SIFT begins with it doubled, and finds the finest features where a pixel's
noise is largest. Less than half the time, and smaller errors in four of six videos (fr1/xyz and one of the rendered
ones have 4 and 11 % more); at 0.5 too few features are left of a bare room, whose error doubles.
"""
FEW = 150
"""Landmarks of a frame below which its image is looked at again for faint ones."""
CONTRAST, FAINT_CONTRAST = 0.04, 0.005
"""SIFT contrast thresholds; the first is OpenCV's own. Faint features match less exactly (TUM fr1/rpy: a tenth more
error), but without them an image of a bare cabinet has next to none."""


def find_landmarks(frame: Frame, count: int, min_range_m: float, max_range_m: float) -> Landmarks:
    """At most `count` landmarks, the strongest first; none for a frame without image, depth image or camera.

    A colour image of another size than the depth image is taken to show the same view.
    """
    if frame.read_colour is None or frame.read_depth is None or frame.camera is None:
        return Landmarks.none()
    grey: Bytes = np.asarray(cv2.cvtColor(frame.read_colour(), cv2.COLOR_RGB2GRAY), np.uint8)
    depth = frame.read_depth()
    pixel_rad = depth.shape[1] / (grey.shape[1] * frame.camera.fx)  # of the colour image, which may be the larger one
    marks = Landmarks.none()
    for contrast in (CONTRAST, FAINT_CONTRAST):
        pixels, descriptors = _features(grey, depth.shape, count, contrast)
        if not len(pixels):
            continue
        z, sound = sound_depth(depth, np.round(pixels).astype(np.int64), min_range_m, max_range_m)
        seen = np.column_stack([pixels[sound].astype(np.float32), z[sound]]).astype(float)
        points = back_project(seen, frame.camera).astype(np.float32)
        marks = Landmarks(points, descriptors[sound], np.full(len(points), pixel_rad, np.float32))
        if len(marks) >= min(FEW, count):
            break
    return marks


def _features(grey: Bytes, depth_shape: tuple[int, ...], count: int, contrast: float) -> tuple[Floats, Bytes]:
    """At most `count` features, the strongest first: pixels (n, 2) of the depth image, and descriptors (n, 128)."""
    if grey.shape[1] >= WIDE_PX:
        grey = np.asarray(cv2.resize(grey, None, fx=SHRUNK, fy=SHRUNK, interpolation=cv2.INTER_AREA), np.uint8)
    detector = cv2.SIFT_create(nfeatures=count, contrastThreshold=contrast)  # type: ignore[attr-defined]
    found, descriptors = detector.detectAndCompute(grey, None)
    if not found:
        return np.zeros((0, 2)), np.zeros((0, 128), np.uint8)
    larger = np.array([depth_shape[1] / grey.shape[1], depth_shape[0] / grey.shape[0]])
    strongest = np.argsort([-point.response for point in found], kind="stable")[:count]
    pixels = (np.array([found[row].pt for row in strongest]) + 0.5) * larger - 0.5
    return pixels, np.asarray(descriptors)[strongest].astype(np.uint8)

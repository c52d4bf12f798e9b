"""Optical flow: the corners of a key frame followed into other frames, and the motion that they show.

Every frame is followed from its key frame, not from the frame before it: no error adds up, and a blurred frame costs
the next one nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pixels import back_project, project, sound_depth
from hodge_pipeline.registration.tracking.resection import Resection, resect
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32, Frame

CORNERS = 300
"""Of a key frame, at most: more cost time and add nothing (TUM fr1)."""
CORNER_QUALITY, CORNERS_APART = 0.01, 1 / 80
"""The second: share of the image's width, 8 pixels of 640, so that a small image has as many."""
WINDOW_PX, LEVELS = 15, 3
"""Of the flow: with a predicted motion it finds a corner within about 60 pixels of where it should be."""
BLUR_PX = 5
"""Side of the square over which grey values are averaged before they are compared."""
BACKWARD_PX = 0.7
"""A corner that is followed back must end this near to where it began."""


@dataclass(frozen=True, eq=False)
class FlowImage:
    """One frame for optical flow: grey and depth image (H, W), the camera, the valid range of depth, and how many units
    of depth a metre has.
    """

    grey: Bytes
    depth: Floats32
    camera: Camera
    range_m: tuple[float, float]
    unit_m: float = 1.0

    @cached_property
    def smooth(self) -> Bytes:
        """The grey image (H, W), each pixel the mean of those around it."""
        return np.asarray(cv2.blur(self.grey, (BLUR_PX, BLUR_PX)), np.uint8)


@dataclass(frozen=True)
class Corners:
    """Corners of a key frame: `pixels (n, 2)` and `points (n, 3)` in its camera's axes."""

    image: FlowImage
    pixels: Floats32
    points: Floats

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class Followed:
    """The motion of a frame by its key frame's corners: `rows (m,)` are the inliers among the corners, `seen (m, 3)`
    where the frame saw them, columns u, v, z (NaN: no depth there), `share` that of inliers among the corners followed.
    """

    rows: Any
    seen: Floats
    key_from_view: Floats
    information: Floats
    share: float
    rmse_m: float


def flow_image(frame: Frame, range_m: tuple[float, float], unit_m: float = 1.0) -> FlowImage | None:
    """The frame's image; None where it has no colour, depth or camera.

    Raises `SourceError` or `OSError` where its files cannot be read.
    """
    if frame.read_colour is None or frame.read_depth is None or frame.camera is None:
        return None
    colour, depth = frame.read_colour(), frame.read_depth()
    grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    if grey.shape != depth.shape:
        grey = cv2.resize(grey, depth.shape[::-1], interpolation=cv2.INTER_AREA)
    return FlowImage(np.asarray(grey, np.uint8), depth, frame.camera, range_m, unit_m)


def find_corners(image: FlowImage, where: Bytes | None = None) -> Corners:
    """The strongest corners of an image, or of `where (H, W)` it is not 0, that have a depth."""
    apart_px = CORNERS_APART * image.grey.shape[1]
    found = cv2.goodFeaturesToTrack(image.grey, 2 * CORNERS, CORNER_QUALITY, apart_px, mask=where)
    pixels = np.zeros((0, 2), np.float32) if found is None else np.asarray(found, np.float32).reshape(-1, 2)
    seen = _seen(image, pixels)
    kept = np.flatnonzero(np.isfinite(seen[:, 2]))[:CORNERS]
    return Corners(image, pixels[kept], back_project(seen[kept], image.camera))


def follow(corners: Corners, view: FlowImage, guess: Floats) -> Followed | None:
    """The motion of another frame by the key frame's corners, from a guess (4, 4); None with too few inliers."""
    expected = project(se3.transform(se3.inverse(guess), corners.points), view.camera)[:, :2]
    height, width = view.depth.shape
    inside = np.flatnonzero(((expected >= 0) & (expected < [width, height])).all(axis=1))
    if not len(inside):
        return None
    begun, start = corners.pixels[inside], expected[inside].astype(np.float32)
    ends, there = _flow(corners.image, view, begun, start)
    back, here = _flow(view, corners.image, ends, begun + (ends - start))
    kept = (there & here & (np.abs(back - begun) < BACKWARD_PX).all(axis=1)).nonzero()[0]
    rows, seen = inside[kept], _seen(view, ends[kept])
    found = resect(corners.points[rows], seen, view.camera, guess, view.unit_m)
    return None if found is None else _followed(corners, rows, seen, view.camera, found)


def _followed(corners: Corners, rows: Any, seen: Floats, camera: Camera, found: Resection) -> Followed:
    kept = rows[found.inliers]
    ends = se3.transform(found.known_from_cam, back_project(seen[found.inliers], camera))
    apart = np.linalg.norm(corners.points[kept] - ends, axis=1)
    apart = apart[np.isfinite(apart)]
    rmse_m = float(np.sqrt(np.mean(apart**2))) if len(apart) else float("nan")
    share = len(kept) / len(rows)
    return Followed(kept, seen[found.inliers], found.known_from_cam, found.information, share, rmse_m)


def _flow(one: FlowImage, other: FlowImage, pixels: Floats32, start: Floats32) -> tuple[Floats32, Any]:
    ends, status, _ = cv2.calcOpticalFlowPyrLK(
        one.grey, other.grey, pixels[:, None], start[:, None].copy(), winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(ends, np.float32).reshape(-1, 2), np.asarray(status).reshape(-1) == 1


def _seen(image: FlowImage, pixels: Floats32) -> Floats:
    """Columns u, v, z (n, 3); z is NaN where the depth image has none that is sound."""
    z, sound = sound_depth(image.depth, np.round(pixels).astype(np.int64), *image.range_m)
    return np.column_stack([pixels, np.where(sound, z, np.nan)]).astype(float)

"""Unregistered colour of a Kinect: detected by edges, and reprojected onto the pixels of the depth image."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from hodge_adapters.images import pixels
from hodge_adapters.images.second_camera import SecondCamera, on_depth_pixels
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32, Ints
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.image_edges import FEWEST_EDGES, change_along_rows, depth_edges

COLOUR_FOCAL, BASELINE_M = 525.0, 0.025
"""Focal length in pixels and baseline of a Kinect's colour camera as built: parallel to the depth camera."""
SIZE = 640, 480
FRAMES, FEWEST_FRAMES = 8, 3
"""Frames tested, evenly spread; frames that are needed."""
LEAST_CHANGE = 1.0
"""Grey levels added for noise, so that an image of one even shade has no say."""
SURE = 2.5
"""Standard errors of the mean over the frames that show unregistered colour. Red kitchen and stairs have 7 to 10;
fr1/xyz, fr1/rpy, fr3/cabinet and ICL-NUIM, whose colour is registered, 0 to −13.
"""
MOST_LATE, FEWEST_LATE = 6, 5
"""Frames before and after whose colour is tried; frames that are needed for that."""
NEAR_LATE, EVERY_LATE = (-1, 0, 1), tuple(range(-MOST_LATE, MOST_LATE + 1))
"""Moments tried at first, and where that of depth is not surely the best of them."""
LEAST_GAIN = float(np.log(1.25))
"""Agreement at the best moment over that at any other, as of all colour of another moment. Red kitchen has 1.35 to 1.9,
at 6 to 8 standard errors.
"""


@dataclass(frozen=True)
class DepthFile:
    """A depth image, the depth camera, stored units per metre, and the values that mean no depth."""

    path: Path
    camera: Camera
    units_per_metre: float
    no_depth: tuple[int, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.camera.width, self.camera.height

    def read(self) -> Floats32:
        """The image (H, W), metres."""
        return pixels.read_depth(
            self.path, units_per_metre=self.units_per_metre, no_depth=self.no_depth, size=self.size
        )


def is_unregistered(colour: Sequence[Path], depth: Sequence[DepthFile]) -> bool:
    """Whether colour edges surely fit depth edges better as seen by a Kinect's colour camera than without parallax.

    Images that cannot be read are left out; False where too few are left.
    """
    if len(depth) < FEWEST_FRAMES or depth[0].size != SIZE:
        return False
    found = _sampled(lambda _: colour, depth, evenly(len(depth), FRAMES).tolist(), (0,))
    gains = found[:, 0, 0] - found[:, 0, 1]
    return len(gains) >= FEWEST_FRAMES and bool(gains.mean() > SURE * gains.std() / np.sqrt(len(gains)))


def frames_late(colour: Callable[[int], Sequence[Path | None]], depth: Sequence[DepthFile]) -> int:
    """How many frames later the colour of an unregistered camera is to be taken, negative: earlier; 0 where no other
    moment is surely better than every other, or the best one is an end of those tried. `colour` gives the images of so
    many frames later.
    """
    if len(depth) < FEWEST_LATE or depth[0].size != SIZE:
        return 0
    whole = np.flatnonzero([None not in images for images in zip(*map(colour, EVERY_LATE), strict=True)])
    rows = whole[evenly(len(whole), FRAMES)].tolist()
    if _is_best(_sampled(colour, depth, rows, NEAR_LATE)) == (NEAR_LATE.index(0), 0):
        return 0
    best = _is_best(_sampled(colour, depth, rows, EVERY_LATE))
    return EVERY_LATE[best[0]] if best is not None and best[1] == 0 and 0 < best[0] < len(EVERY_LATE) - 1 else 0


def _is_best(found: Floats) -> tuple[int, int] | None:
    """The moment and camera whose agreements (F, M, 2) surely exceed those at every other; None without one."""
    if len(found) < FEWEST_LATE:
        return None
    moment, camera = np.unravel_index(int(found.mean(axis=0).argmax()), found.shape[1:])
    others = found.reshape(len(found), -1).copy()
    own = found[:, moment, camera]
    others[:, np.ravel_multi_index((moment, camera), found.shape[1:])] = -np.inf
    gains = own - others.max(axis=1)
    is_sure = gains.mean() > max(SURE * gains.std() / np.sqrt(len(gains)), LEAST_GAIN)
    return (int(moment), int(camera)) if is_sure else None


def _sampled(
    colour: Callable[[int], Sequence[Path | None]], depth: Sequence[DepthFile], rows: Sequence[int], late: Sequence[int]
) -> Floats:
    """The agreement (F, M, 2) of depth of these rows with colour of so many frames later, see `_agreement`; without
    rows that lack an image, or one that can be read, or have too few edges.
    """
    out, each_moment = [], [colour(step) for step in late]
    for row in rows:
        own, paths = depth[row], [path for images in each_moment if (path := images[row]) is not None]
        try:
            edges = depth_edges(own.read()) if len(paths) == len(late) else None
            images = (pixels.read_colour(path, size=own.size) for path in paths)
            each = [] if edges is None else [_agreement(edges, image, own.camera) for image in images]
        except (SourceError, OSError):
            continue
        if each and np.isfinite(each).all():
            out.append(each)
    return np.array(out, float).reshape(-1, len(late), 2)


def _agreement(edges: tuple[Ints, Ints, Floats32], colour: Bytes, camera: Camera) -> tuple[float, float]:
    """Logarithms of the mean gradient of colour at depth edges as a Kinect's colour camera sees them, and at their own
    pixels, over that of the whole image; NaN with too few edges.
    """
    change, (v, u, nearer_m) = change_along_rows(colour), edges
    far = _at_infinity(np.asarray(u + 0.5, float), v.astype(float), camera)
    columns = np.round(far[0] - COLOUR_FOCAL * BASELINE_M / nearer_m).astype(np.int64)
    rows = np.round(far[1]).astype(np.int64)
    inside = (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    if inside.sum() < FEWEST_EDGES:
        return float("nan"), float("nan")
    usual = change.mean() + LEAST_CHANGE
    beside, here = change[rows[inside], columns[inside]].mean(), change[v[inside], u[inside]].mean()
    return float(np.log((beside + LEAST_CHANGE) / usual)), float(np.log((here + LEAST_CHANGE) / usual))


def _at_infinity(u: Floats, v: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """Columns and rows in the colour camera of pixels of the depth camera at infinite depth, without parallax."""
    wider_u, wider_v = COLOUR_FOCAL / camera.fx, COLOUR_FOCAL / camera.fy
    return wider_u * (u - camera.cx) + camera.cx, wider_v * (v - camera.cy) + camera.cy


def kinect_colour_camera(camera: Camera) -> SecondCamera:
    """A Kinect's colour camera, beside this depth camera."""
    colour = replace(camera, fx=COLOUR_FOCAL, fy=COLOUR_FOCAL)
    return SecondCamera(colour, (1.0, 0.0, 0.0, -BASELINE_M, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0))


def read_registered_colour(path: Path, depth: DepthFile) -> Bytes:
    """Colour (H, W, 3) of a Kinect on the pixels of its depth image, black outside the colour camera's view."""
    image = pixels.read_colour(path, size=depth.size)
    depth_m = _read_last(depth, _changed(depth.path))
    return on_depth_pixels(image, depth_m, depth.camera, kinect_colour_camera(depth.camera))


def read_depth(depth: DepthFile) -> Floats32:
    """The depth image (H, W), not decoded again where the frame's colour was read just now."""
    return _read_last(depth, _changed(depth.path)).copy()


@lru_cache(maxsize=1)
def _read_last(depth: DepthFile, changed: int) -> Floats32:
    return depth.read()


def _changed(path: Path) -> int:
    """When the file was last written, nanoseconds; 0 where that cannot be told: reading it says why."""
    try:
        return os.stat(path).st_mtime_ns
    except (OSError, ValueError):
        return 0

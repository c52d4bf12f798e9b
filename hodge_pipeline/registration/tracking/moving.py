"""Moving objects: the camera's motion is the one that most of the image follows, not that of most corners.

Corners lie where there is texture, often on a person or a box that moves. A motion predicts the depth and the grey
value of every pixel; where it fails over much of the image, other corners are followed, and tiles of the image vote.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pixels import DEPTH_SIGMAS, PIXEL_SIGMA, back_project, depth_sigma, project
from hodge_pipeline.registration.tracking.flow import Corners, FlowImage, Followed, find_corners, follow
from hodge_pipeline.registration.tracking.resection import GATE_PX
from hodge_pipeline.types import Bytes, Floats, Floats32, Ints

CELLS = 80
"""Across the image: pixels at which a motion is tested, one in 8 of 640; they cost a millisecond."""
TILES = 10
"""Across the image and down it: each votes once, however much texture it has."""
MUCH = 0.1
"""Share of the tested pixels that contradict a motion, below which no other is sought: 0.05 would name 3 blurred frames
of the 60 of fr1/rpy, where nothing moves.
"""
MOST = 0.5
"""Share of the tested pixels from which an object is suspected, even where a delay would explain it as well."""
GREY_LEVELS = 20.0
"""Grey values, of 256, of the mean of a few pixels: more than noise and interpolation change in a static scene."""
OFF_M, OFF_SIGMAS = 0.05, 3.0
"""By which a depth is off what a motion predicts: what clouds are matched within, and beyond the noise of a pixel."""
EXTRA_DELAYS_S = (-1 / 60, 1 / 60)
"""Seconds by which colour may be later than depth beyond what the stamps say, half the time between two images: of
fr1/rpy it is 15 ms, in which its camera turns by 15 pixels.
"""


class Moments(NamedTuple):
    """The velocities of key frame and view, twists (6,) per second in the camera's axes, and by how many seconds the
    colour image of each is later than its depth image by their stamps.
    """

    key_twist: Floats
    view_twist: Floats
    key_delay_s: float = 0.0
    view_delay_s: float = 0.0

    def between_depths(self, key_from_view: Floats, extra_s: float = 0.0) -> Floats:
        """The motion (4, 4) between the depth images, from that between the colour images; `extra_s` adds to delays."""
        key = se3.exp(self.key_twist * (self.key_delay_s + extra_s))
        return np.asarray(key @ key_from_view @ se3.exp(-self.view_twist * (self.view_delay_s + extra_s)))


AT_REST = Moments(np.zeros(6), np.zeros(6))


@dataclass(frozen=True)
class Rival:
    """Another motion that much of the image follows, and the key frame's corners that do.

    `fits_better`: in more tiles than the first motion does; `moving (H, W)`: not 0 where the key frame's image follows
    the motion that fits fewer tiles; `contradicting`: the share of the tested pixels that contradict the other motion.
    """

    corners: Corners
    followed: Followed
    fits_better: bool
    moving: Bytes
    contradicting: float


def contradicting(key: FlowImage, view: FlowImage, key_from_view: Floats, moments: Moments = AT_REST) -> float:
    """The share of the tested pixels whose depth or grey value contradicts a motion."""
    return _compared(key, view, key_from_view, moments)[0]


def misplaced(key: FlowImage, view: FlowImage, key_from_view: Floats, moments: Moments = AT_REST) -> float:
    """The share of the tested pixels whose depth in the view differs from what a motion predicts by more than `OFF_M`
    and `OFF_SIGMAS`: small for a rigid scene, most of a bare room where the motion is an object's. Between `MUCH` and
    `MOST` it is the least share over the possible delays of colour, as in `_compared`.
    """
    share = _off(key, view, key_from_view)
    if not MUCH < share < MOST:
        return share
    motions = [moments.between_depths(key_from_view, extra_s) for extra_s in (0.0, *EXTRA_DELAYS_S)]
    return min(share, *(_off(key, view, motion) for motion in motions))


def _off(key: FlowImage, view: FlowImage, key_from_view: Floats) -> float:
    """The share of misplaced pixels, by the motion between the depth images."""
    expected = _expected(key, view, key_from_view)
    off = np.abs(_depth(view, expected[:, :2]) - expected[:, 2]) / view.unit_m
    seen = np.isfinite(off)
    sigma = depth_sigma(expected[seen, 2] / view.unit_m)
    return float((off[seen] > np.maximum(OFF_M, OFF_SIGMAS * sigma)).mean()) if seen.any() else 0.0


def rival_motion(
    corners: Corners, view: FlowImage, found: Followed, guess: Floats, moments: Moments = AT_REST
) -> tuple[float, Rival | None]:
    """The share of the image that contradicts the motion found, and the motion of corners in tiles without its inliers;
    None where no more than `MUCH` contradicts it, or those corners show no other motion.
    """
    key = corners.image
    share, misfit = _compared(key, view, found.key_from_view, moments)
    if share <= MUCH:
        return share, None
    own = _tiles_with(key, corners.pixels[found.rows])
    others = find_corners(key, 1 - own)
    other = follow(others, view, guess)
    if other is None:
        return share, None
    others_share, others_misfit = _compared(key, view, other.key_from_view, moments)
    won, lost = _votes(key, misfit - others_misfit)
    if won == lost == 0:  # the same motion
        return share, None
    fits_better = won > lost
    moving = own if fits_better else _tiles_with(key, others.pixels[other.rows])
    return share, Rival(others, other, fits_better, moving, others_share)


def _compared(key: FlowImage, view: FlowImage, key_from_view: Floats, moments: Moments) -> tuple[float, Floats]:
    """The share that contradicts a motion, and the misfit (n,) at each tested pixel.

    Where a camera turns and colour is later than depth, depth moves otherwise than colour: where more than `MUCH`
    contradicts, each of `EXTRA_DELAYS_S` is tried too and the least share counts.
    """
    stamped = _at_delay(key, view, key_from_view, moments.between_depths(key_from_view))
    if stamped[0] <= MUCH:
        return stamped
    others = (moments.between_depths(key_from_view, extra_s) for extra_s in EXTRA_DELAYS_S)
    return min([stamped, *(_at_delay(key, view, key_from_view, motion) for motion in others)], key=lambda one: one[0])


def _at_delay(key: FlowImage, view: FlowImage, by_colour: Floats, by_depth: Floats) -> tuple[float, Floats]:
    """Share and misfit (n,) as of `_compared`, by the motions of the colour and of the depth images."""
    expected = _expected(key, view, by_depth)
    change = _grey(view, _expected(key, view, by_colour)[:, :2]) - _tested(key).grey
    misfit = _misfit(view, expected, _depth(view, expected[:, :2]), change)
    compared = misfit[np.isfinite(misfit)]
    return float((compared >= 1).mean()) if len(compared) else 0.0, misfit


def _expected(key: FlowImage, view: FlowImage, key_from_view: Floats) -> Floats:
    """Columns u, v, z (n, 3) at which a motion puts the tested pixels."""
    return project(se3.transform(se3.inverse(key_from_view), _tested(key).points), view.camera)


def _votes(key: FlowImage, gain: Floats) -> tuple[int, int]:
    """How many tiles another motion fits better and how many worse, by its gain (n,) in misfit at each tested pixel."""
    compared = np.isfinite(gain)
    votes = np.bincount(_tested(key).tile[compared], gain[compared], minlength=TILES**2)
    return int((votes > 1).sum()), int((votes < -1).sum())


class _Tested(NamedTuple):
    """The tested pixels (n,) of a key frame, those of a regular grid that have a depth: their points (n, 3) in its
    axes, grey values, and tiles.
    """

    points: Floats
    grey: Floats
    tile: Ints


@lru_cache(maxsize=2)
def _tested(key: FlowImage) -> _Tested:
    height, width = key.depth.shape
    step = max(1, width // CELLS)
    v, u = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    z = _depth(key, pixels)
    pixels, z = pixels[np.isfinite(z)], z[np.isfinite(z)]
    return _Tested(back_project(np.column_stack([pixels, z]), key.camera), _grey(key, pixels), _tile(key, pixels))


def _misfit(view: FlowImage, expected: Floats, actual: Floats, change: Floats) -> Floats:
    """Misfit (n,) in [0, 1] of `actual` depths (n,) against `expected` u, v, z (n, 3), and of the change (n,) of grey
    values less its median (the exposure); NaN where not both frames have a depth.
    """
    sigma = DEPTH_SIGMAS * view.unit_m * depth_sigma(expected[:, 2] / view.unit_m)
    off = (actual - expected[:, 2]) / (GATE_PX / PIXEL_SIGMA * sigma)
    seen = np.isfinite(actual) & np.isfinite(change)
    exposure = float(np.median(change[seen])) if seen.any() else 0.0
    return np.asarray(np.minimum(1, off**2 + ((change - exposure) / GREY_LEVELS) ** 2))


def _tile(image: FlowImage, pixels: Floats) -> Ints:
    height, width = image.depth.shape
    column, row = np.clip(pixels * TILES / [width, height], 0, TILES - 1).astype(np.int64).T
    return np.asarray(row * TILES + column)


def _tiles_with(image: FlowImage, pixels: Floats) -> Bytes:
    """1 in the tiles of an image (H, W) that hold one of these pixels."""
    height, width = image.depth.shape
    tiles = np.zeros(TILES**2, np.uint8)
    tiles[_tile(image, pixels)] = 1
    rows, columns = np.arange(height) * TILES // height, np.arange(width) * TILES // width
    return np.ascontiguousarray(tiles.reshape(TILES, TILES)[rows[:, None], columns])


def _at(values: Floats32 | Bytes, pixels: Floats) -> Floats:
    """The values (n,) of an image at pixels (n, 2); NaN outside it."""
    height, width = values.shape
    u, v = np.round(pixels).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)  # false for NaN
    out = np.full(len(pixels), np.nan)
    out[inside] = values[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    return out


def _depth(image: FlowImage, pixels: Floats) -> Floats:
    """The depths (n,) at pixels (n, 2); NaN where there is none in range."""
    z = _at(image.depth, pixels)
    return np.where((z >= image.range_m[0]) & (z <= image.range_m[1]), z, np.nan)


def _grey(image: FlowImage, pixels: Floats) -> Floats:
    return _at(image.smooth, pixels)

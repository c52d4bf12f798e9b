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
from hodge_pipeline.registration.flow import Corners, FlowImage, Followed, find_corners, follow
from hodge_pipeline.registration.resection import DEPTH_SIGMAS, GATE_PX, PIXEL_SIGMA, back_project, project
from hodge_pipeline.registration.visual import depth_sigma
from hodge_pipeline.types import Bytes, Floats, Floats32, Ints

CELLS = 80
"""Across the image: pixels at which a motion is tested, one in 8 of 640; they cost a millisecond."""
TILES = 10
"""Across the image and down it: each votes once, however much texture it has."""
MUCH = 0.1
"""Share of the tested pixels that contradict a motion, below which no other is sought: 0.05 would name 3 blurred frames
of the 60 of fr1/rpy, where nothing moves.
"""
GREY_LEVELS = 20.0
"""Grey values, of 256, of the mean of a few pixels: more than noise and interpolation change in a static scene."""
OFF_M, OFF_SIGMAS = 0.05, 3.0
"""By which a depth is off what a motion predicts: what clouds are matched within, and beyond the noise of a pixel."""
UNTOLD_S = (-1 / 60, 1 / 60)
"""Seconds by which a colour image may be later than its depth image beyond what is said: half the time between two
images, within which they are paired. fr1/rpy's stamps keep silent about 15 ms, in which its camera turns by 15 pixels.
"""


class Moments(NamedTuple):
    """How the cameras of key frame and view moved, twists (6,) a second in their own axes, and the seconds by which the
    colour image of each is said to be later than its depth image.
    """

    key_twist: Floats
    view_twist: Floats
    key_delay_s: float = 0.0
    view_delay_s: float = 0.0

    def between_depths(self, key_from_view: Floats, untold_s: float) -> Floats:
        """The motion (4, 4) between the depth images, from that between the colour images."""
        key = se3.exp(self.key_twist * (self.key_delay_s + untold_s))
        return np.asarray(key @ key_from_view @ se3.exp(-self.view_twist * (self.view_delay_s + untold_s)))


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


class Agreement(NamedTuple):
    """Shares of the tested pixels: `contradicting`, whose depth or grey value contradicts a motion; `misplaced`, whose
    depth in the view is off what the motion predicts, by `OFF_M` and `OFF_SIGMAS`: few where both see one rigid scene,
    most of a bare room where the motion is an object's.
    """

    contradicting: float
    misplaced: float


def agreement(key: FlowImage, view: FlowImage, key_from_view: Floats, moments: Moments = AT_REST) -> Agreement:
    """How much of the view contradicts a motion."""
    return _compared(key, view, key_from_view, moments)[0]


def rival_motion(
    corners: Corners, view: FlowImage, found: Followed, guess: Floats, moments: Moments = AT_REST
) -> tuple[Agreement, Rival | None]:
    """How much contradicts the motion found, and the motion of corners where that has none; None where little
    contradicts it, or no other motion agrees.
    """
    key = corners.image
    share, misfit = _compared(key, view, found.key_from_view, moments)
    if share.contradicting <= MUCH:
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
    return share, Rival(others, other, fits_better, moving, others_share.contradicting)


def _compared(key: FlowImage, view: FlowImage, key_from_view: Floats, moments: Moments) -> tuple[Agreement, Floats]:
    """How much of the view contradicts a motion, and the misfit (n,) at each tested pixel.

    Where a camera turns, depth lies elsewhere than the colour image's motion says if the two images are not of one
    moment: where much contradicts, the delay of `UNTOLD_S` with which the least does counts.
    """
    told = _at_delay(key, view, key_from_view, moments.between_depths(key_from_view, 0))
    if told[0].contradicting <= MUCH:
        return told
    others = (moments.between_depths(key_from_view, untold_s) for untold_s in UNTOLD_S)
    tried = [told, *(_at_delay(key, view, key_from_view, motion) for motion in others)]
    least, misfit = min(tried, key=lambda one: one[0].contradicting)
    return least._replace(misplaced=told[0].misplaced), misfit


def _at_delay(key: FlowImage, view: FlowImage, by_colour: Floats, by_depth: Floats) -> tuple[Agreement, Floats]:
    """What `_compared` tells, by the motion of the colour images and that of the depth images."""
    points = _points(key)
    expected = project(se3.transform(se3.inverse(by_depth), points), view.camera)
    actual = _depth(view, expected[:, :2])
    grey_at = project(se3.transform(se3.inverse(by_colour), points), view.camera)[:, :2]
    misfit = _misfit(key, view, expected, actual, grey_at)
    return Agreement(_contradicting(misfit), _misplaced(view, expected, actual)), misfit


def _misplaced(view: FlowImage, expected: Floats, actual: Floats) -> float:
    off = np.abs(actual - expected[:, 2])
    off = off[np.isfinite(off)] / view.unit_m
    sigma = depth_sigma(expected[np.isfinite(actual), 2] / view.unit_m)
    return float((off > np.maximum(OFF_M, OFF_SIGMAS * sigma)).mean()) if len(off) else 0.0


def _votes(key: FlowImage, gain: Floats) -> tuple[int, int]:
    """The tiles that another motion fits better by so much (n,) at each pixel, and those that it fits worse."""
    compared = np.isfinite(gain)
    votes = np.bincount(_tile(key, tested_pixels(key.depth.shape))[compared], gain[compared], minlength=TILES**2)
    return int((votes > 1).sum()), int((votes < -1).sum())


def _contradicting(misfit: Floats) -> float:
    compared = misfit[np.isfinite(misfit)]
    return float((compared >= 1).mean()) if len(compared) else 0.0


@lru_cache(maxsize=4)
def tested_pixels(shape: tuple[int, ...]) -> Floats:
    """Pixels (n, 2) of a regular grid over an image (H, W)."""
    height, width = shape
    step = max(1, width // CELLS)
    v, u = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(float)


def _misfit(key: FlowImage, view: FlowImage, expected: Floats, actual: Floats, grey_at: Floats) -> Floats:
    """Of the tested pixels (n,) of the key frame: how far the depth (n,) in the view is off columns u, v, z (n, 3), and
    the grey value at `grey_at (n, 2)` off the key frame's, 1: by as much as may be or more; NaN where not both frames
    have a depth.
    """
    pixels = tested_pixels(key.depth.shape)
    sigma = DEPTH_SIGMAS * view.unit_m * depth_sigma(expected[:, 2] / view.unit_m)
    off = (actual - expected[:, 2]) / (GATE_PX / PIXEL_SIGMA * sigma)
    change = _grey(view, grey_at) - _grey(key, pixels)
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
    rounded = np.round(np.where(np.isfinite(pixels), pixels, -1)).astype(np.int64)
    inside = np.asarray(((rounded >= 0) & (rounded < [width, height])).all(axis=1))
    u, v = np.where(inside[:, None], rounded, 0).T
    return np.where(inside, values[v, u].astype(np.float32), np.nan)


def _points(image: FlowImage) -> Floats:
    """The tested points (n, 3) in the camera's axes; NaN where there is no depth."""
    pixels = tested_pixels(image.depth.shape)
    return back_project(np.column_stack([pixels, _depth(image, pixels)]), image.camera)


def _depth(image: FlowImage, pixels: Floats) -> Floats:
    """The depths (n,) at pixels (n, 2); NaN where there is none in range."""
    z = _at(image.depth, pixels)
    return np.where((z >= image.range_m[0]) & (z <= image.range_m[1]), z, np.nan)


def _grey(image: FlowImage, pixels: Floats) -> Floats:
    return _at(image.smooth, pixels)

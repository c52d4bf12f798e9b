"""Point clouds as pictures, by a z-buffer in numpy: a report needs neither a screen nor a viewer."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from PIL import Image

from hodge_pipeline import se3
from hodge_pipeline.recording.shapes import or_grey
from hodge_pipeline.types import Bytes, CloudSet, Floats, Floats32, Ints, PointCloud
from hodge_pipeline.types.axes import unit, up_and_ahead

WIDTH, HEIGHT = 560, 400
ELEVATION_RAD = np.deg2rad(38.0)
SIDES = {"front": 0.0, "right": 90.0, "back": 180.0, "left": 270.0}
"""Degrees round the scene from where the cameras are."""
MAX_POINTS = 1_200_000
JPEG_QUALITY = 82
PAPER, GAP = 255, 8
"""Grey level of the background; pixels between pictures side by side."""
AMBIENT = 0.55
FILL_PX = 2
FRAMING_POINTS = 20_000
"""A hundred of them lie beyond each side of a picture (`STRAY_PERCENT`)."""
STRAY_PERCENT = 0.5
"""Percentage of the points that may lie outside a picture at each side."""
MARGIN = 1.06
NEAR_M = 0.1
"""Distance of the near plane from the eye, in perspective."""


@dataclass(frozen=True)
class Points:
    """Points (P, 3) with unit normals (P, 3), zero where unknown, and 8-bit RGB (P, 3)."""

    points: Floats32
    normals: Floats32
    colours: Bytes

    @classmethod
    def of(cls, points: Floats32, normals: Floats32 | None = None, colours: Bytes | None = None) -> Points:
        """These points; without colours they are grey."""
        normals = np.zeros((len(points), 3), np.float32) if normals is None else normals
        return cls(points, normals, or_grey(colours, len(points)))

    @classmethod
    def joined(cls, parts: Sequence[Points]) -> Points:
        """All points of the parts."""
        empty = cls.of(np.zeros((0, 3), np.float32))
        return cls(*(np.concatenate([getattr(one, n) for one in (empty, *parts)]) for n in vars(empty)))

    def moved(self, motion: Floats) -> Points:
        """The points after a rigid motion (4, 4)."""
        turn = motion[:3, :3].T.astype(np.float32)
        return replace(
            self, points=self.points @ turn + motion[:3, 3].astype(np.float32), normals=self.normals @ turn
        )  # fmt: skip


@dataclass(frozen=True)
class View:
    """From where a picture is taken: axes (3, 3) right, down, ahead as rows; the centre, and metres per pixel there.

    `eye_m` is how far before the centre the eye is; infinite: an orthographic picture. What lies nearer than `near_m`
    before the centre is left out; `culled`: points that face away too, to look into a room. `fill_px` is how far a gap
    between points is closed; `surface_m` how deep the front surface is whose colours are averaged, None: one pixel.
    """

    axes: Floats
    centre: Floats
    metres_per_pixel: float
    size: tuple[int, int] = (WIDTH, HEIGHT)
    eye_m: float = np.inf
    near_m: float = np.inf
    culled: bool = True
    fill_px: int = FILL_PX
    surface_m: float | None = None


def merged(clouds: CloudSet, world_from_cam: Floats, rows: Ints) -> Points:
    """The clouds of these frames, laid together by their poses; evenly thinned to `MAX_POINTS`."""
    total = int(sum(len(clouds[int(row)]) for row in rows))
    step = max(1, -(-total // MAX_POINTS))
    parts = []
    for row in rows:
        cloud = clouds[int(row)]
        normals = None if cloud.normals_in_cam is None else cloud.normals_in_cam[::step]
        colours = None if cloud.colours is None else cloud.colours[::step]
        parts.append(Points.of(cloud.points_in_cam[::step], normals, colours).moved(world_from_cam[row]))
    return Points.joined(parts)


def two(first: PointCloud, second: PointCloud, i_from_j: Floats, tints: Sequence[Sequence[float]]) -> Points:
    """Cloud i and cloud j, moved by `i_from_j`, each in a colour of its own."""
    parts = [
        Points.of(
            np.asarray(cloud.points_in_cam, np.float32),
            cloud.normals_in_cam,
            np.tile(np.asarray(tint, np.uint8), (len(cloud), 1)),
        )
        for cloud, tint in zip((first, second), tints, strict=True)
    ]
    return Points.joined([parts[0], parts[1].moved(i_from_j)])


def around(scene: Points, world_from_cam: Floats, is_scanner: bool = False) -> dict[str, View]:
    """One view from each of four sides, above the scene; up is where the cameras, or scanners, have it, on average."""
    sample = scene.points[:: max(1, len(scene.points) // FRAMING_POINTS)].astype(float)
    known = world_from_cam[se3.has_pose(world_from_cam)]
    up, ahead = up_and_ahead(known, is_scanner)
    found = {}
    for name, degrees in SIDES.items():
        turn = se3.exp(np.concatenate([np.deg2rad(degrees) * up, np.zeros(3)]))[:3, :3]
        look = np.cos(ELEVATION_RAD) * (turn @ ahead) - np.sin(ELEVATION_RAD) * up
        right = unit(np.cross(look, up), np.array([1.0, 0.0, 0.0]))
        found[name] = holding(np.stack([right, np.cross(look, right), look]), sample)
    return found


def holding(
    axes: Floats, points: Floats, size: tuple[int, int] = (WIDTH, HEIGHT), stray_percent: float = STRAY_PERCENT
) -> View:
    """The view along these axes which all but a few stray points (N, 3) fill."""
    low, high = np.percentile(points @ axes.T, [stray_percent, 100 - stray_percent], axis=0)
    extent = high - low
    metres_per_pixel = max(extent[0] / size[0], extent[1] / size[1], 1e-4) * MARGIN
    return View(axes, (low + high) / 2 @ axes, float(metres_per_pixel), size)


def picture(scene: Points, view: View) -> Bytes:
    """The scene (H, W, 3), white where nothing is: a pixel has the mean colour of the points of its front surface."""
    width, height = view.size
    axes = view.axes.astype(np.float32)
    facing = scene.normals @ axes[2]
    rows = np.flatnonzero(facing <= 0.1) if view.culled else np.arange(len(facing))
    in_view = (scene.points.take(rows, axis=0) - view.centre.astype(np.float32)) @ axes.T
    near = in_view[:, 2] >= -min(view.near_m, view.eye_m - NEAR_M)
    if not near.all():
        rows, in_view = rows[near], in_view.take(np.flatnonzero(near), axis=0)  # a fifth of the time of a mask
    scale = 1.0 / view.metres_per_pixel
    across = in_view[:, :2] * scale
    if np.isfinite(view.eye_m):
        across *= (view.eye_m / (view.eye_m + in_view[:, 2]))[:, None]
    column, row = np.round(across + [width / 2, height / 2]).astype(np.int64).T
    inside = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
    pixel, depth = (row * width + column)[inside], in_view[inside, 2]
    front = np.full(width * height, np.inf, np.float32)
    np.minimum.at(front, pixel, depth)
    deep = view.metres_per_pixel if view.surface_m is None else view.surface_m
    surface = np.flatnonzero(depth <= front[pixel] + deep)
    rows, pixel = rows[inside[surface]], pixel[surface]
    shades = _shades(scene.colours.take(rows, axis=0), facing[rows])
    covered = np.flatnonzero(np.isfinite(front))
    count = np.bincount(pixel, minlength=width * height)[covered]
    sums = [np.bincount(pixel, shades[:, channel], minlength=width * height)[covered] for channel in range(3)]
    image = np.full((width * height, 3), PAPER, np.uint8)
    image[covered] = np.stack(sums, axis=1) / count[:, None]
    return _filled(image.reshape(height, width, 3), front.reshape(height, width), view.fill_px)


def _shades(colours: Bytes, facing: Floats32) -> Floats32:
    """Colours under a light at the eye; as they are where there is no normal."""
    light = np.where(facing == 0, 1 / 1.1, AMBIENT + (1 - AMBIENT) * np.abs(facing))
    return np.asarray(np.clip(1.1 * colours * light[:, None], 0, 250), np.float32)


def _filled(image: Bytes, depth: Floats32, passes: int) -> Bytes:
    """The picture with the gaps between points closed by their nearest neighbours."""
    height, width = depth.shape
    image = np.pad(image, ((1, 1), (1, 1), (0, 0)))  # beyond the border there is nothing
    depth = np.pad(depth, 1, constant_values=np.inf)
    flat, steps = image.reshape(-1, 3), np.array([-1, -width - 2, 1, width + 2])
    inside = np.s_[1 : height + 1, 1 : width + 1]
    for _ in range(passes):
        known = np.isfinite(depth)
        beside = cv2.dilate(known.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))[inside]
        row, column = np.nonzero((beside > 0) & ~known[inside])
        gaps = (row + 1) * (width + 2) + column + 1
        around = depth.ravel()[gaps[:, None] + steps]
        nearest = around.argmin(axis=1)
        flat[gaps] = flat[gaps + steps[nearest]]
        depth.ravel()[gaps] = around.min(axis=1)
    return image[inside]


def beside(images: Sequence[Bytes]) -> Bytes:
    """Pictures beside each other, white between them and below lower ones."""
    widths = [image.shape[1] for image in images]
    height = max(len(image) for image in images)
    canvas = np.full((height, sum(widths) + GAP * (len(images) - 1), 3), PAPER, np.uint8)
    for image, left in zip(images, np.cumsum([0, *(width + GAP for width in widths[:-1])]).tolist(), strict=True):
        canvas[: len(image), left : left + image.shape[1]] = image
    return canvas


def jpeg(image: Bytes) -> bytes:
    """The picture as a JPEG."""
    target = io.BytesIO()
    Image.fromarray(image).save(target, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return target.getvalue()

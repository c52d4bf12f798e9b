"""Point clouds as pictures: an orthographic z-buffer in numpy, so that a report needs neither a screen nor a viewer."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image

from hodge_pipeline import se3
from hodge_pipeline.types import Bytes, CloudSet, Floats, Floats32, Ints

WIDTH, HEIGHT = 560, 400
ELEVATION_RAD = np.deg2rad(38.0)
SIDES = {"front": 0.0, "right": 90.0, "back": 180.0, "left": 270.0}
"""Degrees round the scene from where the cameras are."""
MAX_POINTS = 1_200_000
JPEG_QUALITY = 82
PAPER = 255
AMBIENT = 0.55
FILL_PASSES = 2
FRAMING_POINTS = 20_000
MARGIN = 1.06


@dataclass(frozen=True)
class Scene:
    """Points (P, 3) of all frames in the world, with unit normals (P, 3) and 8-bit RGB (P, 3)."""

    points: Floats32
    normals: Floats32
    colours: Bytes


@dataclass(frozen=True)
class Stand:
    """Where a picture is taken from: axes (3, 3) right, down, ahead as rows; the centre; metres per pixel."""

    axes: Floats
    centre: Floats
    metres_per_pixel: float


def merged(clouds: CloudSet, world_from_cam: Floats, rows: Ints) -> Scene:
    """The clouds of these frames, laid together by their poses; evenly thinned to `MAX_POINTS`."""
    total = int(sum(len(clouds[int(row)]) for row in rows))
    step = max(1, -(-total // MAX_POINTS))
    points, normals, colours = [], [], []
    for row in rows:
        cloud, pose = clouds[int(row)], world_from_cam[row]
        turn = pose[:3, :3].T.astype(np.float32)
        points.append(cloud.points_in_cam[::step] @ turn + pose[:3, 3].astype(np.float32))
        normals.append(_or_zeros(cloud.normals_in_cam, len(cloud))[::step] @ turn)
        colours.append(_or_zeros(cloud.colours, len(cloud))[::step])
    empty = np.zeros((0, 3), np.float32)
    return Scene(
        np.concatenate([empty, *points]).astype(np.float32),
        np.concatenate([empty, *normals]).astype(np.float32),
        np.concatenate([empty, *colours]).astype(np.uint8),
    )


def _or_zeros(values: Floats32 | Bytes | None, count: int) -> Floats32 | Bytes:
    return np.zeros((count, 3), np.float32) if values is None else values


def stands(scene: Scene, world_from_cam: Floats) -> dict[str, Stand]:
    """One place to stand on each of four sides, above the scene; up is where the cameras have it, on average."""
    sample = scene.points[:: max(1, len(scene.points) // FRAMING_POINTS)].astype(float)
    known = world_from_cam[np.isfinite(world_from_cam).all(axis=(1, 2))]
    up = _unit(-known[:, :3, 1].mean(axis=0), np.array([0.0, -1.0, 0.0]))
    ahead = known[:, :3, 2].mean(axis=0)
    ahead = _unit(ahead - (ahead @ up) * up, _unit(np.cross(up, [1.0, 0.3, 0.2]), up))
    found = {}
    for name, degrees in SIDES.items():
        turn = se3.exp(np.concatenate([np.deg2rad(degrees) * up, np.zeros(3)]))[:3, :3]
        look = np.cos(ELEVATION_RAD) * (turn @ ahead) - np.sin(ELEVATION_RAD) * up
        right = _unit(np.cross(look, up), np.array([1.0, 0.0, 0.0]))
        found[name] = _framed(np.stack([right, np.cross(look, right), look]), sample)
    return found


def _framed(axes: Floats, points: Floats) -> Stand:
    """The stand from which all but a few stray points fill the picture."""
    low, high = np.percentile(points @ axes.T, [0.5, 99.5], axis=0)
    extent = high - low
    metres_per_pixel = max(extent[0] / WIDTH, extent[1] / HEIGHT, 1e-4) * MARGIN
    return Stand(axes, (low + high) / 2 @ axes, float(metres_per_pixel))


def _unit(vector: Floats, fallback: Floats) -> Floats:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-3 else fallback


def picture(scene: Scene, stand: Stand) -> Bytes:
    """The scene (HEIGHT, WIDTH, 3), white where nothing is; points that face away are left out, to look into a room."""
    axes = stand.axes.astype(np.float32)
    facing = scene.normals @ axes[2]
    seen = facing <= 0.1
    in_view = (scene.points[seen] - stand.centre.astype(np.float32)) @ axes.T
    column = np.round(in_view[:, 0] / stand.metres_per_pixel + WIDTH / 2).astype(np.int64)
    row = np.round(in_view[:, 1] / stand.metres_per_pixel + HEIGHT / 2).astype(np.int64)
    inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    far_first = np.argsort(-in_view[inside, 2], kind="stable")
    pixels = (row * WIDTH + column)[inside][far_first]
    shade = _shades(scene.colours[seen][inside][far_first], -facing[seen][inside][far_first])
    image = np.full((HEIGHT * WIDTH, 3), PAPER, np.uint8)
    depth = np.full(HEIGHT * WIDTH, np.inf, np.float32)
    image[pixels], depth[pixels] = (
        shade,
        in_view[inside, 2][far_first],
    )  # of repeated pixels the last, nearest one stays
    return _filled(image.reshape(HEIGHT, WIDTH, 3), depth.reshape(HEIGHT, WIDTH))


def _shades(colours: Bytes, facing: Floats32) -> Bytes:
    """Colours under a light at the eye; grey where the clouds have none."""
    base = colours.astype(np.float32) if colours.any() else np.full(colours.shape, 190, np.float32)
    light = AMBIENT + (1 - AMBIENT) * np.clip(facing, 0, 1)
    return np.asarray(np.clip(1.1 * base * light[:, None], 0, 250), np.uint8)


def _filled(image: Bytes, depth: Floats32) -> Bytes:
    """The picture with the gaps between points closed by their nearest neighbours."""
    for _ in range(FILL_PASSES):
        best, colour = depth.copy(), image.copy()
        for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            moved = np.roll(depth, (down, right), axis=(0, 1))
            nearer = np.isinf(depth) & (moved < best)
            best[nearer], colour[nearer] = moved[nearer], np.roll(image, (down, right), axis=(0, 1))[nearer]
        depth, image = best, colour
    return image


def jpeg(image: Bytes) -> bytes:
    """The picture as a JPEG."""
    target = io.BytesIO()
    Image.fromarray(image).save(target, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return target.getvalue()

"""Makes COLMAP models of kinds that real ones come in, for `benchmarks/colmap.py`.

    python benchmarks/synthetic_colmap.py turntable OUT --images 118 --seed 1
    python benchmarks/colmap.py OUT

Kinds: `rings` (three rings around a surface), `turntable` (one ring, long lens), `facade` (a plane seen from a row),
`room` (from inside), `street` (forward, a tenth of the points far away), `joined` (two rows that few images join).
Keypoints have 0.6 px of noise, 1 % are 8 px off; tracks end where the view turns by 25°. Bundle adjustment with the
camera held comes last, as in COLMAP, so that the model is at its own optimum. With `--hard` wrong keypoints move
that optimum by some 0.2 to 0.9 % of the extent: the true poses lie beside it, in `true/`, to be compared with.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from hodge_pipeline import se3

WIDTH, HEIGHT = 2000, 1500
GRAZING_DEG = 65.0
TRUE = "true"
"""Folder in that of a model that holds it at its true poses."""


class Keypoints(NamedTuple):
    """Noise and gross errors in pixels, the share of these, that of points found, and the turn that ends a track."""

    noise_px: float
    outlier_px: float
    outlier_share: float
    found_share: float
    view_change_deg: float


USUAL, HARD = Keypoints(0.6, 8.0, 0.01, 0.5, 25.0), Keypoints(1.0, 15.0, 0.05, 0.35, 18.0)
Array = np.ndarray
Scene = tuple[Array, Array, Array, float]
"""Points and normals (P, 3), poses `world_from_cam` (N, 4, 4), focal length in pixels."""


def looking(centres: Array, targets: Array) -> Array:
    """Poses (N, 4, 4) of cameras at the centres that look at the targets, z up in the world."""
    z = targets - centres
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return se3.from_parts(np.stack([x, np.cross(z, x), z], axis=2), centres)


def _ball(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bumps = 1.0 + 0.1 * np.sin(5 * normals[:, 0]) * np.cos(4 * normals[:, 1]) + 0.02 * rng.normal(size=count)
    return normals * bumps[:, None] * [1.0, 0.8, 0.7], normals


def _circle(count: int, radius: float, height: float) -> Array:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)


def rings(rng: np.random.Generator, images: int) -> Scene:
    """Three rings of cameras that look at one closed surface."""
    points, normals = _ball(rng, 40 * images)
    rows = np.array_split(np.arange(images), 3)
    centres = np.concatenate([_circle(len(row), 4.0, h) for row, h in zip(rows, (-1.2, 0.4, 2.0), strict=True)])
    centres += 0.05 * rng.normal(size=centres.shape)
    return points, normals, looking(centres, 0.1 * rng.normal(size=centres.shape)), 1800.0


def turntable(rng: np.random.Generator, images: int) -> Scene:
    """One ring around an object through a long lens."""
    points, normals = _ball(rng, 30 * images)
    return points, normals, looking(_circle(images, 12.0, 4.0), 0.02 * rng.normal(size=(images, 3))), 7000.0


def facade(rng: np.random.Generator, images: int) -> Scene:
    """A wall with little relief, seen from two rows."""
    length = 0.5 * images
    points = rng.uniform([0, 0, 0], [length, 0.1, 8], (40 * images, 3))
    centres = np.stack(
        [
            np.linspace(2, length - 2, images),
            np.full(images, -7.0) + 0.3 * rng.normal(size=images),
            2.0 + 3.0 * (np.arange(images) % 2),
        ],
        axis=1,
    )
    targets = centres * [1, 0, 1] + 0.5 * rng.normal(size=(images, 3))
    return points, np.tile([0.0, -1.0, 0.0], (len(points), 1)), looking(centres, targets), 1700.0


def room(rng: np.random.Generator, images: int) -> Scene:
    """A room of 6 x 5 x 3 m, walked along and looked at from inside."""
    size = np.array([6.0, 5.0, 3.0])
    points, normals = rng.uniform(0, size, (60 * images, 3)), np.zeros((60 * images, 3))
    side, axis = rng.integers(0, 2, len(points)), rng.integers(0, 3, len(points))
    rows = np.arange(len(points))
    points[rows, axis] = side * size[axis] + 0.03 * rng.normal(size=len(points))
    normals[rows, axis] = 1.0 - 2.0 * side
    turn = np.linspace(0, 4 * np.pi, images)
    centres = size / 2 + np.stack([1.2 * np.cos(turn), 0.9 * np.sin(turn), 0.3 * np.sin(3 * turn)], axis=1)
    ahead = np.stack([np.cos(1.5 * turn), np.sin(1.5 * turn), 0.2 * rng.normal(size=images)], axis=1)
    return points, normals, looking(centres, centres + ahead), 1300.0


def street(rng: np.random.Generator, images: int) -> Scene:
    """Driven along between two rows of houses; a tenth of the points is very far ahead."""
    length = 1.0 * images
    points = rng.uniform([0, 0, -1.5], [length + 40, 0, 8], (60 * images, 3))
    side = rng.choice([-1.0, 1.0], len(points))
    points[:, 1] = side * (6 + rng.uniform(0, 2, len(points)))
    normals = np.stack([-0.7 * np.ones(len(points)), -0.7 * side, np.zeros(len(points))], axis=1)
    far = rng.random(len(points)) < 0.1
    points[far] = rng.uniform([2000, -800, 0], [4000, 800, 400], (far.sum(), 3))
    normals[far] = [-1.0, 0.0, 0.0]
    along = np.linspace(0, length, images)
    centres = np.stack([along, 0.5 * np.sin(along / 15), 0.05 * rng.normal(size=images)], axis=1)
    return points, normals, looking(centres, centres + [10, 0, 0] + 0.5 * rng.normal(size=(images, 3))), 1200.0


def joined(rng: np.random.Generator, images: int) -> Scene:
    """Two rows of views of two walls that meet, with few images around the corner."""
    points, normals, poses, focal = facade(rng, images)
    middle = points[:, 0].max() / 2
    turn = se3.from_parts(se3.so3_exp(np.array([0.0, 0.0, -np.pi / 3])), np.zeros(3))
    shift = np.array([middle, 0.0, 0.0])
    for values in (points, poses[:, :3, 3]):
        behind = values[:, 0] > middle
        values[behind] = (values[behind] - shift) @ turn[:3, :3].T + shift
        if values is points:
            normals[behind] = normals[behind] @ turn[:3, :3].T
        else:
            poses[behind, :3, :3] = turn[:3, :3] @ poses[behind, :3, :3]
    return points, normals, poses, focal


KINDS: dict[str, Callable[[np.random.Generator, int], Scene]] = {
    scene.__name__: scene for scene in (rings, turntable, facade, room, street, joined)
}


def make(kind: str, images: int, seed: int, keypoints: Keypoints = USUAL) -> pycolmap.Reconstruction:
    """A model of this kind at the optimum of its own observations."""
    model = true_model(kind, images, seed, keypoints)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.print_summary = False
    options.ceres.solver_options.max_num_iterations = 200
    pycolmap.bundle_adjustment(model, options)
    return model


def true_model(kind: str, images: int, seed: int, keypoints: Keypoints = USUAL) -> pycolmap.Reconstruction:
    """The same model at its true poses and points."""
    rng = np.random.default_rng(seed)
    points, normals, poses, focal = KINDS[kind](rng, images)
    model, camera = pycolmap.Reconstruction(), pycolmap.Camera(
        camera_id=1, model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[focal, WIDTH / 2, HEIGHT / 2]
    )  # fmt: skip
    model.add_camera_with_trivial_rig(camera)
    seen, pixels = _observed(rng, keypoints, points, normals, poses, focal)
    columns = np.where(seen, np.cumsum(seen, axis=1) - 1, -1)
    for row, pose in enumerate(poses):
        image = pycolmap.Image(f"{row:04d}.jpg", pixels[row, seen[row]], 1, row + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(se3.inverse(pose)[:3]))
    for number, xyz in enumerate(points):
        track = pycolmap.Track()
        for row in np.flatnonzero(seen[:, number]):
            track.add_element(int(row) + 1, int(columns[row, number]))
        if track.length() >= 2:
            model.add_point3D(xyz, track)
    return model


def _observed(
    rng: np.random.Generator, keypoints: Keypoints, points: Array, normals: Array, poses: Array, focal: float
) -> tuple[Array, Array]:
    """Which camera (N, P) sees which point, and where (N, P, 2)."""
    seen, pixels = np.zeros((len(poses), len(points)), bool), np.zeros((len(poses), len(points), 2))
    rays = np.zeros((len(poses), len(points), 3))
    for row, pose in enumerate(poses):
        at = se3.transform(se3.inverse(pose), points)
        rays[row] = (pose[:3, 3] - points) / np.linalg.norm(pose[:3, 3] - points, axis=1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels[row] = focal * at[:, :2] / at[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        inside = (pixels[row] > 0).all(axis=1) & (pixels[row] < [WIDTH, HEIGHT]).all(axis=1) & (at[:, 2] > 0.3)
        facing = np.einsum("pi,pi->p", rays[row], normals) > np.cos(np.deg2rad(GRAZING_DEG)) * np.linalg.norm(
            normals, axis=1
        )
        seen[row] = inside & facing & (rng.random(len(points)) < keypoints.found_share)
    for number in range(len(points)):
        rows = np.flatnonzero(seen[:, number])
        if len(rows):
            near = rays[rows, number] @ rays[rng.choice(rows), number] > np.cos(np.deg2rad(keypoints.view_change_deg))
            seen[rows[~near], number] = False
    pixels += keypoints.noise_px * rng.normal(size=pixels.shape)
    wrong = rng.random(seen.shape) < keypoints.outlier_share
    pixels[wrong] += keypoints.outlier_px * rng.normal(size=(int(wrong.sum()), 2)) / 2**0.5
    return seen, pixels


def main() -> None:
    """Make one model and print what it holds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=sorted(KINDS))
    parser.add_argument("out", type=Path)
    parser.add_argument("--images", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--hard", action="store_true", help="more noise, 5 %% of the keypoints wrong, shorter tracks")
    options = parser.parse_args()
    model = make(options.kind, options.images, options.seed, HARD if options.hard else USUAL)
    options.out.mkdir(parents=True, exist_ok=True)
    model.write(options.out)
    if options.hard:
        (options.out / TRUE).mkdir(exist_ok=True)
        true_model(options.kind, options.images, options.seed, HARD).write(options.out / TRUE)
    print(model.summary())


if __name__ == "__main__":
    main()

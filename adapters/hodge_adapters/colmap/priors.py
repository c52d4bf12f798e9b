"""Where images were by other means, such as satellite fixes and gravity: of COLMAP's database, or of a table.

A model is placed in the world of those positions (metres; east, north, up of geodetic ones) by a robust similarity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.colmap.bodies import Bodies
from hodge_adapters.colmap.database import Known, noted_priors
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.trajectories.positions import read_positions
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, PositionPriors
from hodge_pipeline.types.text import counted

FEWEST = 3
"""A similarity has seven unknowns, three a position."""
LEAST_AGREEING, TRIALS, REFITS = 0.5, 300, 5
"""Share of the positions; trials of three each: with half of them wrong, one of 8 has three right ones."""
INLIER_SIGMAS = 3.0
"""One Gaussian error of 370 is larger."""
DRIFT = 0.03
"""Of the extent of the positions: a model may have drifted by so much and still be placed by most of them."""
SPREAD_SIGMAS = 3.0
"""Positions whose spread across their line is less, in their sigma, leave the model free to turn about it."""
NONE, GRAVITY_UP = np.full(3, np.nan), np.array([0.0, 0.0, 1.0])


def database_priors(path: Path) -> dict[str, Known]:
    """What the database knows of each image by name. Geodetic positions are east, north, up from the first image's.

    Raises `SourceError` where some are geodetic and others not.
    """
    noted = noted_priors(path)
    geodetic = {one.geodetic for one in noted.values() if np.isfinite(one.position).all()}
    if len(geodetic) > 1:
        raise SourceError(f"{path}: some pose priors are geodetic, others Cartesian: give those of one kind")
    positions = np.array([one.position for one in noted.values()]).reshape(-1, 3)
    known = np.isfinite(positions).all(axis=1)
    if geodetic == {True}:
        positions[known] = pycolmap.GPSTransform().ellipsoid_to_enu(positions[known], *positions[known][0])
    return {name: one._replace(position=at) for (name, one), at in zip(noted.items(), positions, strict=True)}


def table_priors(path: Path, notes: list[str]) -> dict[str, Known]:
    """The positions of a table by the image's name; see `PositionsReader`. Raises `SourceError`."""
    found = read_positions(path, notes)
    rows = zip(found.names.tolist(), found.points, found.covariances, strict=True)
    named = {name: Known(point, covariance, NONE) for name, point, covariance in rows if name}
    if not named:
        raise SourceError(f"{path}: has no column of names: images of a model have no stamps to find positions by")
    notes.append(f"{path.name}: {len(named)} known positions; zero is {found.origin}")
    return named


@dataclass(frozen=True)
class Placing:
    """`world_from_model`, and a line that says by what."""

    world_from_model: pycolmap.Sim3d
    told: str


def placing(images: Sequence[str], world_from_cam: Floats, known: Mapping[str, Known], sigma_m: float) -> Placing | str:
    """How the model of these images (N) and poses (N, 4, 4) lies in the world, or the reason why that is not known."""
    rows = [row for row, name in enumerate(images) if name in known]
    there = np.array([known[images[row]].position for row in rows]).reshape(-1, 3)
    with_position = np.isfinite(there).all(axis=1)
    if with_position.sum() >= FEWEST:
        here = world_from_cam[rows][with_position, :3, 3]
        stated = np.array([np.trace(known[images[row]].covariance) / 3 for row in rows])[with_position]
        sigma_m = float(np.sqrt(np.median(np.where(np.isfinite(stated), stated, sigma_m**2))))
        return _by_positions(here, there[with_position], sigma_m)
    down = np.array([known[images[row]].gravity for row in rows]).reshape(-1, 3)
    felt = np.isfinite(down).all(axis=1)
    if not felt.any():
        return f"{counted(int(with_position.sum()), 'known position')} of the model's images: {FEWEST} are needed"
    return _by_gravity(np.einsum("nij,nj->ni", world_from_cam[rows][felt, :3, :3], down[felt]))


def body_priors(
    images: Sequence[str], bodies: Bodies, known: Mapping[str, Known], sigma_m: float
) -> PositionPriors | None:
    """The positions of bodies whose reference image has one; None where no body has."""
    positions, covariances = np.full((len(bodies.names), 3), np.nan), np.full((len(bodies.names), 3, 3), np.nan)
    for row, name in enumerate(images):
        at = bodies.body_of_image[row]
        is_reference = np.abs(bodies.body_from_cam[row] - np.eye(4)).max() < 1e-9
        if name in known and is_reference and np.isfinite(known[name].position).all():
            positions[at], covariances[at] = known[name].position, known[name].covariance
            if not np.isfinite(covariances[at]).all():
                covariances[at] = sigma_m**2 * np.eye(3)
    return PositionPriors(positions, covariances) if np.isfinite(positions).any() else None


def _by_positions(here: Floats, there: Floats, sigma_m: float) -> Placing | str:
    on_a_line = f"{len(there)} known positions lie on one line, about which the model could turn"
    if _narrow_m(there) < SPREAD_SIGMAS * sigma_m:
        return on_a_line
    near_m = max(INLIER_SIGMAS * sigma_m, DRIFT * float(np.linalg.norm(np.ptp(there, axis=0))))
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed, options.min_inlier_ratio = near_m, 0, LEAST_AGREEING
    options.min_num_trials = options.max_num_trials = TRIALS
    found: Any = pycolmap.estimate_sim3d_robust(here, there, options)
    if found is None:
        return f"{len(there)} known positions do not fit the model: less than half of them agree"
    motion, inliers = found["tgt_from_src"], np.asarray(found["inlier_mask"], bool)
    for _ in range(REFITS):
        if inliers.sum() < max(FEWEST, LEAST_AGREEING * len(there)):
            return f"{len(there)} known positions do not fit the model: less than half of them agree"
        motion = pycolmap.estimate_sim3d(here[inliers], there[inliers]) or motion
        inliers = np.linalg.norm(np.array([motion * point for point in here]) - there, axis=1) < near_m
    if _narrow_m(there[inliers]) < SPREAD_SIGMAS * sigma_m:
        return on_a_line
    left_out = f" ({len(there) - inliers.sum()} do not agree)" if not inliers.all() else ""
    return Placing(motion, f"in the world of {inliers.sum()} known positions{left_out}")


def _narrow_m(points: Floats) -> float:
    """How far the points spread across the line that is nearest to them."""
    return float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1])


def _by_gravity(down: Floats) -> Placing:
    """Upright: the median of what the images felt (N, 3) points to −z."""
    unit = down / np.linalg.norm(down, axis=1, keepdims=True)
    middle = np.median(unit, axis=0)
    axis = np.cross(-middle / np.linalg.norm(middle), GRAVITY_UP)
    sine, cosine = np.linalg.norm(axis), float(-middle[2] / np.linalg.norm(middle))
    axis = axis / sine if sine > 1e-12 else np.array([1.0, 0.0, 0.0])
    turn = pycolmap.Rotation3d(se3.so3_exp(float(np.arctan2(sine, cosine)) * axis))
    return Placing(pycolmap.Sim3d(1.0, turn, np.zeros(3)), f"upright by gravity of {counted(len(down), 'image')}")

"""Frames between key frames resected, each by itself, against the corners of their solved key frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.pixels import back_project, project
from hodge_pipeline.registration.tracking.resection import resect
from hodge_pipeline.registration.tracking.shutter import at_frame_stamp
from hodge_pipeline.registration.tracking.sightings import Sightings, View
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Bools, Camera, Floats, Frame, Ints
from hodge_pipeline.types.arrays import groups

FEWEST_POINTS = 20
"""Inliers that a pose needs."""


@dataclass(frozen=True)
class PosedBlock:
    """The frames and key frames `rows (R,)` of a block of sightings: present poses (R, 4, 4), which are key frames
    `is_key (R,)`, velocities (R, 6), cameras, seconds by which colour is later than depth (R,), length units per metre.
    """

    rows: Ints
    world_from_cam: Floats
    is_key: Bools
    twists: Floats
    cameras: tuple[Camera, ...]
    colour_delays_s: Floats
    unit_m: float = 1.0


@dataclass(frozen=True)
class Reposed:
    """Rows (R,) of the frames resected, their poses (R, 4, 4) and the information (R, 6, 6) on `world_from_cam exp(ξ)`,
    and the rows of those with too few inliers.
    """

    rows: Ints
    world_from_cam: Floats
    information: Floats
    misfits: Ints


def repose_stored(block: tuple[Path, PosedBlock]) -> Reposed:
    """The frames of a block, resected by the sightings in a file."""
    return repose(artifacts.load(block[0], Sightings), block[1])


def repose(sightings: Sightings, block: PosedBlock) -> Reposed:
    """The frames of a block, resected; key frames keep their poses."""
    at = {int(row): place for place, row in enumerate(block.rows)}
    seen = _at_stamps(sightings, block, at)
    corners = _solved_corners(sightings, block, at, seen)
    rows, poses, information, misfits = [], [], [], []
    for row, own in groups(sightings.frame):
        place = at[row]
        if block.is_key[place]:
            continue
        points, start = corners[sightings.corner[own]], block.world_from_cam[place]
        found = resect(points, seen[own], block.cameras[place], start, block.unit_m)
        if found is None or found.inliers.sum() < FEWEST_POINTS:
            misfits.append(row)
        else:
            rows.append(row)
            poses.append(found.known_from_cam)
            information.append(found.information)
    motions, known = np.array(poses).reshape(-1, 4, 4), np.array(information).reshape(-1, 6, 6)
    return Reposed(np.array(rows, np.int64), motions, known, np.array(misfits, np.int64))


def _at_stamps(sightings: Sightings, block: PosedBlock, at: dict[int, int]) -> Floats:
    """Columns u, v, z (S, 3) of all sightings as they would be at the stamps of their frames."""
    out = sightings.seen.copy()
    world_from_key = block.world_from_cam[[at[int(row)] for row in sightings.key]]
    corners_in_world = np.einsum("nij,nj->ni", world_from_key[:, :3, :3], sightings.points) + world_from_key[:, :3, 3]
    for row, own in groups(sightings.frame):
        place = at[row]
        camera, delay_s, twist = block.cameras[place], float(block.colour_delays_s[place]), block.twists[place]
        expected = se3.transform(se3.inverse(block.world_from_cam[place]), corners_in_world[sightings.corner[own]])
        out[own] = seen_at_stamp(sightings.seen[own], expected[:, 2], camera, delay_s, twist)
    return out


def seen_at_stamp(seen: Floats, expected_z: Floats, camera: Camera, colour_delay_s: float, twist: Floats) -> Floats:
    """Columns u, v, z (n, 3) as they would be at the frame's stamp; `expected_z (n,)` stands in where z is NaN."""
    no_depth = np.isnan(seen[:, 2])
    whole = np.column_stack([seen[:, :2], np.where(no_depth, expected_z, seen[:, 2])])
    moved = project(at_frame_stamp(back_project(whole, camera), camera, colour_delay_s, twist), camera)
    moved[no_depth, 2] = np.nan
    return moved


def view_at_stamps(
    view: View, camera: Camera, frames: Sequence[Frame], twists: Floats, key_from_cam: Floats
) -> tuple[Floats, Floats]:
    """A view's points and what was seen of them, as they would be at the stamps of the key frame and of the frame."""
    points = at_frame_stamp(view.points, camera, frames[view.key].colour_delay_s, twists[view.key])
    expected_z = se3.transform(se3.inverse(key_from_cam), points)[:, 2]
    return points, seen_at_stamp(view.seen, expected_z, camera, frames[view.row].colour_delay_s, twists[view.row])


def _solved_corners(sightings: Sightings, block: PosedBlock, at: dict[int, int], seen: Floats) -> Floats:
    """Corners (C, 3) in the world: the mean of their positions as measured by each key frame that saw them."""
    total, count = np.zeros((len(sightings.key), 3)), np.ones(len(sightings.key))
    for row, own in groups(sightings.key):
        place = at[row]
        delay_s = float(block.colour_delays_s[place])
        points = at_frame_stamp(sightings.points[own], block.cameras[place], delay_s, block.twists[place])
        total[own] = se3.transform(block.world_from_cam[place], points)
    for row, own in groups(sightings.frame):
        place = at[row]
        own = own[np.isfinite(seen[own]).all(axis=1)]
        if block.is_key[place] and len(own):
            points = back_project(seen[own], block.cameras[place])
            total[sightings.corner[own]] += se3.transform(block.world_from_cam[place], points)
            count[sightings.corner[own]] += 1
    return total / count[:, None]

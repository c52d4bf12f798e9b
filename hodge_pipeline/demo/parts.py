"""Parts: bodies with a material each. A piece of furniture is a list of parts in its own frame; metres."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.demo.shapes import Mesh
from hodge_pipeline.types import Floats

Triple = tuple[float, float, float]
WHITE: Triple = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Material:
    """What a surface looks like: a texture by name, multiplied by a tint.

    - `tile_m`: the size of one repeat of the texture along the part's x, y and z.
    - `glow`: the share of the light that the surface gives off by itself: 1 for a lit lamp or the sky.
    - `measurable`: whether a depth camera sees it; glass it does not.
    """

    texture: str
    tint: Triple = WHITE
    tile_m: Triple = (1.0, 1.0, 1.0)
    glow: float = 0.0
    measurable: bool = True


@dataclass(frozen=True)
class Part:
    """A mesh in its own frame, its material, and where it stands: `room_from_part` (4, 4)."""

    mesh: Mesh
    material: Material
    room_from_part: Floats


def motion(x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0, roll_deg: float = 0.0) -> Floats:
    """The motion (4, 4) that rolls about x, then turns about z, then shifts; degrees and metres."""
    yaw = se3.so3_exp(np.array([0, 0, np.radians(yaw_deg)]))
    roll = se3.so3_exp(np.array([np.radians(roll_deg), 0, 0]))
    return se3.from_parts(yaw @ roll, np.array([x, y, z]))


def part(
    mesh: Mesh,
    material: Material,
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    yaw_deg: float = 0.0,
    roll_deg: float = 0.0,
) -> Part:
    """One part, placed in the frame of its furniture."""
    return Part(mesh, material, motion(x, y, z, yaw_deg, roll_deg))


def placed(parts: Iterable[Part], x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0) -> list[Part]:
    """The parts of a piece of furniture, moved together."""
    room_from_furniture = motion(x, y, z, yaw_deg)
    return [replace(p, room_from_part=room_from_furniture @ p.room_from_part) for p in parts]

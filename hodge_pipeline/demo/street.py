"""A modelled street block: facades, cars, trees and lamps along a closed road; x and y on the ground, z up; metres.

It has what is hard for a scanner out of doors: the north and the south street are equal to the last lamp, the west side
is an empty tunnel, and a few cars drive.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.demo.parts import motion
from hodge_pipeline.demo.shapes import Mesh, ball, box, cylinder
from hodge_pipeline.types import Floats, Ints

HALF_LENGTH_M, HALF_WIDTH_M, CORNER_M = 80.0, 52.0, 16.0
"""Of the road's middle line, and the radius of its corners: 500 m round."""
KERB_M, HOUSES_M = 5.5, 8.0
"""From the road's middle line to the pavement's trees, lamps and cars, and to the facades."""
TUNNEL_M, TUNNEL_HALF_WIDTH_M, TUNNEL_HEIGHT_M = 60.0, 5.0, 5.0
GROUND_M = 500.0
CAR = (4.4, 1.8, 1.5)
"""Length, width and height."""
SCANNER_HEIGHT_M = 1.9
WOBBLE_DEG, WOBBLE_M = 0.6, 0.02
"""Amplitudes of the car's body on its springs."""


class Place(NamedTuple):
    """Places on the road: `x`, `y` metres, `heading` radians, each (…)."""

    x: Floats
    y: Floats
    heading: Floats


@dataclass(frozen=True)
class Road:
    """The middle line of the road: a rectangle with round corners, driven counter-clockwise at one speed."""

    speed_m_s: float

    @property
    def length_m(self) -> float:
        """The length of one round."""
        return float(self._starts[-1])

    @property
    def _pieces(self) -> list[tuple[float, float, float, float]]:
        """(x, y, heading, length) at the start of each straight; a corner follows each."""
        along, across = 2 * (HALF_LENGTH_M - CORNER_M), 2 * (HALF_WIDTH_M - CORNER_M)
        return [
            (-HALF_LENGTH_M + CORNER_M, -HALF_WIDTH_M, 0.0, along),
            (HALF_LENGTH_M, -HALF_WIDTH_M + CORNER_M, np.pi / 2, across),
            (HALF_LENGTH_M - CORNER_M, HALF_WIDTH_M, np.pi, along),
            (-HALF_LENGTH_M, HALF_WIDTH_M - CORNER_M, 3 * np.pi / 2, across),
        ]

    @property
    def _starts(self) -> Floats:
        """The way (9,) at which each straight and each corner begins, and that of the whole round."""
        lengths = [part for *_, length in self._pieces for part in (length, CORNER_M * np.pi / 2)]
        return np.concatenate([[0.0], np.cumsum(lengths)])

    def world_from_car(self, times_s: Floats) -> Floats:
        """Poses (N, 4, 4) of the scanner: x ahead, y left, z up."""
        times_s = np.asarray(times_s, float)
        place = self.place(times_s * self.speed_m_s)
        turned = np.zeros((len(times_s), 3))
        turned[:, 2] = place.heading
        position = np.stack([place.x, place.y, np.full(len(times_s), SCANNER_HEIGHT_M)], axis=1)
        waves = np.sin(2 * np.pi * times_s[:, None] * np.array([0.9, 1.3, 0.7, 1.1]) + np.array([0.3, 1.7, 2.9, 4.2]))
        twist = np.zeros((len(times_s), 6))
        twist[:, :2] = np.radians(WOBBLE_DEG) * waves[:, :2]
        twist[:, 4:] = WOBBLE_M * waves[:, 2:]
        return np.asarray(se3.from_parts(se3.so3_exp(turned), position) @ se3.exp(twist))

    def place(self, way_m: Floats) -> Place:
        """The place after a way (…) on the middle line, in metres; any number of rounds."""
        starts = self._starts
        way = np.mod(way_m, starts[-1])
        piece = np.clip(np.searchsorted(starts, way, side="right") - 1, 0, 7)
        x0, y0, heading0, length = np.array(self._pieces)[piece // 2].T
        into = way - starts[piece]
        straight = np.where(piece % 2 == 0, into, length)
        angle = np.where(piece % 2 == 0, 0.0, into / CORNER_M)
        ahead, left = straight + CORNER_M * np.sin(angle), CORNER_M * (1 - np.cos(angle))
        x = x0 + np.cos(heading0) * ahead - np.sin(heading0) * left
        y = y0 + np.sin(heading0) * ahead + np.cos(heading0) * left
        return Place(x, y, heading0 + angle)


def build_street(seed: int) -> tuple[Floats, Ints]:
    """Vertices (V, 3) and triangles (T, 3) of everything that does not drive."""
    rng = np.random.default_rng([seed, 7])
    half_turn = motion(0, 0, yaw_deg=180)
    south = list(_side(rng, HALF_LENGTH_M, HALF_WIDTH_M))
    north = [mesh.moved(half_turn) for mesh in south]
    east = [mesh.moved(motion(0, 0, yaw_deg=90)) for mesh in _side(rng, HALF_WIDTH_M, HALF_LENGTH_M)]
    ground = box(GROUND_M, GROUND_M, 1.0).moved(motion(0, 0, -1.0))
    return joined([ground, *south, *north, *east, *_tunnel()])


def _side(rng: np.random.Generator, half_length_m: float, away_m: float) -> Iterator[Mesh]:
    """One straight street along x, its middle line at y = −`away_m`: houses, and what stands before them."""
    for facing, line in ((1.0, -away_m - HOUSES_M), (-1.0, -away_m + HOUSES_M)):
        end = half_length_m + facing * HOUSES_M  # the inner row ends before the crossing road
        x = -end
        while x < end - 4.0:
            width, height, setback = min(rng.uniform(7, 16), end - x), rng.uniform(6, 16), rng.uniform(0, 2.5)
            yield from _house(rng, x + width / 2, line - facing * setback, facing, width, height)
            x += width + (rng.uniform(1.5, 5) if rng.random() < 0.4 else 0.0)
        kerb = -away_m - facing * KERB_M
        for x in np.arange(CORNER_M - half_length_m, half_length_m - CORNER_M, 6.0):
            yield from _on_pavement(rng, float(x) + float(rng.uniform(-1.5, 1.5)), kerb, facing)


def _house(rng: np.random.Generator, x: float, y: float, facing: float, width: float, height: float) -> Iterator[Mesh]:
    """A house whose facade at `y` looks along `facing` y (±1), with a door step, bays and balconies."""
    yield box(width, 9.0, height).moved(motion(x, y - facing * 4.5))
    for _ in range(rng.integers(1, 5)):
        wide, deep, tall = rng.uniform(0.8, 3.0), rng.uniform(0.3, 1.2), rng.uniform(0.3, 2.8)
        at = x + rng.uniform(-0.5, 0.5) * max(width - wide, 0.1)
        yield box(wide, 2 * deep, tall).moved(motion(at, y, rng.choice([0.0, 2.6, 5.2])))


def _on_pavement(rng: np.random.Generator, x: float, y: float, facing: float) -> Iterator[Mesh]:
    """A tree, a lamp, a parked car, or nothing."""
    kind = rng.choice(4, p=[0.3, 0.2, 0.35, 0.15])
    if kind == 0:
        yield cylinder(rng.uniform(0.12, 0.3), 3.5, 10).moved(motion(x, y))
        yield ball(rng.uniform(1.0, 1.8), 12).moved(motion(x, y, 2.8))
    elif kind == 1:
        yield cylinder(0.09, 6.0, 8).moved(motion(x, y))
    elif kind == 2:
        parked = y + facing * 2.2
        yield box(*CAR[:2], 0.8).moved(motion(x, parked, 0.3, float(rng.uniform(-4, 4))))
        yield box(CAR[0] * 0.55, CAR[1] * 0.9, 0.5).moved(motion(x, parked, 1.1))


def _tunnel() -> list[Mesh]:
    """The west side: two smooth walls and a ceiling."""
    wall = box(0.4, TUNNEL_M, TUNNEL_HEIGHT_M)
    ceiling = box(2 * TUNNEL_HALF_WIDTH_M + 0.8, TUNNEL_M, 0.4).moved(motion(-HALF_LENGTH_M, 0, TUNNEL_HEIGHT_M))
    sides = [wall.moved(motion(-HALF_LENGTH_M + side * TUNNEL_HALF_WIDTH_M, 0)) for side in (-1.0, 1.0)]
    return [*sides, ceiling]


def joined(meshes: list[Mesh]) -> tuple[Floats, Ints]:
    """Vertices (V, 3) and triangles (T, 3) of the meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles)

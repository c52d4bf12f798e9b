"""The demo's rooms: x and y along the walls, z up, the origin in the middle of the floor; metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline.demo import furniture as f
from hodge_pipeline.demo.parts import Material, Part, Triple, part, placed
from hodge_pipeline.demo.shapes import ball, box, cylinder
from hodge_pipeline.demo.textures import Textures, make_textures
from hodge_pipeline.types import Bools, Floats, Floats32, Ints

WIDTH, DEPTH, HEIGHT = 5.6, 4.8, 2.6
"""Of a room: along x, y and z."""
LAMP: Triple = (0.3, -0.2, 1.85)
DOOR_WIDTH, DOOR_HEIGHT = 0.9, 2.05
NORTH_DOOR, SOUTH_DOOR = 0.8, 0.2
"""Where a door is in its wall: metres to the right of its middle as seen from inside."""
NORTH, WEST, SOUTH, EAST = 0.0, 90.0, 180.0, -90.0
"""The yaw, in degrees, that turns a piece's back to the wall at +y, -x, -y, +x."""


@dataclass(frozen=True)
class Room:
    """One mesh of the whole room, with a table of its parts' materials.

    - `vertices (V, 3)`, `normals (V, 3)`, `triangles (T, 3)` in the room's frame; `part_of_triangle (T,)`.
    - for each part: `part_from_room (P, 4, 4)`, `texture (P,)` rows of `textures`, `tint (P, 3)`, `tile_m (P, 3)`,
      `glow (P,)`, `measurable (P,)`: see `Material`.
    - `lamp (P, 3)`: the position of the light by which each part is lit.
    """

    vertices: Floats
    normals: Floats
    triangles: Ints
    part_of_triangle: Ints
    part_from_room: Floats
    texture: Ints
    tint: Floats32
    tile_m: Floats
    glow: Floats32
    measurable: Bools
    lamp: Floats
    textures: Textures


def _shell(doorways: Mapping[float, float]) -> list[Part]:
    """Floor, ceiling, walls and skirting; `doorways` by the yaw of their wall, metres to the right of its middle."""
    wall = Material("plaster", (0.93, 0.89, 0.8), (2.2, 2.2, 2.2))
    accent = Material("plaster", (0.7, 0.8, 0.83), (1.9, 1.9, 1.9))
    floor = Material("boards", (1.0, 0.92, 0.85), (1.4, 1.4, 1.0))
    ceiling = Material("plaster", (0.97, 0.97, 0.97), (3.1, 3.1, 1.0))
    parts = [
        part(box(WIDTH + 0.2, DEPTH + 0.2, 0.1), floor, z=-0.1),
        part(box(WIDTH + 0.2, DEPTH + 0.2, 0.1), ceiling, z=HEIGHT),
    ]
    for yaw_deg, length, away in _walls():
        paint = accent if yaw_deg in (EAST, WEST) else wall
        side = [part(box(length, 0.04, 0.05), f.LACQUER, 0, -0.02, 2.55)]
        doorway = doorways.get(yaw_deg)
        if doorway is not None:
            side += [part(box(DOOR_WIDTH, 0.1, HEIGHT - DOOR_HEIGHT), paint, doorway, 0.05, DOOR_HEIGHT)]
        for left, right in _beside(length / 2, doorway):
            x, wide = (left + right) / 2, right - left
            side += [part(box(wide + 0.2 * (doorway is None), 0.1, HEIGHT), paint, x, 0.05)]
            side += [part(box(wide, 0.016, 0.09), f.LACQUER, x, -0.008)]
        parts += _on_wall(side, yaw_deg, 0.0, away)
    return parts


def _beside(half: float, doorway: float | None) -> list[tuple[float, float]]:
    """The (left, right) ends of the closed pieces of a wall 2 `half` long."""
    if doorway is None:
        return [(-half, half)]
    return [(-half - 0.1, doorway - DOOR_WIDTH / 2), (doorway + DOOR_WIDTH / 2, half + 0.1)]


def _walls() -> list[tuple[float, float, float]]:
    """(yaw, length, distance from the centre) of each wall."""
    return [(NORTH, WIDTH, DEPTH / 2), (SOUTH, WIDTH, DEPTH / 2), (EAST, DEPTH, WIDTH / 2), (WEST, DEPTH, WIDTH / 2)]


def _on_wall(parts: list[Part], yaw_deg: float, along: float, away: float | None = None, z: float = 0.0) -> list[Part]:
    """Parts against a wall, `along` metres to the right of its middle as seen from inside, their y = 0 at the wall."""
    if away is None:
        away = next(distance for yaw, _, distance in _walls() if yaw == yaw_deg)
    yaw = np.radians(yaw_deg)
    right, outward = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    x, y = along * right + away * outward
    return placed(parts, float(x), float(y), z, yaw_deg)


def _furnishings(seed: int, number: int, doorways: Mapping[float, float]) -> list[Part]:
    """What stands in room `number` of a building, and what hangs on its walls."""
    desk = f.desk(seed)
    rug = Material("rug", tile_m=(2.3, 1.6, 1.0))
    hanging = Material("plain", (1.0, 0.97, 0.88), glow=0.85)
    return [
        *placed(desk, 2.08, 2.05, yaw_deg=NORTH),
        *placed(desk, -2.08, -2.05, yaw_deg=SOUTH),
        *_on_wall(placed(f.sofa(), 0, -0.48), NORTH, -0.75),
        *_on_wall(f.framed_picture(5 + number, 0.9, 0.6), NORTH, -1.2, z=1.6),
        *_on_wall(f.framed_picture(2 + number, 0.45, 0.6), NORTH, -0.25, z=1.62),
        *placed(f.floor_lamp(), -2.35, 2.0),
        *_on_wall(placed(f.shelf(seed + 1), 0, -0.18), WEST, 0.75),
        *_on_wall(f.framed_picture(9 + number, 0.5, 0.7), WEST, -0.45, z=1.55),
        *_on_wall(f.framed_picture(0 + number, 0.4, 0.4), WEST, 1.8, z=1.5),
        *placed(f.armchair(), -2.05, -0.25, yaw_deg=70),
        *([] if SOUTH in doorways else _on_wall(f.door(DOOR_WIDTH, DOOR_HEIGHT), SOUTH, SOUTH_DOOR)),
        *_on_wall(placed(f.sideboard(), 0, -0.24), SOUTH, -0.95),
        *_on_wall(f.framed_picture(7 + number, 0.8, 0.55), SOUTH, -0.95, z=1.65),
        *_on_wall(f.framed_picture(8 + number, 0.35, 0.5), SOUTH, -2.2, z=1.6),
        *_on_wall(f.window(1.3, 1.2), EAST, -0.2, z=1.0),
        *_on_wall(f.radiator(1.1), EAST, -0.2),
        *_on_wall(f.framed_picture(1 + number, 0.5, 0.4), EAST, 1.75, z=1.55),
        *placed(f.dining_table(), 2.05, -1.0, yaw_deg=80),
        *placed(f.coffee_table(), 0.1, 0.1),
        part(box(2.3, 1.6, 0.012), rug, 0.0, 0.1, yaw_deg=6),
        *placed(f.paper_bin(), 1.15, 2.1),
        *placed(f.paper_bin(), -1.15, -2.1),
        part(ball(0.11), Material("checker", (0.5, 0.8, 1.0), (0.3, 0.3, 0.3)), -0.9, -1.3),
        part(cylinder(0.008, 0.35), f.BLACK, LAMP[0], LAMP[1], HEIGHT - 0.35),
        part(ball(0.16), hanging, LAMP[0], LAMP[1], HEIGHT - 0.6),
    ]


def build_room(seed: int = 0) -> Room:
    """The furnished room; the seed changes textures, books and vases, not the furniture's places."""
    return _joined([_shell({}) + _furnishings(seed, 0, {})], [np.zeros(3)], seed)


def build_building(rooms: int, seed: int = 0) -> Room:
    """Rooms in a row, each open to the next; they differ in pictures, books and the paint of the walls."""
    origins = [room_origin(number) for number in range(rooms)]
    each = []
    for number, (x, y, _) in enumerate(origins):
        doorways = {} if number == 0 else {SOUTH: SOUTH_DOOR}
        doorways |= {} if number == rooms - 1 else {NORTH: NORTH_DOOR}
        parts = _shell(doorways) + _furnishings(seed + 2 * number, number, doorways)
        each.append(placed(_repainted(parts, np.random.default_rng([seed, 4, number])), float(x), float(y)))
    return _joined(each, origins, seed)


def room_origin(number: int) -> Floats:
    """The middle (3,) of the floor of a building's room, whose south door is the north door of the room before."""
    return number * np.array([NORTH_DOOR + SOUTH_DOOR, DEPTH + 0.2, 0.0])


def _repainted(parts: list[Part], rng: np.random.Generator) -> list[Part]:
    """The parts with the plaster of their walls in another colour."""
    paint = rng.uniform(0.75, 1.0, 3)

    def repainted(material: Material) -> Material:
        red, green, blue = (float(value) for value in np.multiply(material.tint, paint))
        return replace(material, tint=(red, green, blue)) if material.texture == "plaster" else material

    return [replace(p, material=repainted(p.material)) for p in parts]


def _joined(rooms: list[list[Part]], origins: list[Floats], seed: int) -> Room:
    """One mesh of rooms with these origins, each lit by a lamp of its own."""
    parts = [p for room in rooms for p in room]
    meshes = [p.mesh.moved(p.room_from_part) for p in parts]
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    textures = make_textures(np.random.default_rng(seed))
    lamps = np.array([origin + LAMP for origin in origins])
    return Room(
        vertices=np.concatenate([m.vertices for m in meshes]),
        normals=np.concatenate([m.normals for m in meshes]),
        triangles=np.concatenate([m.triangles + start for m, start in zip(meshes, starts, strict=True)]),
        part_of_triangle=np.repeat(np.arange(len(parts)), [len(m.triangles) for m in meshes]),
        part_from_room=np.linalg.inv(np.stack([p.room_from_part for p in parts])),
        texture=np.array([textures.names.index(p.material.texture) for p in parts], np.int64),
        tint=np.array([p.material.tint for p in parts], np.float32),
        tile_m=np.array([p.material.tile_m for p in parts]),
        glow=np.array([p.material.glow for p in parts], np.float32),
        measurable=np.array([p.material.measurable for p in parts]),
        lamp=np.repeat(lamps, [len(room) for room in rooms], axis=0),
        textures=textures,
    )

"""Furniture, each piece with its back towards +y and its front towards -y, standing on z = 0; metres."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.demo.parts import Material, Part, Triple, motion, part, placed
from hodge_pipeline.demo.shapes import Mesh, ball, box, curtain, cylinder, lathe
from hodge_pipeline.demo.textures import PICTURES, SPINES

OAK = Material("wood", (1.0, 0.9, 0.75), (0.7, 0.7, 0.25))
WALNUT = Material("wood", (0.62, 0.48, 0.4), (0.7, 0.7, 0.25))
LACQUER = Material("plain", (0.95, 0.95, 0.93))
BLACK = Material("plain", (0.13, 0.13, 0.15), (0.3, 0.3, 0.3))
STEEL = Material("plain", (0.6, 0.62, 0.65), (0.3, 0.3, 0.3))
LEAF = Material("fabric", (0.25, 0.5, 0.22), (0.2, 0.2, 0.2))


def painted(tint: Triple) -> Material:
    """Even paint or glaze of one colour."""
    return Material("plain", tint, (0.4, 0.4, 0.4))


def cloth(tint: Triple) -> Material:
    """A woven cover of one colour."""
    return Material("fabric", tint, (0.5, 0.5, 0.5))


def legs(width: float, depth: float, height: float, thickness: float, material: Material) -> list[Part]:
    """Four legs, their outer edges `width` by `depth` apart."""
    x, y = (width - thickness) / 2, (depth - thickness) / 2
    return [
        part(box(thickness, thickness, height), material, x * sx, y * sy)
        for sx, sy in ((-1, -1), (-1, 1), (1, -1), (1, 1))
    ]


def book_row(rng: np.random.Generator, length: float, height: float) -> list[Part]:
    """Books side by side along x, from x = 0, no longer than `length`, their backs towards -y."""
    parts, x = [], 0.0
    while (width := rng.uniform(0.025, 0.06)) + x < length:
        tall, deep = height * rng.uniform(0.65, 0.95), rng.uniform(0.15, 0.22)
        cover = Material(f"spine{rng.integers(SPINES)}", tile_m=(width, deep, tall))
        parts.append(part(box(width, deep, tall), cover, x + width / 2, (deep - 0.22) / 2))
        x += width + rng.uniform(0.001, 0.012)
    return parts


def framed_picture(index: int, width: float, height: float) -> list[Part]:
    """A picture that hangs on a wall at y = 0, its centre at z = 0."""
    canvas = Material(f"picture{index % PICTURES}", tile_m=(width, 1.0, height))
    frame = OAK if index % 2 else BLACK
    return [
        part(box(width + 0.06, 0.03, height + 0.06), frame, 0, -0.015, -height / 2 - 0.03),
        part(box(width, 0.01, height), canvas, 0, -0.035, -height / 2),
    ]


def desk(seed: int) -> list[Part]:
    """A desk 1.4 m wide with screen, lamp, globe, books, papers, a chair before it and a picture over it.

    The same seed gives the same desk to the last book: two of them are what perceptual aliasing is made of.
    """
    rng = np.random.default_rng(seed)
    parts = [part(box(1.4, 0.65, 0.04), OAK, z=0.71), *legs(1.36, 0.6, 0.71, 0.05, STEEL)]
    parts += [part(box(0.4, 0.55, 0.55), LACQUER, 0.45, 0, 0.12)]
    parts += [part(box(0.36, 0.02, 0.15), OAK, 0.45, -0.28, 0.15 + 0.17 * k) for k in range(3)]
    screen = Material("text", (0.75, 0.85, 1.0), (0.54, 1.0, 0.32), glow=0.5)
    parts += [
        part(box(0.58, 0.03, 0.36), BLACK, -0.1, 0.15, 0.9),
        part(box(0.54, 0.01, 0.32), screen, -0.1, 0.13, 0.92),
    ]
    parts += [part(cylinder(0.11, 0.015), BLACK, -0.1, 0.17, 0.75), part(box(0.06, 0.03, 0.2), BLACK, -0.1, 0.18, 0.75)]
    keys = Material("checker", (0.5, 0.5, 0.5), (0.2, 0.2, 0.2))
    parts += [part(box(0.42, 0.13, 0.02), keys, -0.1, -0.12, 0.75, yaw_deg=4)]
    paper = Material("text", tile_m=(0.21, 0.297, 1.0))
    parts += [part(box(0.21, 0.297, 0.012), paper, 0.32, -0.12, 0.75, yaw_deg=-20)]
    parts += placed(desk_lamp(), -0.58, 0.12, 0.75)
    globe = Material("picture3", (0.75, 0.9, 1.0), (0.3, 0.3, 0.3))
    parts += [part(cylinder(0.07, 0.05), WALNUT, 0.36, 0.14, 0.75), part(ball(0.12), globe, 0.36, 0.14, 0.8)]
    parts += placed(book_row(rng, 0.16, 0.28), 0.52, 0.15, 0.75)
    parts += placed(office_chair(), -0.1, -0.55, yaw_deg=160)
    return parts + placed(framed_picture(4, 0.7, 0.5), 0.05, 0.325, 1.65)


def desk_lamp() -> list[Part]:
    """A lamp with a foot, a leaning arm and a conical shade."""
    shade = painted((0.85, 0.3, 0.15))
    return [
        part(cylinder(0.08, 0.02), BLACK),
        part(cylinder(0.012, 0.36), STEEL, roll_deg=20),
        part(lathe([(0.1, 0), (0.035, 0.12), (0, 0.12)]), shade, 0, -0.15, 0.3, roll_deg=-15),
    ]


def office_chair() -> list[Part]:
    """A swivel chair, its back towards +y."""
    cover = cloth((0.25, 0.35, 0.6))
    feet = [part(box(0.5, 0.04, 0.04), BLACK, 0, 0, 0.03, yaw_deg=60 * k) for k in range(3)]
    return [
        *feet,
        part(cylinder(0.03, 0.4), STEEL, z=0.05),
        part(lathe([(0, 0), (0.2, 0), (0.23, 0.03), (0.22, 0.07), (0, 0.08)]), cover, z=0.43),
        part(box(0.06, 0.03, 0.4), BLACK, 0, 0.24, 0.45),
        part(box(0.42, 0.05, 0.4), cover, 0, 0.22, 0.62, roll_deg=-8),
    ]


def wooden_chair() -> list[Part]:
    """A chair with a backrest of three rails."""
    posts = [part(box(0.04, 0.04, 0.5), WALNUT, x, 0.19, 0.45) for x in (-0.19, 0.19)]
    rails = [part(box(0.38, 0.02, 0.06), WALNUT, 0, 0.19, z) for z in (0.58, 0.72, 0.86)]
    return [
        *legs(0.42, 0.42, 0.45, 0.04, WALNUT),
        part(box(0.44, 0.44, 0.04), WALNUT, z=0.44),
        part(box(0.38, 0.38, 0.03), cloth((0.8, 0.65, 0.25)), z=0.48),
        *posts,
        *rails,
    ]


def dining_table() -> list[Part]:
    """A laid table, 1.2 m by 0.8 m, with two chairs."""
    china, jug = painted((0.92, 0.93, 0.96)), painted((0.2, 0.45, 0.6))
    plate = lathe([(0, 0), (0.07, 0), (0.12, 0.02), (0.07, 0.008), (0, 0.008)])
    cup = lathe([(0, 0), (0.03, 0), (0.04, 0.05), (0.042, 0.09), (0.036, 0.09), (0.03, 0.01), (0, 0.01)])
    jug_body = lathe([(0, 0), (0.07, 0.0), (0.095, 0.08), (0.08, 0.16), (0.045, 0.22), (0.06, 0.28), (0.05, 0.28)])
    return [
        part(box(1.2, 0.8, 0.03), OAK, z=0.72),
        part(box(1.0, 0.5, 0.006), Material("checker", tile_m=(0.6, 0.6, 0.6)), z=0.75),
        *legs(1.14, 0.74, 0.72, 0.06, OAK),
        *[part(plate, china, x, y, 0.756) for x, y in ((-0.3, -0.22), (0.3, 0.2))],
        *[part(cup, jug, x, y, 0.756) for x, y in ((-0.05, -0.25), (0.5, 0.05))],
        part(jug_body, jug, 0.02, 0.08, 0.756),
        part(box(0.3, 0.2, 0.16), Material("picture7", tile_m=(0.3, 0.2, 0.16)), -0.38, 0.18, 0.756, yaw_deg=25),
        *placed(wooden_chair(), -0.35, -0.55, yaw_deg=172),
        *placed(wooden_chair(), 0.35, 0.5, yaw_deg=10),
    ]


def sofa() -> list[Part]:
    """A sofa 1.9 m wide with round arms and three cushions."""
    cover = cloth((0.45, 0.5, 0.42))
    parts = [part(box(1.7, 0.75, 0.3), cover, 0, 0, 0.1), part(box(1.7, 0.2, 0.5), cover, 0, 0.33, 0.35, roll_deg=-8)]
    for x in (-0.9, 0.9):
        parts += [part(box(0.2, 0.85, 0.4), cover, x, 0, 0.08), part(cylinder(0.11, 0.87), cover, x, 0.435, 0.5, 0, 90)]
    parts += [part(box(0.82, 0.62, 0.12), cloth((0.5, 0.56, 0.47)), x, -0.06, 0.4) for x in (-0.42, 0.42)]
    cushion = lathe([(0, 0), (0.17, 0.015), (0.22, 0.06), (0.17, 0.105), (0, 0.12)])
    for x, texture in ((-0.62, "picture5"), (0.08, "checker"), (0.6, "picture8")):
        parts.append(part(cushion, Material(texture, tile_m=(0.45, 0.45, 0.45)), x, 0.2, 0.72, 8 * x, 68))
    return parts


def armchair() -> list[Part]:
    """A tub chair: a round seat inside a curved back."""
    back = curved_wall(0.4, 0.34, 0.42)
    cover = cloth((0.7, 0.3, 0.22))
    return [
        part(cylinder(0.36, 0.3), cover, 0, 0, 0.1),
        part(lathe([(0, 0), (0.3, 0), (0.33, 0.04), (0.3, 0.1), (0, 0.12)]), cloth((0.8, 0.4, 0.3)), 0, -0.03, 0.4),
        *[part(piece, cover, z=0.3) for piece in back],
        *legs(0.5, 0.5, 0.12, 0.05, WALNUT),
    ]


def curved_wall(outer: float, inner: float, height: float) -> list[Mesh]:
    """The back of a tub chair: thirteen slabs round the half circle about +y."""
    width = 1.12 * np.pi * outer / 12
    slab = box(width, outer - inner, height)
    radius = (outer + inner) / 2
    angles = np.linspace(-10, 190, 13)
    return [
        slab.moved(motion(radius * float(np.cos(a)), radius * float(np.sin(a)), 0, float(np.degrees(a)) - 90))
        for a in np.radians(angles)
    ]


def shelf(seed: int) -> list[Part]:
    """A bookcase 1.2 m wide and 1.9 m high: books, boxes and vases."""
    rng = np.random.default_rng(seed)
    parts = [part(box(0.03, 0.32, 1.9), OAK, x) for x in (-0.6, 0.6)]
    parts += [part(box(1.2, 0.02, 1.9), WALNUT, 0, 0.15)]
    parts += [part(box(1.2, 0.32, 0.03), OAK, z=z) for z in (0.05, 0.42, 0.79, 1.16, 1.53, 1.87)]
    vase = lathe([(0, 0), (0.05, 0), (0.08, 0.07), (0.075, 0.13), (0.03, 0.2), (0.045, 0.25), (0.035, 0.25)])
    for row, z in enumerate((0.08, 0.45, 0.82, 1.19, 1.56)):
        books = float(rng.uniform(0.45, 0.7))
        left = -0.57 if row % 2 else 0.57 - books
        parts += placed(book_row(rng, books, 0.3), left, 0.02, z)
        free = (left + books + 0.28) if row % 2 else (left - 0.28)
        if row in (1, 3):
            parts.append(part(vase, painted(tuple(rng.uniform(0.2, 0.9, 3))), free, -0.02, z))
        else:
            pattern = Material(f"spine{row}", tile_m=(0.34, 0.24, 0.22))
            parts.append(part(box(0.34, 0.24, 0.22), pattern, free, -0.01, z, yaw_deg=float(rng.uniform(-8, 8))))
    return [*parts, part(box(0.4, 0.26, 0.2), Material("picture6", tile_m=(0.4, 0.26, 0.2)), -0.2, 0, 1.9, yaw_deg=7)]


def sideboard() -> list[Part]:
    """A low cabinet 1.1 m wide with a plant, a stack of books and a radio."""
    parts = [part(box(1.1, 0.42, 0.7), WALNUT, 0, 0, 0.08), *legs(1.0, 0.36, 0.08, 0.05, BLACK)]
    parts += [part(box(0.5, 0.02, 0.6), OAK, x, -0.215, 0.13) for x in (-0.265, 0.265)]
    parts += [part(ball(0.02), STEEL, x, -0.235, 0.45) for x in (-0.06, 0.06)]
    for k in range(4):
        cover = Material(f"spine{k + 5}", tile_m=(0.3, 0.2, 0.04))
        parts.append(part(box(0.3 - 0.02 * k, 0.2, 0.04), cover, 0.32, 0, 0.78 + 0.04 * k, yaw_deg=9 * k - 10))
    radio = Material("text", (0.85, 0.6, 0.4), (0.3, 1.0, 0.18))
    return [
        *parts,
        part(box(0.3, 0.12, 0.18), radio, -0.02, 0.04, 0.78, yaw_deg=-6),
        *placed(plant(), -0.36, 0.0, 0.78),
    ]


def plant() -> list[Part]:
    """A pot with leaves of half-flattened balls."""
    pot = lathe([(0, 0), (0.07, 0), (0.1, 0.16), (0.11, 0.17), (0.09, 0.17), (0, 0.15)])
    parts = [part(pot, painted((0.75, 0.4, 0.25))), part(cylinder(0.012, 0.3), WALNUT, z=0.15)]
    leaf = lathe([(0, 0), (0.03, 0.06), (0.04, 0.14), (0.025, 0.22), (0, 0.28)], 8)
    for k in range(9):
        parts.append(part(leaf, LEAF, 0, 0, 0.26 + 0.03 * (k % 4), yaw_deg=40 * k, roll_deg=35 + 12 * (k % 3)))
    return parts


def coffee_table() -> list[Part]:
    """A low round table with a bowl of fruit, a vase and two books."""
    bowl = lathe([(0, 0), (0.06, 0), (0.12, 0.04), (0.15, 0.09), (0.14, 0.09), (0.1, 0.045), (0, 0.02)])
    vase = lathe([(0, 0), (0.045, 0), (0.08, 0.06), (0.085, 0.12), (0.045, 0.2), (0.03, 0.24), (0.05, 0.28)])
    fruit = [
        ((-0.02, 0.03), (0.85, 0.5, 0.1)),
        ((0.05, -0.02), (0.75, 0.15, 0.12)),
        ((-0.05, -0.04), (0.55, 0.7, 0.15)),
    ]
    return [
        part(lathe([(0, 0), (0.4, 0), (0.42, 0.02), (0.4, 0.04), (0, 0.04)], 40), WALNUT, z=0.4),
        part(cylinder(0.05, 0.4), STEEL),
        part(lathe([(0.24, 0), (0.22, 0.03), (0.0, 0.04)]), STEEL),
        part(bowl, painted((0.9, 0.88, 0.8)), -0.12, 0.14, 0.44),
        *[part(ball(0.04, 16), painted(tint), -0.12 + x, 0.14 + y, 0.47) for (x, y), tint in fruit],
        part(vase, painted((0.3, 0.5, 0.75)), 0.2, 0.1, 0.44),
        part(box(0.22, 0.16, 0.03), Material("picture1", tile_m=(0.22, 0.16, 0.03)), 0.04, -0.2, 0.44, yaw_deg=30),
        part(box(0.19, 0.14, 0.025), Material("picture2", tile_m=(0.19, 0.14, 0.03)), 0.05, -0.2, 0.47, yaw_deg=8),
    ]


def floor_lamp() -> list[Part]:
    """A standing lamp with a drum shade."""
    shade = Material("fabric", (1.0, 0.92, 0.75), (0.3, 0.3, 0.3), glow=0.5)
    return [
        part(lathe([(0.16, 0), (0.15, 0.03), (0, 0.04)]), STEEL),
        part(cylinder(0.015, 1.45), STEEL),
        part(lathe([(0.22, 0), (0.15, 0.32), (0, 0.32)]), shade, z=1.35),
    ]


def window(width: float, height: float) -> list[Part]:
    """A window in a wall at y = 0, its lower edge at z = 0: sky behind a frame, a sill, two curtains on a rail."""
    glass = Material("sky", tile_m=(width, 1.0, height), glow=1.0, measurable=False)
    sash, half = 0.07, width / 2
    drapery = Material("fabric", (0.72, 0.62, 0.4), (0.35, 0.35, 0.35))
    parts = [part(box(width, 0.01, height), glass, 0, -0.005)]
    parts += [part(box(sash, 0.06, height + 2 * sash), LACQUER, x, -0.03, -sash) for x in (-half, 0.0, half)]
    parts += [part(box(width, 0.06, sash), LACQUER, 0, -0.03, z) for z in (-sash, height)]
    parts += [part(box(width + 0.2, 0.2, 0.03), LACQUER, 0, -0.1, -sash - 0.03)]
    parts += [part(curtain(0.38, height + 0.5, 4, 0.09), drapery, x, -0.17, -0.35) for x in (-half - 0.1, half + 0.1)]
    return [*parts, part(cylinder(0.015, width + 0.7), STEEL, -half - 0.35, -0.17, height + 0.17, 90, 90)]


def radiator(width: float) -> list[Part]:
    """A ribbed radiator before a wall at y = 0."""
    ribs = np.arange(-width / 2, width / 2, 0.08)
    parts = [part(box(0.055, 0.1, 0.5), LACQUER, float(x), -0.09, 0.12) for x in ribs]
    return [
        *parts,
        part(box(width, 0.04, 0.08), LACQUER, -0.03, -0.09, 0.2),
        part(box(width, 0.04, 0.08), LACQUER, -0.03, -0.09, 0.5),
    ]


def door(width: float, height: float) -> list[Part]:
    """A panelled door in its frame, in a wall at y = 0."""
    leaf, trim = painted((0.82, 0.8, 0.74)), painted((0.7, 0.66, 0.58))
    parts = [part(box(width, 0.02, height), leaf, 0, -0.01)]
    parts += [part(box(0.1, 0.05, height + 0.1), LACQUER, x, -0.025) for x in (-width / 2 - 0.05, width / 2 + 0.05)]
    parts += [part(box(width, 0.05, 0.1), LACQUER, 0, -0.025, height)]
    for z, tall in ((0.15, 0.75), (1.05, 0.8)):
        parts += [part(box(width * 0.36, 0.025, tall), trim, x * width, -0.02, z) for x in (-0.22, 0.22)]
    return [
        *parts,
        part(box(0.12, 0.03, 0.02), STEEL, width * 0.4, -0.06, 0.98),
        part(ball(0.022), STEEL, width * 0.45, -0.05, 0.97),
    ]


def paper_bin() -> list[Part]:
    """A conical waste-paper bin."""
    return [
        part(lathe([(0, 0), (0.1, 0), (0.14, 0.3), (0.132, 0.3), (0.095, 0.02), (0, 0.02)]), painted((0.3, 0.45, 0.35)))
    ]

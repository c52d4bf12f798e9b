"""Draws the pictures of docs/glossary.md, one small SVG for each word: `python docs/make_glossary.py`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

PICTURES = Path(__file__).parent / "pictures"
HEADER = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 320 170" width="320" height="170"
 font-family="sans-serif" font-size="12" text-anchor="middle">
<rect width="320" height="170" rx="6" fill="#fff"/>"""
INK, BLUE, ORANGE, GREY = "#333", "#0072b2", "#d55e00", "#999"
HEAD, SHORT = 9.0, 15.0
Point = tuple[float, float]


def main() -> None:
    """Write `glossary-*.svg`."""
    drawings = {
        "edge": _edge(), "fitness": _fitness(), "gauge": _gauge(), "exact": _exact(), "coexact": _coexact(),
        "harmonic": _harmonic(),
    }  # fmt: skip
    for name, parts in drawings.items():
        (PICTURES / f"glossary-{name}.svg").write_text("\n".join([HEADER, *parts, "</svg>"]) + "\n", "utf-8")


def _edge() -> Iterable[str]:
    yield from _camera((60, 110), -20, BLUE)
    yield from _camera((255, 120), 15, ORANGE)
    yield _words((60, 145), "camera i", BLUE)
    yield _words((255, 152), "camera j", ORANGE)
    yield from _arrow((245, 110), (75, 102), INK, label="i_from_j")
    yield _line([(60 + 10 * k, 30 + 6 * math.sin(k / 2)) for k in range(21)], GREY)
    yield _words((160, 20), "the surface that both see", GREY)


def _fitness() -> Iterable[str]:
    for k in range(22):
        x, y = 30 + 9 * k, 85 - 35 * math.sin(k / 6)
        yield _dot((x, y), BLUE)
    for k in range(22):
        x, y = 102 + 9 * k, 79 - 35 * math.sin((k + 8) / 6)
        yield _dot((x, y), ORANGE if k < 14 else GREY)
    yield _words((70, 130), "cloud i", BLUE)
    yield _words((165, 130), "of j: 14 near i", ORANGE)
    yield _words((265, 130), "8 not", GREY)
    yield _words((160, 155), "fitness 14 / 22 = 0.64", INK)


def _gauge() -> Iterable[str]:
    for (x, y), turn, colour in (((85, 80), 0.0, BLUE), ((235, 75), 0.7, ORANGE)):
        corners = [_turned((x, y), point, turn) for point in ((-45, 30), (45, 30), (0, -40))]
        yield _line([*corners, corners[0]], colour)
        yield from (_dot(corner, colour, 5) for corner in corners)
    yield from _arrow((120, 40), (190, 30), GREY)
    yield _words((160, 160), "moved as a whole: every edge still fits", INK)


RING = [(160 + 105 * math.cos(0.5 + k * math.tau / 6), 82 + 58 * math.sin(0.5 + k * math.tau / 6)) for k in range(6)]
TRIANGLES = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (6, 0), (6, 1), (6, 2), (6, 3), (6, 4), (6, 5))


def _exact() -> Iterable[str]:
    points = [*RING, (160.0, 82.0)]
    heights = [1.5, 3.0, 2.5, -0.5, -2.5, -1.0, 0.5]
    for i, j in TRIANGLES:
        first, last = (i, j) if heights[j] > heights[i] else (j, i)
        yield from _arrow(points[first], points[last], BLUE, width=0.6 + abs(heights[j] - heights[i]))
    yield from (_dot(point, INK, 3 + height + 2.5) for point, height in zip(points, heights, strict=True))
    yield _words((160, 163), "moving the cameras undoes all of it", INK)


def _coexact() -> Iterable[str]:
    points = [*RING, (160.0, 82.0)]
    yield from (_line([points[i], points[j]], "#ddd") for i, j in TRIANGLES)
    for i, j in ((0, 1), (1, 6), (6, 0)):
        yield from _arrow(points[i], points[j], ORANGE, width=2.5)
    yield from (_dot(point, INK, 4) for point in points)
    yield _words((160, 163), "one triangle does not close", INK)


def _harmonic() -> Iterable[str]:
    count = 10
    ring = [
        (160 + 115 * math.cos(k * math.tau / count), 78 + 60 * math.sin(k * math.tau / count)) for k in range(count)
    ]
    for k in range(count):
        yield from _arrow(ring[k], ring[(k + 1) % count], ORANGE, width=1.5)
    yield from (_dot(point, INK, 4) for point in ring)
    yield _words((160, 75), "no edge", GREY)
    yield _words((160, 92), "in between", GREY)
    yield _words((160, 163), "round a loop, the same on each edge", INK)


def _camera(at: Point, degrees: float, colour: str) -> Iterable[str]:
    corners = [_turned(at, point, math.radians(degrees)) for point in ((0, 12), (-16, -16), (16, -16))]
    yield _line([*corners, corners[0]], colour)


def _turned(centre: Point, point: Point, angle: float) -> Point:
    cos, sin = math.cos(angle), math.sin(angle)
    return centre[0] + cos * point[0] - sin * point[1], centre[1] + sin * point[0] + cos * point[1]


def _arrow(start: Point, end: Point, colour: str, *, width: float = 2.0, label: str = "") -> Iterable[str]:
    length = math.dist(start, end)
    along = ((end[0] - start[0]) / length, (end[1] - start[1]) / length)
    first = (start[0] + SHORT * along[0], start[1] + SHORT * along[1])
    last = (end[0] - SHORT * along[0], end[1] - SHORT * along[1])
    yield _line([first, last], colour, width)
    sides = [
        (last[0] - HEAD * along[0] + s * HEAD / 2 * along[1], last[1] - HEAD * along[1] - s * HEAD / 2 * along[0])
        for s in (-1, 1)
    ]
    tip = (last[0] + 2 * along[0], last[1] + 2 * along[1])
    yield f'<polygon points="{_list([sides[0], tip, sides[1]])}" fill="{colour}"/>'
    if label:
        yield _words(((first[0] + last[0]) / 2, (first[1] + last[1]) / 2 - 8), label, colour)


def _line(points: list[Point], colour: str, width: float = 2.0) -> str:
    return f'<polyline points="{_list(points)}" fill="none" stroke="{colour}" stroke-width="{width:.1f}"/>'


def _dot(at: Point, colour: str, radius: float = 3.5) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius:.1f}" fill="{colour}"/>'


def _words(at: Point, text: str, colour: str) -> str:
    return f'<text x="{at[0]:.0f}" y="{at[1]:.0f}" fill="{colour}">{text}</text>'


def _list(points: Iterable[Point]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


if __name__ == "__main__":
    main()

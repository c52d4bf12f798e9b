"""Procedural textures, so that the colour images hold features: wood, fabric, rugs, pictures, book spines, print."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.types import Floats, Floats32, Ints

SIZE, LEVELS = 256, 7
"""Pixels of a texture's side, a power of two, and its mip levels."""
PICTURES, SPINES = 10, 12
"""Textures of these kinds."""


@dataclass(frozen=True)
class Textures:
    """Square RGB textures that repeat, each with its mip levels, in one flat table of texels (M, 3), values in 0..1.

    Level k of texture i starts at `offsets[k] + i * (SIZE >> k)²`.
    """

    names: tuple[str, ...]
    texels: Floats32
    offsets: Ints

    def sample(self, texture: Ints, uv: Floats, footprint: Floats) -> Floats32:
        """Colours (P, 3) at `uv (P, 2)`, one unit a repeat, bilinear in the level whose texels are `footprint` wide.

        `footprint (P,)` is the width of one pixel in units of uv: the level chosen by it keeps fine patterns from
        flickering between frames, as the optics of a camera do.
        """
        level = np.clip(np.rint(np.log2(np.maximum(footprint * SIZE, 1e-9))), 0, LEVELS - 1).astype(np.int64)
        size = SIZE >> level
        base = self.offsets[level] + texture * size * size
        at = uv * size[:, None] - 0.5
        corner = np.floor(at).astype(np.int64)
        share = (at - corner).astype(np.float32)
        out = np.zeros((len(uv), 3), np.float32)
        for du, dv in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = (share[:, 0] if du else 1 - share[:, 0]) * (share[:, 1] if dv else 1 - share[:, 1])
            column, row = (corner[:, 0] + du) & (size - 1), (corner[:, 1] + dv) & (size - 1)
            out += weight[:, None] * self.texels[base + row * size + column]
        return out


def _clouds(rng: np.random.Generator, roughness: float, stretch: float = 1.0) -> Floats:
    """Repeating fractal noise (SIZE, SIZE) in 0..1, finer for a small roughness, stretched along rows."""
    frequency = np.fft.fftfreq(SIZE) * SIZE
    radius = np.hypot(frequency[:, None], stretch * frequency[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((SIZE, SIZE))) / np.maximum(radius, 1.0) ** roughness
    spectrum[0, 0] = 0
    noise = np.real(np.fft.ifft2(spectrum))
    low, high = np.quantile(noise, [0.01, 0.99])
    return np.asarray(np.clip((noise - low) / (high - low), 0, 1))


def _grey(values: Floats) -> Floats:
    return np.repeat(values[..., None], 3, axis=2)


def _mix(share: Floats, a: tuple[float, float, float], b: tuple[float, float, float]) -> Floats:
    return np.asarray(share[..., None] * np.array(a) + (1 - share[..., None]) * np.array(b))


def _axes() -> tuple[Floats, Floats]:
    """Row and column coordinates (SIZE, SIZE) in 0..1."""
    at = (np.arange(SIZE) + 0.5) / SIZE
    row, column = np.meshgrid(at, at, indexing="ij")
    return row, column


def plaster(rng: np.random.Generator) -> Floats:
    """A painted wall: faint large stains, fine grain."""
    return _grey(0.84 + 0.1 * _clouds(rng, 1.8) + 0.06 * _clouds(rng, 0.6))


def plain(rng: np.random.Generator) -> Floats:
    """Paint or plastic: nearly even."""
    return _grey(0.9 + 0.1 * _clouds(rng, 1.2))


def wood(rng: np.random.Generator) -> Floats:
    """Grain along the columns."""
    row, _ = _axes()
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (6 * row + 1.5 * _clouds(rng, 2.0, 4.0)))
    return _mix(0.6 * rings + 0.4 * _clouds(rng, 0.7, 12.0), (0.95, 0.75, 0.52), (0.66, 0.45, 0.27))


def boards(rng: np.random.Generator) -> Floats:
    """A parquet floor of eight boards, each of its own shade, with dark joints."""
    row, column = _axes()
    board = (row * 8).astype(int)
    shade = rng.uniform(0.75, 1.0, 8)[board]
    end = np.abs((column + rng.uniform(0, 1, 8)[board]) % 1 - 0.5) < 0.004
    joint = (np.abs(row * 8 - np.round(row * 8)) < 0.045) | end
    return np.asarray(wood(rng) * (shade * np.where(joint, 0.45, 1.0))[..., None])


def fabric(rng: np.random.Generator) -> Floats:
    """A coarse weave with worn places."""
    row, column = _axes()
    weave = np.sin(2 * np.pi * 24 * row) * np.sin(2 * np.pi * 24 * column)
    return _grey(0.72 + 0.1 * weave + 0.18 * _clouds(rng, 1.2))


def checker(rng: np.random.Generator) -> Floats:
    """A chequered cloth."""
    row, column = _axes()
    square = ((row * 6).astype(int) + (column * 6).astype(int)) % 2
    return _mix(square * 1.0, (0.95, 0.92, 0.85), (0.75, 0.2, 0.18)) * (0.85 + 0.15 * _grey(_clouds(rng, 1.0)))


def rug(rng: np.random.Generator) -> Floats:
    """A rug: borders one within the other, and rosettes that are all different."""
    row, column = _axes()
    border = np.minimum(np.minimum(row, 1 - row), np.minimum(column, 1 - column))
    palette = rng.uniform(0.15, 0.9, (12, 3))
    image = palette[np.minimum((border * 24).astype(int), 11)]
    for centre_row, centre_column in rng.uniform(0.18, 0.82, (26, 2)):
        around = np.arctan2(row - centre_row, column - centre_column)
        petals = rng.uniform(0.03, 0.08) * (1 + 0.35 * np.cos(rng.integers(3, 9) * around))
        image[np.hypot(row - centre_row, column - centre_column) < petals] = rng.uniform(0.1, 0.95, 3)
    return np.asarray(image * (0.8 + 0.2 * _grey(_clouds(rng, 0.5))))


def picture(rng: np.random.Generator) -> Floats:
    """An abstract painting: a sky of noise, discs and slabs over it, a white mount round it."""
    row, column = _axes()
    first, second = rng.uniform(0.1, 0.95, (2, 3))
    image = _mix(np.clip(0.6 * row + 0.4 * _clouds(rng, 1.6), 0, 1), tuple(first), tuple(second))
    for _ in range(30):
        at_row, at_column, size = rng.uniform(0.05, 0.95), rng.uniform(0.05, 0.95), rng.uniform(0.03, 0.14)
        width, colour = size * rng.uniform(0.2, 1.5), rng.uniform(0.05, 0.95, 3)
        if rng.random() < 0.5:
            inside = np.hypot(row - at_row, column - at_column) < size
        else:
            inside = (np.abs(row - at_row) < size) & (np.abs(column - at_column) < width)
        image[inside] = colour
    mount = np.minimum(np.minimum(row, 1 - row), np.minimum(column, 1 - column)) < 0.07
    image[mount] = 0.93
    return image


def spine(rng: np.random.Generator) -> Floats:
    """The back of a book or the side of a box: a ground colour, bands, and a title of blocks."""
    row, column = _axes()
    image = np.broadcast_to(rng.uniform(0.1, 0.85, 3), (SIZE, SIZE, 3)).copy()
    for at in rng.uniform(0.04, 0.96, 3):
        image[np.abs(row - at) < rng.uniform(0.01, 0.03)] = rng.uniform(0.2, 1.0, 3)
    letters = np.repeat(rng.random(16) < 0.65, SIZE // 16)[:, None] & (np.abs(row - 0.5) < 0.33)
    image[letters & (np.abs(column - 0.5) < 0.2)] = rng.uniform(0.0, 1.0, 3)
    return np.asarray(image * (0.85 + 0.15 * _grey(_clouds(rng, 1.0))))


def text(rng: np.random.Generator) -> Floats:
    """A printed page or a screen: lines of words."""
    ink = np.kron(rng.random((32, 64)) < 0.7, np.ones((SIZE // 32, SIZE // 64)))
    row, column = _axes()
    ink *= (row * 32) % 1 < 0.55
    ink[(np.abs(row - 0.5) > 0.44) | (np.abs(column - 0.5) > 0.42)] = 0
    return _grey(0.95 - 0.75 * np.asarray(ink, float))


def sky(rng: np.random.Generator) -> Floats:
    """What a window shows."""
    return _mix(_clouds(rng, 1.8), (0.97, 0.98, 1.0), (0.55, 0.75, 0.98))


def make_textures(rng: np.random.Generator) -> Textures:
    """All textures by name, `picture0`, `picture1`, … and `spine0`, … among them."""
    makers: dict[str, Callable[[np.random.Generator], Floats]] = {
        maker.__name__: maker for maker in (plaster, plain, wood, boards, fabric, checker, rug, text, sky)
    }
    makers |= {f"picture{k}": picture for k in range(PICTURES)} | {f"spine{k}": spine for k in range(SPINES)}
    image = np.stack([np.clip(maker(rng), 0, 1) for maker in makers.values()])
    levels = []
    for _ in range(LEVELS):
        levels.append(image.reshape(-1, 3))
        half = image.shape[1] // 2
        image = image.reshape(len(makers), half, 2, half, 2, 3).mean(axis=(2, 4))
    offsets = np.cumsum([0, *(len(level) for level in levels[:-1])])
    return Textures(tuple(makers), np.concatenate(levels).astype(np.float32), offsets.astype(np.int64))

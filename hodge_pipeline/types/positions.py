"""Positions known from elsewhere, such as satellite fixes or surveyed points: east, north, up in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.types.arrays import Bools, Floats, Words

SEMI_MAJOR_M, FLATTENING = 6378137.0, 1 / 298.257223563
"""Of the ellipsoid WGS 84."""
FAR_M, WHOLE_M = 1e4, 1e3
"""Coordinates farther out, as a map has, lose digits in clouds of 32-bit numbers: whole kilometres are taken off."""


@dataclass(frozen=True)
class Positions:
    """Known positions in a world of metres, z up: `points (P, 3)`, `covariances (P, 3, 3)`, NaN where none is stated.

    Each belongs to the frame that `names (P,)` name, or is of the moment `stamps_s (P,)`; the other is empty, or NaN.
    `origin` says where the world's zero is.
    """

    points: Floats
    covariances: Floats
    names: Words
    stamps_s: Floats
    origin: str = "the zero of the given coordinates"

    def __len__(self) -> int:
        return len(self.points)

    @property
    def labels(self) -> Words:
        """What each is called in a message: its frame's name, else its stamp."""
        return np.where(self.names != "", self.names, [f"{stamp:.3f} s" for stamp in self.stamps_s])

    def near_zero(self) -> Positions:
        """The same with whole kilometres taken off where they lie far from zero, which `origin` then says."""
        off = whole_kilometres(self.points)
        if not off.any():
            return self
        origin = f"({', '.join(f'{value:.0f}' for value in off)}) of the given coordinates"
        return Positions(self.points - off, self.covariances, self.names, self.stamps_s, origin)


def whole_kilometres(points: Floats) -> Floats:
    """The whole kilometres (3,), in metres, nearest to the middle of points (P, 3) far from zero; else zeros."""
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    return np.asarray(WHOLE_M * np.round(middle / WHOLE_M) * bool(np.abs(middle).max() > FAR_M))


def from_geodetic(geodetic: Floats, covariances: Floats, names: Words, stamps_s: Floats) -> Positions:
    """Positions from latitude, longitude (degrees) and height (metres) above WGS 84 (P, 3): east, north, up of the
    plane that touches the ellipsoid below the first; covariances (P, 3, 3) are already of east, north, up.
    """
    first = geodetic[0]
    lat, lon = np.radians(first[:2])
    east_north_up = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0.0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    points = (earth_centred(geodetic) - earth_centred(first[None])) @ east_north_up.T
    origin = f"latitude {first[0]:.8f}°, longitude {first[1]:.8f}°, height {first[2]:.3f} m (WGS 84)"
    return Positions(points, covariances, names, stamps_s, origin)


def earth_centred(geodetic: Floats) -> Floats:
    """Earth-centred coordinates (P, 3), metres, of latitude, longitude (degrees) and height above WGS 84 (P, 3)."""
    lat, lon, height = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1]), geodetic[:, 2]
    squared = FLATTENING * (2 - FLATTENING)
    normal = SEMI_MAJOR_M / np.sqrt(1 - squared * np.sin(lat) ** 2)
    flat = (normal + height) * np.cos(lat)
    return np.stack([flat * np.cos(lon), flat * np.sin(lon), (normal * (1 - squared) + height) * np.sin(lat)], axis=1)


@dataclass(frozen=True)
class PositionFit:
    """How known positions (P,) fit the poses that were solved with them.

    `used (P,)`; `residuals (P, 3)`: known less found, metres; `distance (P,)`: from what all others say, in sigmas;
    NaN where nothing places the frame. `edge_factor`, `fix_factor`: what the sigma that edges and positions state
    was multiplied by, to fit how they scatter. `origin` as in `Positions`; `problems`: what was not placed, and why.
    """

    labels: Words
    points: Floats
    used: Bools
    residuals: Floats
    distance: Floats
    edge_factor: float
    fix_factor: float
    origin: str
    problems: tuple[str, ...] = ()

    @property
    def rejected(self) -> Bools:
        """Those (P,) that the others contradict."""
        return np.isfinite(self.distance) & ~self.used

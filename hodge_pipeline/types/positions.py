"""Positions known from elsewhere, such as satellite fixes or surveyed points: east, north, up in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.types.arrays import Bools, Floats, Words

SEMI_MAJOR_M, FLATTENING = 6378137.0, 1 / 298.257223563
"""Of the ellipsoid WGS 84."""
FAR_M, WHOLE_M = 1e4, 1e3
"""Metres from zero beyond which 32-bit clouds lose digits, as in map coordinates, and the unit that is subtracted."""


@dataclass(frozen=True)
class Positions:
    """Known positions in a world of metres, z up: `points (P, 3)`, `covariances (P, 3, 3)`, NaN where none is stated.

    Each belongs to the frame of a name in `names (P,)`, or to the time in `stamps_s (P,)`; the other is "" or NaN.
    `origin` says where the zero of the world is.
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
        """What messages call each (P,): its frame's name, else its stamp."""
        return np.where(self.names != "", self.names, [f"{stamp:.3f} s" for stamp in self.stamps_s])

    def near_zero(self) -> Positions:
        """The positions with whole kilometres subtracted where they lie far from zero, as `origin` then says."""
        off = whole_kilometres(self.points)
        if not off.any():
            return self
        origin = f"({', '.join(f'{value:.0f}' for value in off)}) of the given coordinates"
        return Positions(self.points - off, self.covariances, self.names, self.stamps_s, origin)


def whole_kilometres(points: Floats) -> Floats:
    """Whole kilometres (3,), in metres, nearest to the median of points (P, 3) far from zero; zeros of others."""
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    return np.asarray(WHOLE_M * np.round(middle / WHOLE_M) * bool(np.abs(middle).max() > FAR_M))


def from_geodetic(geodetic: Floats, covariances: Floats, names: Words, stamps_s: Floats) -> Positions:
    """East, north, up from latitude, longitude (degrees) and height (metres) above WGS 84, (P, 3).

    The zero is the first position; covariances (P, 3, 3) are of east, north, up already.
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

    - `used (P,)`; `residuals (P, 3)`: known less found, metres, NaN where nothing places the frame.
    - `distance (P,)`: in sigmas, from where all the others put it; NaN likewise.
    - `edge_factor`, `fix_factor`: by what the stated sigmas of edges and positions were multiplied to fit.
    - `origin` as in `Positions`; `problems`: what was not placed, and why.
    """

    labels: Words
    points: Floats
    used: Bools
    residuals: Floats
    distance: Floats
    edge_factor: float
    fix_factor: float
    origin: str
    problems: tuple[str, ...]

    @property
    def rejected(self) -> Bools:
        """Those (P,) that the others contradict."""
        return np.isfinite(self.distance) & ~self.used

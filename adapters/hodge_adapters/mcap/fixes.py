"""Satellite fixes of a recording: NavSatFix, and Foxglove's LocationFix."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hodge_adapters.mcap.fields import Message, number, numbers, part, whole
from hodge_adapters.mcap.records import Malformed
from hodge_adapters.text_rows import listed
from hodge_pipeline.types.positions import Positions, from_geodetic

NO_FIX = -1


@dataclass(frozen=True)
class Fix:
    """A fix: latitude, longitude (degrees), height (metres), and covariance by rows (east, north, up), if stated."""

    stamp_s: float
    geodetic: tuple[float, float, float]
    covariance: tuple[float, ...]


def fix_of(message: Message, stamp_s: float) -> Fix:
    """The fix of a message; raises `Malformed` where the receiver had none."""
    geodetic = (number(message, "latitude"), number(message, "longitude"), number(message, "altitude"))
    if whole(part(message, "status"), "status") == NO_FIX or not np.isfinite(geodetic).all():
        raise Malformed("no satellite fix")
    covariance = numbers(message, "position_covariance")
    is_stated = whole(message, "position_covariance_type") > 0 and len(covariance) == 9
    good = is_stated and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance.reshape(3, 3))[0] > 0
    return Fix(stamp_s, geodetic, tuple(covariance.tolist()) if good else ())


def positions_of(topics: Mapping[str, Sequence[Fix]], notes: list[str]) -> Positions | None:
    """The fixes of the topic that has most, None where there is none; what else there is in the notes."""
    if not topics:
        return None
    ranked = sorted(topics, key=lambda topic: (-len(topics[topic]), topic))
    fixes = topics[ranked[0]]
    others = f", not of {listed(ranked[1:])}" if len(ranked) > 1 else ""
    notes.append(
        f"{len(fixes)} satellite fixes of {ranked[0]}{others}: positions.path=source puts the result in their world"
    )
    covariances = [np.reshape(fix.covariance, (3, 3)) if fix.covariance else np.full((3, 3), np.nan) for fix in fixes]
    geodetic = np.array([fix.geodetic for fix in fixes], float)
    return from_geodetic(
        geodetic, np.array(covariances), np.full(len(fixes), ""), np.array([fix.stamp_s for fix in fixes], float)
    )

"""What the order of the vertices says about an edge before any geometry: nothing, unless the graph shows that it does.

Wrong edges join any two views; right ones join views that overlap, in a sequence mostly neighbours. So where near
pairs are joined more often than far ones, the excess is the share of right edges among them.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.types import Floats, Ints

FLOOR, CEILING = 0.05, 0.95
FAR_SHARE = 0.25
"""Pairs further apart than this share of the vertices tell how often any two views are joined."""


def order_prior(edges: Ints, vertex_count: int) -> Floats:
    """The probability (E,) that an edge is right, from its gap |i − j| alone: 1 − far rate / rate at its gap.

    All are equal where near pairs are joined no more often than far ones. Vertex rows are the order.
    """
    gap = np.abs(edges[:, 1] - edges[:, 0])
    bounds = _bounds(vertex_count)
    place = np.searchsorted(bounds, gap, side="right") - 1
    joined = np.bincount(np.maximum(place, 0), minlength=len(bounds) - 1)[: len(bounds) - 1]
    pairs = np.array([_pairs(low, high, vertex_count) for low, high in zip(bounds[:-1], bounds[1:], strict=True)])
    rate = np.minimum(joined / np.maximum(pairs, 1), 1.0)
    start = max(int(np.ceil(FAR_SHARE * vertex_count)), 2)
    far = (gap >= start).sum() / max(_pairs(start, vertex_count, vertex_count), 1)
    if rate[0] < 2 * far or not joined.any():
        return np.full(len(edges), 0.5)
    share = np.clip(1 - far / np.maximum(rate, 1e-12), FLOOR, CEILING)
    return np.asarray(share[np.maximum(place, 0)])


def _bounds(vertex_count: int) -> list[int]:
    bounds = [1, 2, 3, 5]
    while bounds[-1] < vertex_count:
        bounds.append(2 * bounds[-1] - 1)
    return bounds


def _pairs(low: int, high: int, count: int) -> int:
    """Pairs of vertices whose gap is in [low, high)."""
    high = min(high, count)
    return 0 if high <= low else (high - low) * count - (high * (high - 1) - low * (low - 1)) // 2

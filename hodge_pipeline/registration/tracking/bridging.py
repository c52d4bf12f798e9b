"""Breaks of tracking closed: key frames before a break are registered to those after it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.registration.odometry import OdometryOptions
from hodge_pipeline.registration.pairs import register_pairs
from hodge_pipeline.registration.seen_through import is_refuted, with_seen_through
from hodge_pipeline.stages import Workers
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints

REACH = 3
"""Key frames on either side of a break."""


def bridge(
    clouds: CloudSet,
    sequences: Sequence[Ints],
    steps: Edges,
    poses: Floats,
    options: OdometryOptions,
    workers: Workers,
    scale: float,
) -> tuple[Edges, Floats]:
    """The good steps and the bridges found, and the poses (K, 4, 4) of the K key frames with the bridges applied.

    A step with a fitness below `options.min_fitness` is a break; its bridge is the fittest registration between one of
    the three key frames before it and one of the three after it that free space does not refute; `scale` multiplies
    lengths that are for rooms.
    """
    good = steps.fitness >= options.min_fitness
    breaks = steps.pairs[~good]
    if not len(breaks):
        return steps, poses
    pairs = np.concatenate([_across(pair, rows) for rows in sequences for pair in breaks if np.isin(pair, rows).all()])
    pairs = np.unique(pairs, axis=0)
    guesses = se3.between(poses, pairs)
    found = register_pairs(clouds.folder, options.registration, Edges.of(pairs, "sequential"), guesses, workers)
    found = with_seen_through(found, clouds, scale)
    holds = (found.fitness >= options.min_fitness) & ~is_refuted(found, options.max_seen_through)
    bridges, moved = [], poses.copy()
    for i, j in breaks.tolist():
        over = np.flatnonzero((found.pairs[:, 0] <= i) & (found.pairs[:, 1] >= j) & holds)
        if len(over):
            best = over[np.argmax(found.fitness[over])]
            a, b = found.pairs[best]
            change = moved[a] @ found.i_from_j[best] @ se3.inverse(moved[b])
            rows = next(rows for rows in sequences if i in rows)
            behind = rows[rows >= j]
            moved[behind] = change @ moved[behind]
            bridges.append(best)
    chosen = found.select(np.unique(np.array(bridges, np.int64)))
    return Edges.joined([steps.select(good), chosen]), moved


def _across(pair: Ints, rows: Ints) -> Ints:
    place = int(np.searchsorted(rows, pair[0]))
    before, behind = rows[max(0, place - REACH + 1) : place + 1], rows[place + 1 : place + 1 + REACH]
    return np.stack(np.meshgrid(before, behind, indexing="ij"), axis=-1).reshape(-1, 2)

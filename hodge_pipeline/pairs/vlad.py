"""Which frames look alike: one global descriptor for each frame (VLAD, Jégou et al. 2010), compared by matrix products.

Local descriptors may be any unit vectors (n, D): RootSIFT of images, or histograms of clouds.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hodge_pipeline.pairs.candidates import NO_PAIRS, row_blocks
from hodge_pipeline.types import Floats32, Ints

SAMPLED_DESCRIPTORS, LLOYD_STEPS = 20_000, 12
"""Local descriptors of all frames, and steps of k-means, that a vocabulary is learnt by: limits on cost."""


class LocalFeatures(Protocol):
    """Local features of frames, by their rows."""

    def descriptors(self, row: int) -> Floats32:
        """Unit descriptors (n, D)."""


def vocabulary(features: LocalFeatures, rows: Ints, words: int, seed: int) -> Floats32:
    """Centres (at most `words`, D) of the frames' own descriptors, by k-means from a seeded sample."""
    rng = np.random.default_rng(seed)
    share = max(1, SAMPLED_DESCRIPTORS // max(1, len(rows)))
    every = (features.descriptors(int(row)) for row in rows)
    sample = [found[rng.permutation(len(found))[:share]] for found in every]
    points = np.concatenate(sample) if sample else np.zeros((0, 128), np.float32)
    centres = points[rng.permutation(len(points))[:words]]
    for _ in range(LLOYD_STEPS if len(points) else 0):
        chosen = _nearest(points, centres)
        sums, counts = _sums(points, chosen, len(centres))
        centres = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1.0)[:, None], centres)
    return centres


def _nearest(points: Floats32, centres: Floats32) -> Ints:
    """The nearest centre (n,) of each point (n, D)."""
    scores = points @ centres.T - 0.5 * (centres**2).sum(axis=1)
    return np.asarray(scores.argmax(axis=1), np.int64)


def _sums(points: Floats32, chosen: Ints, words: int) -> tuple[Floats32, Floats32]:
    """The sum (words, D) and the number (words,) of the points that chose each word."""
    member = (chosen[:, None] == np.arange(words)).astype(np.float32)
    return np.asarray(member.T @ points), member.sum(axis=0)


def global_descriptors(features: LocalFeatures, rows: Ints, centres: Floats32) -> Floats32:
    """Unit VLAD vectors (R, words · D); zero for a frame without features."""
    out = np.zeros((len(rows), centres.size), np.float32)
    for place, row in enumerate(rows):
        points = features.descriptors(int(row))
        if len(points):
            sums, counts = _sums(points, _nearest(points, centres), len(centres))
            residual = sums - counts[:, None] * centres
            norms = np.linalg.norm(residual, axis=1, keepdims=True)  # each word counts alike, however often it is seen
            flat = (residual / np.maximum(norms, 1e-12)).ravel()
            out[place] = flat / max(float(np.linalg.norm(flat)), 1e-12)
    return out


def most_similar(vectors: Floats32, per_row: int, excluded_reach: int) -> Ints:
    """Pairs (P, 2) of places a < b: for each frame the `per_row` most similar ones, at most one of every
    `excluded_reach` consecutive frames, so that they are spread over the sequence, and none that near.
    """
    count = len(vectors)
    window = max(1, excluded_reach)
    starts = np.arange(0, count, window)
    found = [NO_PAIRS]
    for rows in row_blocks(count):
        block = np.arange(rows.start, rows.stop)
        scores = vectors[block] @ vectors.T
        scores[np.abs(np.arange(count) - block[:, None]) <= excluded_reach] = -np.inf
        padded = np.full((len(block), len(starts) * window), -np.inf, np.float32)
        padded[:, :count] = scores
        in_windows = padded.reshape(len(block), len(starts), window)
        best, offset = in_windows.max(axis=2), in_windows.argmax(axis=2)
        chosen = np.argsort(-best, axis=1, kind="stable")[:, :per_row]
        partner = starts[chosen] + np.take_along_axis(offset, chosen, axis=1)
        usable = np.isfinite(np.take_along_axis(best, chosen, axis=1))
        found.append(np.stack([np.broadcast_to(block[:, None], partner.shape)[usable], partner[usable]], axis=1))
    return np.unique(np.sort(np.concatenate(found), axis=1), axis=0)

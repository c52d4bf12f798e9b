"""Which frames look alike: one global descriptor for each frame (VLAD), compared by one matrix product."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from hodge_pipeline.types import Bools, Floats32, Ints

SAMPLED_DESCRIPTORS = 20_000
LLOYD_STEPS = 12
BLOCK_ENTRIES = 4_000_000


class LocalFeatures(Protocol):
    """Local features of frames, by their rows."""

    def descriptors(self, row: int) -> Floats32:
        """Unit descriptors (n, D)."""


def vocabulary(features: LocalFeatures, rows: Ints, words: int, seed: int) -> Floats32:
    """Centres (at most `words`, D) of the frames' own descriptors, by k-means from a seeded sample."""
    rng = np.random.default_rng(seed)
    share = max(1, SAMPLED_DESCRIPTORS // max(1, len(rows)))
    sample = [_sampled(features.descriptors(int(row)), share, rng) for row in rows]
    points = np.concatenate(sample) if sample else np.zeros((0, 128), np.float32)
    centres = points[rng.permutation(len(points))[:words]]
    for _ in range(LLOYD_STEPS if len(points) else 0):
        chosen = _nearest(points, centres)
        sums, counts = _sums(points, chosen, len(centres))
        centres = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1.0)[:, None], centres)
    return centres


def _sampled(descriptors: Floats32, count: int, rng: np.random.Generator) -> Floats32:
    return descriptors[rng.permutation(len(descriptors))[:count]]


def _nearest(points: Floats32, centres: Floats32) -> Ints:
    scores = points @ centres.T - 0.5 * (centres**2).sum(axis=1)
    return np.asarray(scores.argmax(axis=1), np.int64)


def _sums(points: Floats32, chosen: Ints, words: int) -> tuple[Floats32, Floats32]:
    member = (chosen[:, None] == np.arange(words)).astype(np.float32)
    return np.asarray(member.T @ points), member.sum(axis=0)


def global_descriptors(features: LocalFeatures, rows: Ints, centres: Floats32) -> Floats32:
    """Unit VLAD vectors (R, words · D) (Jégou et al. 2010); zero for a frame without features."""
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
    found = [np.zeros((0, 2), np.int64)]
    step = max(1, BLOCK_ENTRIES // max(1, count))
    for first in range(0, count, step):
        block = np.arange(first, min(first + step, count))
        scores = vectors[block] @ vectors.T
        scores[_near(block, count, excluded_reach)] = -np.inf
        padded = np.full((len(block), len(starts) * window), -np.inf, np.float32)
        padded[:, :count] = scores
        in_windows = padded.reshape(len(block), len(starts), window)
        best, offset = in_windows.max(axis=2), in_windows.argmax(axis=2)
        chosen = np.argsort(-best, axis=1, kind="stable")[:, :per_row]
        partner = starts[chosen] + np.take_along_axis(offset, chosen, axis=1)
        usable = np.isfinite(np.take_along_axis(best, chosen, axis=1))
        found.append(np.stack([np.broadcast_to(block[:, None], partner.shape)[usable], partner[usable]], axis=1))
    return np.unique(np.sort(np.concatenate(found), axis=1), axis=0)


def _near(block: Ints, count: int, reach: int) -> Bools:
    return np.asarray(np.abs(np.arange(count)[None, :] - block[:, None]) <= reach)

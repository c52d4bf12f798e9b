"""Common to edge builders: which frames can have an edge, blocks of all pairs, and the union of several proposals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints

NO_PAIRS: Ints = np.zeros((0, 2), np.int64)
BLOCK_ENTRIES = 4_000_000
"""Bound on the entries of one block of a matrix of all pairs: about 50 MB where it is sparse, 16 MB of float32."""


def row_blocks(count: int) -> Iterator[slice]:
    """The rows of a (count, count) matrix in blocks of at most `BLOCK_ENTRIES` entries."""
    step = max(1, BLOCK_ENTRIES // max(1, count))
    return (slice(start, min(start + step, count)) for start in range(0, count, step))


def usable_rows(clouds: CloudSet, world_from_cam: Floats | None = None) -> Ints:
    """Rows of the frames that have points and, where poses (N, 4, 4) are given, a finite pose; ascending."""
    usable = clouds.sizes > 0
    if world_from_cam is not None:
        usable &= se3.has_pose(world_from_cam)
    return np.flatnonzero(usable).astype(np.int64)


def has_reason(candidates: Edges, reason: str) -> Bools:
    """Which pairs (P,) have this reason."""
    labels, which = np.unique(candidates.proposed_by, return_inverse=True)
    return np.array([reason in label.split("+") for label in labels], bool)[which]


def merge(proposals: Sequence[Edges]) -> tuple[Edges, Bools]:
    """The union of proposals, and (P, B) who proposed each pair.

    The reasons of a pair are joined by "+" in the order of the proposals; its overlap is the best that one gave.
    """
    proposed = np.concatenate([p.pairs for p in proposals])
    keys, row = np.unique(proposed[:, 0] << 32 | proposed[:, 1], return_inverse=True)
    pairs = np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1)
    rows = np.split(row, np.cumsum([len(p.pairs) for p in proposals])[:-1])
    votes = np.zeros((len(pairs), len(proposals)), bool)
    overlap = np.full(len(pairs), np.nan)
    for k, (proposal, own) in enumerate(zip(proposals, rows, strict=True)):
        votes[own, k] = True
        overlap[own] = np.fmax(overlap[own], proposal.overlap)
    return replace(Edges.of(pairs, _joined(proposals, rows, len(pairs))), overlap=overlap), votes


def _joined(proposals: Sequence[Edges], rows: Sequence[Ints], count: int) -> NDArray[np.str_]:
    # Of one proposal the longest label goes first: it shows the order of a nested builder's reasons.
    labels = [label for p in proposals for label in sorted(np.unique(p.proposed_by), key=len, reverse=True)]
    reasons = list(dict.fromkeys(reason for label in labels for reason in label.split("+")))
    given = np.zeros((count, len(reasons)), bool)
    for proposal, own in zip(proposals, rows, strict=True):
        for k, reason in enumerate(reasons):
            given[own, k] |= has_reason(proposal, reason)
    sets, which = np.unique(given @ (1 << np.arange(len(reasons))), return_inverse=True)
    names = ["+".join(reason for k, reason in enumerate(reasons) if mask >> k & 1) for mask in sets]
    return np.array(names, dtype=np.str_)[which]

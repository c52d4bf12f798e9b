"""What speaks for laying one set of views against another: edges that agree, edges that are missing, the order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.joining import Joining
from hodge_pipeline.types import Floats, Ints

WIDEN = 1.3
"""Poses are not settled while views are moved about: an edge agrees within this many times its noise."""
GATE = 60.0
NEAR_IN_ORDER = 0.99
"""Of consecutive views in a sequence that see the same place, and of all pairs: what such scenes have."""
NEAR_AT_ALL = 0.15


@dataclass(frozen=True)
class Scales:
    """What the evidence counts, in nats.

    - `agreeing`: an edge that agrees; far less than its χ² says, since places that look alike make wrong edges agree.
    - `alike`: the share of expected edges that agree when a place is taken for another that looks like it.
    - `step`: two consecutive views in one piece rather than in two; 0 where order says nothing.
    """

    agreeing: float
    alike: float
    step: float


STRICT, LENIENT = Scales(0.7, 0.5, 2.5), Scales(2.0, 0.3, 3.0)


@dataclass(frozen=True)
class Scene:
    """The evidence with a law of joining and its scales."""

    evidence: Evidence
    joining: Joining
    scales: Scales
    in_order: bool

    def agreement(self, poses: Floats, rows: Ints) -> Floats:
        """From 1 down to 0 (N,) how well these edges agree with the poses."""
        noise = self.evidence.noise
        i, j = self.evidence.edges[rows].T
        motion = se3.inverse(self.evidence.i_from_j[rows]) @ se3.inverse(poses[i]) @ poses[j]
        angle = np.linalg.norm(se3.so3_log(motion[:, :3, :3]), axis=1) / (WIDEN * noise.rotation_rad[rows])
        moved = np.linalg.norm(motion[:, :3, 3], axis=1) / (WIDEN * noise.translation_m[rows])
        return np.asarray(np.sqrt(np.maximum(0.0, 1 - (angle**2 + moved**2) / GATE)))

    def value(self, poses: Floats, first: Ints, second: Ints, rows: Ints) -> float:
        """Nats for these views being laid so, over being apart; `rows` are the edges between them."""
        share = self.joining.between(poses[first], poses[second])
        scales = self.scales
        missing = np.log((1 - share) / (1 - scales.alike * share))
        total = float(missing.sum())
        if self.in_order:
            step = np.abs(first[:, None] - second[None]) == 1
            total += float(self._steps(share[step]).sum())
        if len(rows):
            place = np.zeros(self.evidence.vertex_count, np.int64)
            place[first], place[second] = np.arange(len(first)), np.arange(len(second))
            inside = np.zeros(self.evidence.vertex_count, bool)
            inside[first] = True
            i, j = self.evidence.edges[rows].T
            swapped = ~inside[i]
            a, b = place[np.where(swapped, j, i)], place[np.where(swapped, i, j)]
            gain = np.log1p(share[a, b] * np.expm1(scales.agreeing)) - missing[a, b]
            total += float(self.agreement(poses, rows) @ gain)
        return total

    def _steps(self, share: Floats) -> Floats:
        near = NEAR_IN_ORDER * share / NEAR_AT_ALL + (1 - NEAR_IN_ORDER) * (1 - share) / (1 - NEAR_AT_ALL)
        return np.asarray(self.scales.step + np.log(near))

    def total(self, poses: Floats, piece: Ints) -> float:
        """Nats for the whole: every view against those before it in its piece."""
        edges, out = self.evidence.edges, 0.0
        last = np.maximum(edges[:, 0], edges[:, 1])
        order = np.argsort(last, kind="stable")
        bounds = np.searchsorted(last[order], np.arange(len(piece) + 1))
        for vertex in range(1, len(piece)):
            before = np.flatnonzero(piece[:vertex] == piece[vertex])
            if len(before):
                rows = order[bounds[vertex] : bounds[vertex + 1]]
                rows = rows[(piece[edges[rows, 0]] == piece[edges[rows, 1]]) & (edges[rows, 0] != edges[rows, 1])]
                out += self.value(poses, np.array([vertex]), before, rows)
        return out

"""Log-evidence for a relative placement of two sets of views: sums over the pairs that the cut between them separates.

A whole arrangement of views is worth what greedy merges of them are, the two sets whose placement has the largest
log-evidence first, each counted as one cut. So a hundred wrong edges that agree weigh little more than ten right ones,
as they do when a single set of views is moved. The log-evidence of each camera's orientation is added.

Edges that agree on one placement are one event, since places that look alike give many wrong edges that agree: they
count by the logarithm of their number. Evidence against a placement are pairs of views that it makes overlap and that
were tried but have no edge. Consecutive views of a sequence are near each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.judging import squares_at_both_ends
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.robust_poses import UNSETTLED
from hodge_pipeline.diagnosis.scene_model import SceneModel
from hodge_pipeline.types import Bools, Floats, Ints

PER_FOLD = 2.0
"""Nats for each e-fold of agreeing edges."""
FAIR_SHARE, SHARE_SPREAD = 0.75, 0.35
"""Of the edges expected under a placement, the share from which on it has evidence in its favour, and its spread."""
PER_EXPECTED_FOLD = 1.0
"""Nats for each e-fold of expected edges, at one spread from the usual share."""
ROUNDING = 1e-9
"""Of a trace."""
JUMP = 1e-4
"""Share of consecutive views that do not see the same place."""
SURE = 5.0
"""Nats, the most log-evidence of a single edge between consecutive views."""
UNSUPPORTED, SUPPORTED = 0.05, 0.3
"""Closing cycles over an edge: added to each count, and the count that leaves the odds unchanged."""


@dataclass(frozen=True)
class PlacementCriteria:
    """What moves of poses (V, 4, 4) are scored by.

    - `model`: the probability of edges by poses, and the distribution of up.
    - `usual`: the mean probability that views of one piece are joined, 0 where views have no order.
    - `proposed (2 E, 3, 3)`: the rotation of the world that makes each edge agree when its second end moves, and then
      that for its first end.
    """

    evidence: Evidence
    model: SceneModel
    poses: Floats
    usual: float
    proposed: Floats

    @classmethod
    def of(cls, evidence: Evidence, model: SceneModel, poses: Floats, piece: Ints) -> PlacementCriteria:
        """The criteria for moves of poses (V, 4, 4) in pieces (V,)."""
        same = piece[:, None] == piece[None]
        usual = float(model.joining.between(poses, poses)[same].mean()) if np.ptp(evidence.prior) > 0 else 0.0
        rotations, (i, j) = poses[:, :3, :3], evidence.graph.edges.T
        second = rotations[i] @ evidence.graph.i_from_j[:, :3, :3] @ np.swapaxes(rotations[j], 1, 2)
        return cls(evidence, model, poses, usual, np.concatenate([second, np.swapaxes(second, 1, 2)]))

    def log_evidence(self, sums: Floats) -> Floats:
        """Log-evidence for cuts with these sums (3, ...) of their layers."""
        agreeing, expected, order = sums
        share = np.clip((agreeing / np.maximum(expected, 1e-9) - FAIR_SHARE) / SHARE_SPREAD, -1, 1)
        return np.asarray(PER_FOLD * np.log1p(agreeing) + PER_EXPECTED_FOLD * share * np.log1p(expected) + order)

    def layers(self, motion: Floats) -> Floats:
        """For each ordered pair of views (3, V, V), the first where it is and the second moved by (4, 4): whether an
        edge agrees (from 1 down to 0), the probability that one would, and the log-evidence of their order.
        """
        moved = motion @ self.poses
        agreeing, expected = self._agreeing(motion, moved), self.model.joining.between(self.poses, moved)
        order = np.zeros_like(expected)
        if self.usual:
            rows = np.flatnonzero(np.abs(self.evidence.graph.edges[:, 1] - self.evidence.graph.edges[:, 0]) == 1)
            sure = np.zeros_like(expected)
            i, j = self.evidence.graph.edges[rows].T
            for pair in ((i, j), (j, i)):
                np.maximum.at(sure, pair, consecutive_log_evidence(self.evidence)[rows])
            order = sure * agreeing
            first = np.arange(len(moved) - 1)
            for pair in ((first, first + 1), (first + 1, first)):
                order[pair] += np.log(JUMP + (1 - JUMP) * expected[pair] / self.usual)
        return np.stack([agreeing, expected, order])

    def _agreeing(self, motion: Floats, moved: Floats) -> Floats:
        """From 1 down to 0 (V, V) how well the edge of each pair agrees, the first view still, the second moved."""
        edges, measured, noise = self.evidence.graph.edges, self.evidence.graph.i_from_j, self.evidence.noise
        widest = np.minimum(np.sqrt(UNSETTLED) * noise.rotation_rad, np.pi)
        alike = self.proposed.reshape(-1, 9) @ motion[:3, :3].ravel() > np.tile(1 + 2 * np.cos(widest), 2) - ROUNDING
        second, first = (np.flatnonzero(half) for half in np.split(alike, 2))
        row = np.concatenate([second, first])
        tails = np.concatenate([self.poses[edges[second, 0]], moved[edges[first, 0]]])
        heads = np.concatenate([moved[edges[second, 1]], self.poses[edges[first, 1]]])
        left = se3.log(se3.inverse(measured[row]) @ se3.inverse(tails) @ heads)
        turned, shifted = squares_at_both_ends(measured[row], left)
        chi2 = turned / noise.rotation_rad[row] ** 2 + shifted / noise.translation_m[row] ** 2
        out = np.zeros((len(moved), len(moved)))
        pairs = np.concatenate([edges[second], edges[first, ::-1]])
        np.maximum.at(out, tuple(pairs.T), np.sqrt(np.maximum(0.0, 1 - chi2 / UNSETTLED)))
        return out


def consecutive_log_evidence(evidence: Evidence) -> Floats:
    """Log-evidence of each edge (E,) if it joins consecutive views: by its prior odds, and by the cycles over it."""
    odds = evidence.prior / (1 - evidence.prior) * (evidence.support + UNSUPPORTED) / SUPPORTED
    return np.minimum(np.log1p(odds), SURE)


def sums_of(layers: Floats, inside: Bools) -> Floats:
    """The sums (3,) of layers over the pairs of a view outside and one inside."""
    return np.asarray(layers[:, ~inside][:, :, inside].sum((1, 2)))


def run_sums(layers: Floats) -> Floats:
    """The sums (3, V + 1, V + 1) over the pairs of a view outside and one inside of every run of consecutive views: its
    first is the row, the one after its last the column.
    """
    count = layers.shape[1]
    column, block = np.zeros((3, count + 1)), np.zeros((3, count + 1, count + 1))
    column[:, 1:] = layers.sum(1).cumsum(1)
    block[:, 1:, 1:] = layers.cumsum(1).cumsum(2)
    rest = column - block[:, range(count + 1), range(count + 1)]
    first = column + block[:, range(count + 1), range(count + 1)]
    return np.triu(rest[:, None] - first[:, :, None] + block + block.swapaxes(1, 2), 1)


def arrangement_log_evidence(evidence: Evidence, poses: Floats, piece: Ints, models: Sequence[SceneModel]) -> float:
    """Log-evidence for poses (V, 4, 4) in pieces (V,), the mean over several scene models."""
    criteria = [PlacementCriteria.of(evidence, model, poses, piece) for model in models]
    return sum(_log_evidence(each, poses, piece) for each in criteria) / len(models)


def _log_evidence(criteria: PlacementCriteria, poses: Floats, piece: Ints) -> float:
    rotations, upright = poses[:, :3, :3], criteria.model.upright
    upright_evidence = float(upright.log_evidence(rotations, upright.world_up(rotations, piece)).sum())
    together = piece[:, None] == piece[None]
    np.fill_diagonal(together, False)
    layers = criteria.layers(np.eye(4)) * together
    return upright_evidence + _merged(criteria, (layers + layers.swapaxes(1, 2)) / 2, together)


def _merged(criteria: PlacementCriteria, sums: Floats, possible: Bools) -> float:
    """Log-evidence summed over greedy merges, the strongest of the `possible (V, V)` ones first; `sums (3, V, V)` of
    the layers between any two sets are added up on the way.
    """
    count, total = sums.shape[1], 0.0
    value = np.where(possible, criteria.log_evidence(sums), -np.inf)
    for _ in range(count - 1):
        first, second = divmod(int(np.argmax(value)), count)
        if np.isneginf(value[first, second]):
            break
        total += float(value[first, second])
        sums[:, first] += sums[:, second]
        sums[:, :, first] += sums[:, :, second]
        value[second] = value[:, second] = -np.inf
        merged = criteria.log_evidence(sums[:, first])
        value[first] = value[:, first] = np.where(np.isneginf(value[first]), -np.inf, merged)
    return total

"""Log-evidence for the relative placement of two sets of views: a function of sums over the pairs that a cut separates.

The log-evidence of a whole arrangement is the sum over its views, each against all others. That of each camera's
upright orientation is added to either.

Edges that agree on one placement are one event, since places that look alike give many wrong edges that agree: they
count by the logarithm of their number. Where every pair was tried, a scene model adds evidence: pairs of views that
would overlap and have no edge are against a placement, consecutive views near each other for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import squares_at_both_ends
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import PER_FOLD
from hodge_pipeline.diagnosis.robust_poses import UNSETTLED, Solved
from hodge_pipeline.diagnosis.scene_model import SceneModel
from hodge_pipeline.types import Floats, Ints

FAIR_SHARE, SHARE_SPREAD = 0.75, 0.35
"""Share of the expected edges at which a placement has no evidence either way, and the deviation for full evidence."""
ROUNDING = 1e-9
"""Tolerance on the trace of a rotation."""
JUMP = 1e-4
"""Probability that consecutive views do not see the same place."""


def log_evidence(sums: Floats) -> Floats:
    """Log-evidence (...,) for cuts by the sums (3, ...) of their layers: see `Placements.layers`."""
    agreeing, expected, order = sums
    share = np.clip((agreeing / np.maximum(expected, 1e-9) - FAIR_SHARE) / SHARE_SPREAD, -1, 1)
    return np.asarray(PER_FOLD * np.log1p(agreeing) + share * np.log1p(expected) + order)


@dataclass(frozen=True)
class Placements:
    """Evidence for a solution, and for moving some of its views.

    - `model`: the probability of edges by poses, and the distribution of up, where every pair was tried; else None.
    - `pairs (P, 2)`: directed pairs of views, of which the second moves: all with a model, else those with an edge.
    - `row (2 E,)`: the pair of each edge whose second end moves, then of each whose first end moves.
    """

    evidence: Evidence
    found: Solved
    model: SceneModel | None
    pairs: Ints
    row: Ints

    @classmethod
    def of(cls, evidence: Evidence, found: Solved, model: SceneModel | None) -> Placements:
        """The placements of a solution."""
        count, edges = evidence.graph.vertex_count, evidence.graph.edges
        directed = np.concatenate([edges, edges[:, ::-1]])
        if model is None:
            return cls(evidence, found, None, directed, np.arange(len(directed)))
        pairs = np.indices((count, count)).reshape(2, -1).T
        return cls(evidence, found, model, pairs, directed @ [count, 1])

    @cached_property
    def current_layers(self) -> Floats:
        """The layers (3, P) of the solution, of pairs in one piece."""
        first, second = self.pairs.T
        together = (self.found.piece[first] == self.found.piece[second]) & (first != second)
        return np.asarray(self.layers(np.eye(4)[None])[0] * together)

    @cached_property
    def usual(self) -> float:
        """The mean probability that views of one piece are joined; 0 where views have no order."""
        if self.model is None or np.ptp(self.evidence.prior) == 0:
            return 0.0
        same = self.found.piece[:, None] == self.found.piece[None]
        return float(self.model.joining.between(self.found.poses, self.found.poses)[same].mean())

    @cached_property
    def proposed(self) -> Floats:
        """Rotations of the world (2 E, 9), flattened, that make each edge agree when its second end moves, then its
        first.
        """
        rotations, (i, j) = self.found.poses[:, :3, :3], self.evidence.graph.edges.T
        second = rotations[i] @ self.evidence.graph.i_from_j[:, :3, :3] @ np.swapaxes(rotations[j], 1, 2)
        return np.concatenate([second, np.swapaxes(second, 1, 2)]).reshape(-1, 9)

    def layers(self, motion: Floats) -> Floats:
        """The layers (K, 3, P) of all pairs for motions (K, 4, 4) of the second view: how well its edge agrees (0 to
        1), the probability of an edge there, and the log-evidence of consecutive views.
        """
        poses = self.found.poses
        moved = motion[:, None] @ poses
        agreeing = self._agreeing(motion, moved)
        expected, order = np.zeros_like(agreeing), np.zeros_like(agreeing)
        if self.model is not None:
            each = self.model.joining.between(poses, moved.reshape(-1, 4, 4))
            expected = each.reshape(len(poses), *moved.shape[:2]).swapaxes(0, 1).reshape(agreeing.shape)
        if self.usual:
            next_to = np.abs(self.pairs[:, 1] - self.pairs[:, 0]) == 1
            order = self.consecutive * agreeing
            order[:, next_to] += np.log(JUMP + (1 - JUMP) * expected[:, next_to] / self.usual)
        return np.stack([agreeing, expected, order], axis=1)

    @cached_property
    def consecutive(self) -> Floats:
        """The log-evidence (P,) of edges between consecutive views, by their weight; 0 for other pairs."""
        edges, out = self.evidence.graph.edges, np.zeros(len(self.pairs))
        rows = np.flatnonzero(np.abs(edges[:, 1] - edges[:, 0]) == 1)
        consecutive = np.log1p(self.evidence.weight[rows])
        np.maximum.at(out, self.row.reshape(2, -1)[:, rows].ravel(), np.tile(consecutive, 2))
        return out

    def _agreeing(self, motion: Floats, moved: Floats) -> Floats:
        """How well (K, P) the edge of each pair agrees, 0 to 1: the first view in place, the second `moved (K, V, 4,
        4)`.
        """
        edges, poses, noise = self.evidence.graph.edges, self.found.poses, self.evidence.noise
        widest = np.minimum(np.sqrt(UNSETTLED) * noise.rotation_rad, np.pi)
        turned_alike = motion[:, :3, :3].reshape(-1, 9) @ self.proposed.T
        trial, directed = np.nonzero(turned_alike > np.tile(1 + 2 * np.cos(widest), 2) - ROUNDING)
        is_first, row = np.divmod(directed, len(edges))
        still, going = np.where(is_first, edges[row].T[::-1], edges[row].T)
        tails, heads = poses[still], moved[trial, going]
        tails, heads = (np.where(is_first[:, None, None], *both) for both in ((heads, tails), (tails, heads)))
        measured = self.evidence.graph.i_from_j[row]
        left = se3.log(se3.inverse(measured) @ se3.inverse(tails) @ heads)
        turned, shifted = squares_at_both_ends(measured, left)
        chi2 = turned / noise.rotation_rad[row] ** 2 + shifted / noise.translation_m[row] ** 2
        out = np.zeros((len(motion), len(self.pairs)))
        np.maximum.at(out, (trial, self.row[directed]), np.sqrt(np.maximum(0.0, 1 - chi2 / UNSETTLED)))
        return out

    @cached_property
    def up(self) -> Floats:
        """The direction (V, 3) that is up where each camera is."""
        if self.model is None:
            return np.zeros((len(self.found.piece), 3))
        return self.model.upright.world_up(self.found.poses[:, :3, :3], self.found.piece)

    def held(self, rotations: Floats, up: Floats) -> Floats:
        """Upright log-evidence (V,) of camera rotations (V, 3, 3) where up is (V, 3); 0 without a model."""
        return self.model.upright.log_evidence(rotations, up) if self.model else np.zeros(len(rotations))


def arrangement_log_evidence(evidence: Evidence, found: Solved, model: SceneModel) -> float:
    """Log-evidence for a solution of a scene in which every pair was tried: of each view where all others are."""
    here, count = Placements.of(evidence, found, model), len(found.piece)
    of_views = log_evidence(here.current_layers.reshape(3, count, count).sum(axis=1))
    return float((of_views + here.held(found.poses[:, :3, :3], here.up)).sum())

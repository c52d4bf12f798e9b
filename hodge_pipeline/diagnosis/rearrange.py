"""The best of several arrangements of a scene in which every pair was tried.

Pieces that were merged greedily are never parted again, even where one wrong edge between consecutive views came
before many right ones. Here each edge that disagrees proposes a motion; edges that propose the same motion together
propose a new place for a run of consecutive views, or for a whole piece, until no move gains enough.

Growing pieces best first can take a place for another that looks like it, and from there no single move leads back. So
a second start uses only the edges between consecutive views, which are wrong more rarely. The pieces of both then grow
into one another wherever edges agree on it, since what keeps two pieces apart is no evidence on where they lie, and the
one with the larger log-evidence is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import Alignment, Proposals, align
from hodge_pipeline.diagnosis.placement import (
    PlacementCriteria,
    arrangement_log_evidence,
    consecutive_log_evidence,
    run_sums,
    sums_of,
)
from hodge_pipeline.diagnosis.robust_poses import ONCE, TWICE, Fit, fit
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.types import Bools, Floats

LARGEST = 150
"""Views: with more, all pairs of them would cost too much."""
ROUNDS = 10
TRIED = 60
"""Motions in each round."""
MOST_PROPOSALS = 1000
"""Edges that propose one, those likeliest by the order of the views."""
LEAST_GAIN = 2.0
"""Nats."""


@dataclass(frozen=True)
class _Move:
    """Views `inside (V,)` that are moved by `motion (4, 4)` into a piece, and the log-evidence that is gained."""

    gain: float
    inside: Bools
    motion: Floats
    piece: int

    def made(self, found: Fit) -> Alignment:
        """The alignment after the move."""
        poses, piece = found.poses.copy(), found.piece.copy()
        poses[self.inside], piece[self.inside] = self.motion @ poses[self.inside], self.piece
        return Alignment(piece, poses)


@dataclass(frozen=True)
class _Now:
    """A solution before a move: its layers (3, V, V), the log-evidence (V + 1, V + 1) of runs of views where they are,
    the direction of up (V, 3), and the log-evidence (V,) of each camera's orientation.
    """

    found: Fit
    layers: Floats
    runs: Floats
    up: Floats
    upright: Floats


def best_arrangement(evidence: Evidence, start: Fit) -> Fit:
    """The arrangement with the largest log-evidence, from `start` and, where it is informative, the order; `start`
    itself where there are too many views.
    """
    if not 2 < evidence.graph.vertex_count <= LARGEST:
        return start
    starts = [start]
    if np.ptp(evidence.prior) > 0:
        chain = evidence.select(np.flatnonzero(np.abs(evidence.graph.edges[:, 1] - evidence.graph.edges[:, 0]) == 1))
        starts.append(fit(evidence, fit(chain, align(chain), ONCE), TWICE))
    found = [fit(evidence, align(evidence, rearranged(evidence, begun)), ONCE) for begun in starts]
    models = [learn_scene_model(evidence, one) for one in found]
    values = [arrangement_log_evidence(evidence, one.poses, one.piece, models) for one in found]
    return found[int(np.argmax(values))]


def rearranged(evidence: Evidence, found: Fit) -> Fit:
    """The solution after the best move, after the best one then, and so on."""
    model = None
    for _ in range(ROUNDS):
        model = learn_scene_model(evidence, found, model)
        best = _best_move(PlacementCriteria.of(evidence, model, found.poses, found.piece), found)
        if best is None or best.gain <= LEAST_GAIN:
            break
        found = fit(evidence, best.made(found), ONCE)
    return found


def _best_move(criteria: PlacementCriteria, found: Fit) -> _Move | None:
    """Of all motions that are proposed the one that gains most with its best set of views; None where none is."""
    evidence, now = criteria.evidence, _before(criteria, found)
    i, j = evidence.graph.edges.T
    rows = np.flatnonzero((now.layers[0][i, j] == 0) & (i != j))
    sure = consecutive_log_evidence(evidence)
    rows = np.sort(rows[np.argsort(-sure[rows], kind="stable")[:MOST_PROPOSALS]])
    proposals = Proposals.of(evidence, found.poses, rows)
    in_order = (np.abs(j - i) == 1) & (criteria.usual > 0)
    urgent = 2.0 * np.log1p(np.asarray(proposals.alike.sum(axis=1)).ravel())
    urgent += np.where(in_order, sure, 0.0)[proposals.edge]
    moves: list[_Move] = []
    left = np.ones(len(proposals.mover), bool)
    while left.any() and len(moves) < TRIED:
        moves.append(_moved(criteria, now, proposals, proposals.next(left, urgent)))
    return max((move for move in moves if move.inside.any()), key=lambda move: move.gain, default=None)


def _before(criteria: PlacementCriteria, found: Fit) -> _Now:
    poses, piece, upright = found.poses, found.piece, criteria.model.upright
    together = (piece[:, None] == piece[None]) & ~np.eye(len(piece), dtype=bool)
    up = upright.world_up(poses[:, :3, :3], piece)
    layers = criteria.layers(np.eye(4)) * together
    held = upright.log_evidence(poses[:, :3, :3], up)
    return _Now(found, layers, criteria.log_evidence(run_sums(layers)), up, held)


def _moved(criteria: PlacementCriteria, now: _Now, proposals: Proposals, row: int) -> _Move:
    """The best run of views to move as one proposal has it, or their whole piece."""
    poses, piece = now.found.poses, now.found.piece
    home, movable = piece[proposals.stayer[row]], piece == piece[proposals.mover[row]]
    motion = proposals.mean_motion(*proposals.group(row), poses)
    moved = criteria.layers(motion) * ((piece == home)[:, None] & ~np.eye(len(piece), dtype=bool))
    then = np.where(movable[None, None], moved, now.layers)
    up = np.broadcast_to(now.up[proposals.stayer[row]], now.up.shape)
    held = criteria.model.upright.log_evidence(motion[:3, :3] @ poses[:, :3, :3], up) - now.upright
    sets = [movable & ~movable[proposals.stayer[row]]]
    if criteria.usual:
        sets.append(_best_run(criteria, now, then, held, movable))
    gains = [_gain(criteria, now.layers, then, held, inside) for inside in sets]
    best = int(np.argmax(gains))
    return _Move(gains[best], sets[best], motion, int(home))


def _gain(criteria: PlacementCriteria, now: Floats, then: Floats, held: Floats, inside: Bools) -> float:
    if not inside.any():
        return 0.0
    change = criteria.log_evidence(sums_of(then, inside)) - criteria.log_evidence(sums_of(now, inside))
    return float(change + held[inside].sum())


def _best_run(criteria: PlacementCriteria, now: _Now, then: Floats, held: Floats, movable: Bools) -> Bools:
    blocked = np.concatenate([[0], np.cumsum(~movable)])
    upright = np.concatenate([[0.0], np.cumsum(held)])
    possible = (blocked[:, None] == blocked) & np.triu(np.ones_like(now.runs, bool), 1)
    gain = criteria.log_evidence(run_sums(then)) - now.runs + upright - upright[:, None]
    low, high = divmod(int(np.argmax(np.where(possible, gain, -np.inf))), len(blocked))
    inside = np.zeros(len(movable), bool)
    inside[low:high] = possible[low, high]
    return inside

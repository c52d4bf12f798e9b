"""A solution improved by moving sets of views to where their log-evidence is larger, until no move gains enough.

Pieces that were merged greedily are never parted again, even where one wrong edge between consecutive views came
before many right ones. Here each edge that disagrees proposes a motion; edges that propose the same motion together
propose a new place for a set of views. The sets are runs of consecutive views, whole pieces, and those that grow
from the ends of the proposing edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.cuts import (
    PlacementCriteria,
    interval_sums,
    pair_log_evidence,
    placement_criteria,
    sums_of,
)
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.pieces import Alignment
from hodge_pipeline.diagnosis.proposals import Proposals, propose
from hodge_pipeline.diagnosis.robust_poses import ONCE, Fit, fit
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

ROUNDS = 10
TRIED = 60
"""Motions in each round."""
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
        poses, piece = found.poses.copy(), found.component.copy()
        poses[self.inside], piece[self.inside] = self.motion @ poses[self.inside], self.piece
        return Alignment(piece, poses)


@dataclass(frozen=True)
class _Now:
    """A solution before a move: its layers (3, V, V), the log-evidence of each run of views, the direction of up
    (V, 3), and the log-evidence (V,) of each camera's orientation.
    """

    found: Fit
    layers: Floats
    runs: Floats
    up: Floats
    upright: Floats


def rearranged(evidence: Evidence, graph: ViewGraph, start: Fit, fair_share: float) -> list[Fit]:
    """The solutions after each move, `start` first; `graph` has the recentred edges.

    See `PlacementCriteria` for `fair_share`.
    """
    found, model = [start], None
    for _ in range(ROUNDS):
        model = learn_scene_model(evidence, found[-1], model)
        criteria = placement_criteria(evidence, model, found[-1].poses, found[-1].component, fair_share)
        best = _best_move(criteria, found[-1], propose(criteria, found[-1]))
        if best is None or best.gain <= LEAST_GAIN:
            break
        found.append(fit(evidence, graph, best.made(found[-1]), ONCE))
    return found


def _best_move(criteria: PlacementCriteria, found: Fit, proposals: Proposals) -> _Move | None:
    """Of all motions that are proposed the one that gains most with its best set of views; None where none is."""
    now = _before(criteria, found)
    moves, left = [], np.ones(len(proposals.mover), bool)
    for _ in range(TRIED):
        if not left.any():
            break
        moves.append(_moved(criteria, now, proposals, proposals.next(left)))
    return max((move for move in moves if move.inside.any()), key=lambda move: move.gain, default=None)


def _before(criteria: PlacementCriteria, found: Fit) -> _Now:
    poses, piece, upright = found.poses, found.component, criteria.model.upright
    together = (piece[:, None] == piece[None]) & ~np.eye(len(piece), dtype=bool)
    layers = criteria.layers(poses, poses) * together
    up = upright.world_up(poses[:, :3, :3], piece)
    runs = criteria.log_evidence(interval_sums(layers)[2])
    return _Now(found, layers, runs, up, upright.log_evidence(poses[:, :3, :3], up))


def _moved(criteria: PlacementCriteria, now: _Now, proposals: Proposals, row: int) -> _Move:
    """The best set of views to move as one proposal has it."""
    poses, piece = now.found.poses, now.found.component
    home, movable = piece[proposals.stayer[row]], piece == piece[proposals.mover[row]]
    motion = proposals.mean_motion(row, poses)
    moved = criteria.layers(poses, motion @ poses) * ((piece == home)[:, None] & ~np.eye(len(piece), dtype=bool))
    then = np.where(movable[None, None], moved, now.layers)
    up = np.broadcast_to(now.up[proposals.stayer[row]], now.up.shape)
    held = criteria.model.upright.log_evidence(motion[:3, :3] @ poses[:, :3, :3], up) - now.upright
    sets = [
        _grown(
            pair_log_evidence(then) - pair_log_evidence(now.layers),
            held,
            movable,
            proposals.mover[proposals.alike[row] > 0],
        )
    ]
    if not movable[proposals.stayer[row]]:
        sets.append(movable)
    if criteria.usual:
        sets.append(_best_run(criteria, then, now.runs, held, movable))
    gains = [_gain(criteria, now.layers, then, held, inside) for inside in sets]
    best = int(np.argmax(gains))
    return _Move(gains[best], sets[best], motion, int(home))


def _gain(criteria: PlacementCriteria, now: Floats, then: Floats, held: Floats, inside: Bools) -> float:
    if not inside.any():
        return 0.0
    return float(
        criteria.log_evidence(sums_of(then, inside)) - criteria.log_evidence(sums_of(now, inside)) + held[inside].sum()
    )


def _best_run(criteria: PlacementCriteria, then: Floats, runs_now: Floats, held: Floats, movable: Bools) -> Bools:
    low, high, after = interval_sums(then)
    blocked = np.concatenate([[0], np.cumsum(~movable)])
    upright = np.concatenate([[0.0], np.cumsum(held)])
    gain = criteria.log_evidence(after) - runs_now + upright[high] - upright[low]
    gain = np.where(blocked[high] > blocked[low], -np.inf, gain)
    best, inside = int(np.argmax(gain)), np.zeros(len(movable), bool)
    if np.isfinite(gain[best]):
        inside[low[best] : high[best]] = True
    return inside


def _grown(gain: Floats, held: Floats, movable: Bools, seed: Ints) -> Bools:
    """The set that grows, and shrinks, one view at a time from the seed while the sum of gains (V, V) of single pairs
    and of gains (V,) of single views improves.
    """
    inside = np.zeros(len(movable), bool)
    inside[seed] = True
    inside &= movable
    enters, leaves = (~inside).astype(float) @ gain + held, gain @ inside.astype(float)
    for _ in range(2 * len(movable)):
        better = np.where(movable, np.where(inside, leaves - enters, enters - leaves), -np.inf)
        view = int(np.argmax(better))
        if better[view] <= 1e-9:
            break
        sign = -1 if inside[view] else 1
        inside[view] = not inside[view]
        enters -= sign * gain[view]
        leaves += sign * gain[:, view]
    return inside

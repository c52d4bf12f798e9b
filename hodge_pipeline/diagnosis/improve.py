"""An arrangement improved by single moves, each judged by what the whole is then worth.

A move that gains little by itself may make a whole of more worth, once the poses have settled. And a single right edge
may be all that joins two pieces, against a hundred wrong ones that agree on something else.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.diagnosis.cuts import scene_of
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.laws import Laws, learned
from hodge_pipeline.diagnosis.proposals import Proposals, propose
from hodge_pipeline.diagnosis.rearrange import Move, best_moves
from hodge_pipeline.diagnosis.robust_poses import ONCE, Fit, fit
from hodge_pipeline.diagnosis.worth import worth
from hodge_pipeline.types import Floats, ViewGraph

ROUNDS, MOVES, UNIONS = 8, 8, 4
LEAST_GAIN = 2.0
"""Nats."""
TILTED = -5.0
"""Nats of how cameras are held, below which a placement of a piece is not looked at."""


def improved(evidence: Evidence, graph: ViewGraph, found: Fit, fair_shares: tuple[float, ...]) -> Fit:
    """The solution after the moves that are worth it; `graph` has the recentred edges, for fair shares see `Scene`."""
    laws = shown = learned(evidence, found)
    value = worth(evidence, found.poses, found.component, [laws])
    for _ in range(ROUNDS):
        proposals = propose(scene_of(evidence, shown, found.poses, found.component), found)
        moves = [move for share in fair_shares for move in _distinct(evidence, found, shown, share, proposals)]
        moves += _unions(evidence, found, laws, value, proposals)
        after = [fit(evidence, graph, move.made(found), ONCE) for move in moves]
        values = [worth(evidence, one.poses, one.component, [laws]) for one in after]
        if not values or max(values) < value + LEAST_GAIN:
            break
        found, value = after[int(np.argmax(values))], max(values)
        shown = learned(evidence, found)
    return found


def _distinct(evidence: Evidence, found: Fit, laws: Laws, fair_share: float, proposals: Proposals) -> list[Move]:
    """The moves that gain most by themselves, one for each set of views and place."""
    moves: dict[tuple[bytes, int, bytes], Move] = {}
    scene = scene_of(evidence, laws, found.poses, found.component, fair_share)
    for move in best_moves(scene, found, proposals):
        place = np.round(move.motion).tobytes()
        moves.setdefault((move.inside.tobytes(), move.piece, place), move)
        if len(moves) == MOVES:
            break
    return list(moves.values())


def _unions(evidence: Evidence, found: Fit, laws: Laws, value: float, proposals: Proposals) -> list[Move]:
    """The moves of whole pieces onto others after which, with nothing settled yet, all is worth most."""
    poses, piece, upright = found.poses, found.component, laws.upright
    size, up = np.bincount(piece), upright.world_up(poses[:, :3, :3], piece)
    mover, stayer = piece[proposals.mover], piece[proposals.stayer]
    left = (size[mover] < size[stayer]) | ((size[mover] == size[stayer]) & (mover > stayer))
    moves = []
    while left.any():
        row = proposals.next(left)
        inside, motion = piece == mover[row], proposals.mean_motion(row, poses)
        if _tilt(laws, poses[inside, :3, :3], up[inside], motion, up[proposals.stayer[row]]) < TILTED:
            continue
        move = Move(0.0, inside, motion, int(stayer[row]))
        made = move.made(found)
        gain = worth(evidence, made.piece_from, made.piece, [laws]) - value
        if gain >= LEAST_GAIN:
            moves.append(Move(gain, inside, motion, move.piece))
    return sorted(moves, key=lambda move: -move.gain)[:UNIONS]


def _tilt(laws: Laws, rotations: Floats, up: Floats, motion: Floats, up_there: Floats) -> float:
    """What cameras (n, 3, 3) gain by being moved to where up (3,) may be another."""
    there = np.broadcast_to(up_there, up.shape)
    held = laws.upright.nats(motion[:3, :3] @ rotations, there) - laws.upright.nats(rotations, up)
    return float(held.sum())

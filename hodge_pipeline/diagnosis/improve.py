"""An arrangement improved by single moves, each judged by the log-evidence of the whole arrangement after it.

A move that gains little by itself may gain more once the poses have settled. And a single right edge may be all that
joins two pieces, against a hundred wrong ones that agree on another placement.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline.diagnosis.arrangement_evidence import arrangement_log_evidence
from hodge_pipeline.diagnosis.cuts import placement_criteria
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.proposals import Proposals, propose
from hodge_pipeline.diagnosis.rearrange import Move, best_moves
from hodge_pipeline.diagnosis.robust_poses import ONCE, Fit, fit
from hodge_pipeline.diagnosis.scene_model import SceneModel, learn_scene_model
from hodge_pipeline.types import Floats, ViewGraph

ROUNDS, MOVES, UNIONS = 8, 8, 4
LEAST_GAIN = 2.0
"""Nats."""
TILTED = -5.0
"""Nats: log-evidence of the cameras' orientations, below which a placement of a piece is not tried."""


def improved(evidence: Evidence, graph: ViewGraph, found: Fit, fair_shares: tuple[float, ...]) -> Fit:
    """The solution after all moves that raise the log-evidence by LEAST_GAIN.

    `graph` has the recentred edges; see `PlacementCriteria` for the fair shares.
    """
    model = shown = learn_scene_model(evidence, found)
    value = arrangement_log_evidence(evidence, found.poses, found.component, [model])
    for _ in range(ROUNDS):
        proposals = propose(placement_criteria(evidence, shown, found.poses, found.component), found)
        moves = [move for share in fair_shares for move in _distinct(evidence, found, shown, share, proposals)]
        moves += _unions(evidence, found, model, value, proposals)
        after = [fit(evidence, graph, move.made(found), ONCE) for move in moves]
        values = [arrangement_log_evidence(evidence, one.poses, one.component, [model]) for one in after]
        if not values or max(values) < value + LEAST_GAIN:
            break
        found, value = after[int(np.argmax(values))], max(values)
        shown = learn_scene_model(evidence, found)
    return found


def _distinct(evidence: Evidence, found: Fit, model: SceneModel, fair_share: float, proposals: Proposals) -> list[Move]:
    """The moves that gain most by themselves, one for each set of views and place."""
    moves: dict[tuple[bytes, int, bytes], Move] = {}
    criteria = placement_criteria(evidence, model, found.poses, found.component, fair_share)
    for move in best_moves(criteria, found, proposals):
        place = np.round(move.motion).tobytes()
        moves.setdefault((move.inside.tobytes(), move.piece, place), move)
        if len(moves) == MOVES:
            break
    return list(moves.values())


def _unions(evidence: Evidence, found: Fit, model: SceneModel, value: float, proposals: Proposals) -> list[Move]:
    """The moves of whole pieces onto others after which, before the poses settle, the log-evidence is largest."""
    poses, piece, upright = found.poses, found.component, model.upright
    size, up = np.bincount(piece), upright.world_up(poses[:, :3, :3], piece)
    mover, stayer = piece[proposals.mover], piece[proposals.stayer]
    left = (size[mover] < size[stayer]) | ((size[mover] == size[stayer]) & (mover > stayer))
    moves = []
    while left.any():
        row = proposals.next(left)
        inside, motion = piece == mover[row], proposals.mean_motion(row, poses)
        if _tilt(model, poses[inside, :3, :3], up[inside], motion, up[proposals.stayer[row]]) < TILTED:
            continue
        move = Move(0.0, inside, motion, int(stayer[row]))
        made = move.made(found)
        gain = arrangement_log_evidence(evidence, made.piece_from, made.piece, [model]) - value
        if gain >= LEAST_GAIN:
            moves.append(Move(gain, inside, motion, move.piece))
    return sorted(moves, key=lambda move: -move.gain)[:UNIONS]


def _tilt(model: SceneModel, rotations: Floats, up: Floats, motion: Floats, up_there: Floats) -> float:
    """The change in log-evidence of cameras (n, 3, 3) moved to a place whose up is `up_there (3,)`."""
    there = np.broadcast_to(up_there, up.shape)
    change = model.upright.log_evidence(motion[:3, :3] @ rotations, there) - model.upright.log_evidence(rotations, up)
    return float(change.sum())

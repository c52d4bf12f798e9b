"""The local search: sets of views move where edges that a solution leaves out outweigh the edges in use.

Pieces that were merged greedily are never parted again, even where one wrong edge came before many right ones. Each
edge that is left out proposes a motion of the world for its one end. Edges that propose the same motion are weighed
against the lightest set of used edges that separates their ends, a minimum cut (Ford and Fulkerson 1956): where the
log-evidence of the cut rises by it, the side of the cut moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import PER_FOLD, Alignment, agreement_of, mean_motions
from hodge_pipeline.diagnosis.placement import Placements, consecutive_log_evidence, log_evidence
from hodge_pipeline.diagnosis.robust_poses import ONCE, Fit, fit
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.types import Bools, Floats, Ints

LARGEST = 150
"""Views: with more, all pairs of them would cost too much."""
ROUNDS = 10
TRIED = 200
"""Motions in each round."""
MOST_PROPOSALS = 1000
"""Edges that propose one, those likeliest by the order of the views."""
LEAST_GAIN, LEAST_OF_FEW = 2.0, 0.7
"""Nats; and where not every pair was tried, so that few edges agree by chance: 2 edges against 1, 4 against 2."""
CUT_THROUGH = (3.0, 20.0)
"""Edges that a cut is expected to part: an edge more then counts PER_FOLD / (1 + these)."""
PULL = 2.0
"""Times as strong as its evidence does a pair that would agree pull its ends apart: a cut at which it is lost all the
same costs more than one that it had no part in.
"""
UNIT, HELD_NATS = 1000, 1e5
"""Of a nat, since flows are whole numbers; and what holds a view that may not move."""


@dataclass(frozen=True)
class Move:
    """Views `inside (V,)` that are moved by `motion (4, 4)` into a piece, and the log-evidence that is gained."""

    gain: float
    inside: Bools
    motion: Floats
    piece: int
    beside: Ints


def searched(evidence: Evidence, found: Fit) -> Fit:
    """The solution after the best moves, after the best ones then, and so on.

    Without a scene model, by which the cuts are weighed, the poses that moves lead to must make more edges agree, each
    counting 1 nat and −log of its probability of being wrong.
    """
    each = 1 - np.log1p(-evidence.prior)
    for _ in range(ROUNDS):
        model = learn_scene_model(evidence, found) if evidence.exhaustive else None
        moves = _moves(Placements.of(evidence, found, model))
        tried = fit(evidence, _made(found, moves), ONCE) if moves else found
        if tried is found or (model is None and each[tried.used].sum() <= each[found.used].sum()):
            break
        found = tried
    return found


def _made(found: Fit, moves: list[Move]) -> Alignment:
    """The alignment after the moves."""
    poses, piece = found.poses.copy(), found.piece.copy()
    for move in moves:
        poses[move.inside], piece[move.inside] = move.motion @ poses[move.inside], move.piece
    return Alignment(piece, poses)


def _moves(here: Placements) -> list[Move]:
    """Of all motions that are proposed those that gain, the best first, unless they have to do with views that move."""
    evidence = here.evidence
    edges, agreeing = evidence.graph.edges, here.now[0][here.row[: evidence.graph.edge_count]]
    i, j = edges.T
    rows = np.flatnonzero((agreeing == 0) & (i != j))
    sure = consecutive_log_evidence(evidence)
    rows = np.sort(rows[np.argsort(-sure[rows], kind="stable")[:MOST_PROPOSALS]])
    proposals = Proposals.of(evidence, here.found.poses, rows)
    in_order = (np.abs(j - i) == 1) & (here.usual > 0)
    urgent = PER_FOLD * np.log1p(np.asarray(proposals.alike.sum(axis=1)).ravel())
    urgent += np.where(in_order, sure, 0.0)[proposals.edge]
    turned = proposals.motion[:, :3, :3] @ here.found.poses[proposals.mover, :3, :3]
    urgent += here.held(turned, here.up[proposals.stayer])
    left = np.ones(len(proposals.mover), bool)
    moves: list[Move] = []
    while left.any() and len(moves) < TRIED:
        moves.append(_best_cut(here, proposals, proposals.next(left, urgent)))
    least = LEAST_GAIN if evidence.exhaustive else LEAST_OF_FEW
    better = sorted((move for move in moves if move.gain > least), key=lambda move: -move.gain)
    return _apart(better, len(here.found.piece))


def _apart(moves: list[Move], count: int) -> list[Move]:
    """Of the moves those no view of which, nor any that they lie beside, moves for a better one."""
    moved, stays, chosen = np.zeros(count, bool), np.zeros(count, bool), []
    for move in moves:
        if not ((moved | stays) & move.inside).any() and not moved[move.beside].any():
            moved |= move.inside
            stays[move.beside] = True
            chosen.append(move)
    return chosen


def _best_cut(here: Placements, proposals: Proposals, row: int) -> Move:
    """The best set of views to move as one proposal and those that agree with it have it."""
    poses, piece = here.found.poses, here.found.piece
    stayer = proposals.stayer[row]
    home, movable = piece[stayer], piece == piece[proposals.mover[row]]
    motion = proposals.mean_motion(*proposals.group(row), poses)
    then = here.layers(motion) * (piece[here.pairs[:, 0]] == home)
    rotations = poses[:, :3, :3]
    up = np.broadcast_to(here.up[stayer], here.up.shape)
    held = here.held(motion[:3, :3] @ rotations, up) - here.held(rotations, here.up)
    sets = [_cut(here, then, held, movable, through) for through in CUT_THROUGH]
    if home != piece[proposals.mover[row]]:
        sets.append(movable)
    gains = [_gain(here, then, held, inside) for inside in sets]
    best = int(np.argmax(gains))
    return Move(gains[best], sets[best], motion, int(home), proposals.stayer[proposals.group(row)[0]])


def _gain(here: Placements, then: Floats, held: Floats, inside: Bools) -> float:
    """What is gained by moving these views (V,), where the layers (3, P) of all pairs would then be these."""
    if not inside.any():
        return 0.0
    cut = ~inside[here.pairs[:, 0]] & inside[here.pairs[:, 1]]
    change = log_evidence(then[:, cut].sum(axis=1)) - log_evidence(here.now[:, cut].sum(axis=1))
    return float(change + held[inside].sum())


def _cut(here: Placements, then: Floats, held: Floats, movable: Bools, through: float) -> Bools:
    """The views (V,) beyond the lightest cut: of pairs that it parts it costs what they lose by the motion, and of
    views that move with it what they are held worse, `held (V,)`.
    """
    count, (tail, head) = len(movable), here.pairs.T
    change = then - here.now
    lost = np.where(movable[head], -PER_FOLD / (1 + through) * change[0] - change[2], 0.0)
    won, parted = PULL * np.maximum(-lost, 0.0), np.flatnonzero(lost > 0)
    stays = np.bincount(tail, won, count) + np.where(movable, np.maximum(-held, 0.0), HELD_NATS)
    moves = np.bincount(head, won, count) + np.where(movable, np.maximum(held, 0.0), 0.0)
    source, sink, every = np.full(count, count), np.full(count, count + 1), np.arange(count)
    ends = np.concatenate([tail[parted], source, every]), np.concatenate([head[parted], every, sink])
    weight = np.ceil(UNIT * np.concatenate([lost[parted], stays, moves])).astype(np.int32)
    capacity = csr_matrix((weight, ends), shape=(count + 2, count + 2))
    left = capacity - maximum_flow(capacity, int(source[0]), int(sink[0])).flow
    left.eliminate_zeros()
    inside = np.ones(count + 2, bool)
    inside[breadth_first_order(left, int(source[0]), return_predecessors=False)] = False
    return np.asarray(inside[:count] & movable)


SIGMAS_APART = 12.0
"""Motions are compared where they turn alike but for so many standard deviations."""


@dataclass(frozen=True)
class Proposals:
    """Edges left out, each in both directions: view `mover (P,)` should move by `motion (P, 4, 4)` of the world,
    `stayer (P,)` not; `alike (P, P)` from 1 down to 0 how well the second agrees with the motion of the first.
    """

    edge: Ints
    mover: Ints
    stayer: Ints
    motion: Floats
    alike: csr_matrix

    @classmethod
    def of(cls, evidence: Evidence, poses: Floats, rows: Ints) -> Proposals:
        """Those of these edges (rows) at poses (V, 4, 4)."""
        i, j = evidence.graph.edges[rows].T
        motion = poses[i] @ evidence.graph.i_from_j[rows] @ se3.inverse(poses[j])
        motion = np.concatenate([motion, se3.inverse(motion)])
        edge, mover, stayer = np.tile(rows, 2), np.concatenate([j, i]), np.concatenate([i, j])
        first, second = _near_in_angle(evidence, edge, motion)
        alike = agreement_of(evidence, edge, motion, poses[mover, :3, 3], first, second)
        matrix = csr_matrix((alike, (first, second)), shape=(len(edge), len(edge)))
        matrix.eliminate_zeros()
        return cls(edge, mover, stayer, motion, matrix)

    def group(self, row: int) -> tuple[Ints, Floats]:
        """The proposals that agree with one, and how well."""
        entry = slice(self.alike.indptr[row], self.alike.indptr[row + 1])
        return self.alike.indices[entry].astype(np.int64), self.alike.data[entry]

    def next(self, left: Bools, urgent: Floats) -> int:
        """The most urgent (P,) of those left (P,), from which it and all that propose the same are then gone."""
        row = int(np.argmax(np.where(left, urgent, -np.inf)))
        group, alike = self.group(row)
        left[group[alike > 0.5]] = False
        left[row] = False
        return row

    def mean_motion(self, group: Ints, share: Floats, poses: Floats) -> Floats:
        """The mean (4, 4) of the motions of a group, each counting its share."""
        one = np.zeros(len(group), np.int64)
        return np.asarray(mean_motions(one, self.motion[group], poses[self.mover[group], :3, 3], share, 1)[0])


def _near_in_angle(evidence: Evidence, edge: Ints, motion: Floats) -> tuple[Ints, Ints]:
    """Pairs of motions whose rotations may agree."""
    quat = se3.to_quat_xyzw(motion).astype(np.float32)
    likeness = np.abs(quat @ quat.T)
    widest = min(SIGMAS_APART * float(evidence.noise.rotation_rad[edge].max(initial=0.0)), np.pi)
    first, second = np.nonzero(likeness >= np.cos(widest / 2))
    return first, second

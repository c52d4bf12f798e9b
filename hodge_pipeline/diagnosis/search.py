"""The local search: sets of views move where edges that a solution leaves out outweigh the edges in use.

Greedy merging never parts pieces again, even where one wrong edge came before many right ones. Each edge that is left
out proposes a motion of the world for one of its ends. Edges that propose the same motion are weighed against the
lightest set of used edges that separates their ends, a minimum cut (Ford and Fulkerson 1956): where the motion raises
the log-evidence of the cut, that side of it moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.cycles import CLOSES_BELOW
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import PER_FOLD, Alignment, agreement_of, mean_motions
from hodge_pipeline.diagnosis.placement import Placements, log_evidence
from hodge_pipeline.diagnosis.robust_poses import ONCE, Solved, fit
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS
from hodge_pipeline.types import Bools, Floats, Ints

LARGEST = 150
"""Most views that are searched with all their pairs: a limit on cost."""
TRIED, TOGETHER = 200, 50_000
"""Motions tried in each round; and pairs of views over all motions of a batch, up to which the overhead of a call
dominates.
"""
MOST_PROPOSALS = 1000
"""Edges that propose a motion, those of most weight: a limit on cost."""
LEAST_GAIN, LEAST_OF_FEW = 2.0, 0.7
"""Least gain of a move, nats; and where not every pair was tried, so that few edges agree by chance: 2 edges against 1,
4 against 2."""
CUT_THROUGH = (3.0, 20.0)
"""Expected numbers of edges in a cut: linearised there, each edge costs PER_FOLD / (1 + number)."""
PULL = 2.0
"""Factor on the evidence of a pair that would agree after the motion, for its ends to be on different sides of the cut.
"""
UNIT, PINNED_NATS = 1000, 1e5
"""Flow units per nat, since flows are whole numbers; and the capacity that keeps a view from moving."""


@dataclass(frozen=True)
class Move:
    """The views `inside (V,)` that move as a trial proposes, and the log-evidence gained."""

    gain: float
    inside: Bools
    trial: Trial


def searched(evidence: Evidence, found: Solved) -> Solved:
    """The solution after rounds of the best moves, until none gains.

    Without a scene model, a round must also raise the number of used edges, each weighted by 1 − log(1 − prior).
    """
    each = 1 - np.log1p(-evidence.prior)
    for _ in range(MOST_ROUNDS):
        model = learn_scene_model(evidence, found) if evidence.exhaustive else None
        moves = _moves(Placements.of(evidence, found, model))
        tried = fit(evidence, _applied(found, moves), ONCE) if moves else found
        if tried is found or (model is None and each[tried.used].sum() <= each[found.used].sum()):
            break
        found = tried
    return found


def _applied(found: Solved, moves: list[Move]) -> Alignment:
    """The alignment after the moves."""
    poses, piece = found.poses.copy(), found.piece.copy()
    for move in moves:
        poses[move.inside] = move.trial.motion @ poses[move.inside]
        piece[move.inside] = move.trial.piece
    return Alignment(piece, poses)


def _moves(here: Placements) -> list[Move]:
    """The moves that gain and do not involve views of better moves, the best first."""
    evidence = here.evidence
    edges, agreeing = evidence.graph.edges, here.current_layers[0][here.row[: evidence.graph.edge_count]]
    i, j = edges.T
    rows = np.flatnonzero((agreeing == 0) & (i != j))
    rows = np.sort(rows[np.argsort(-evidence.weight[rows], kind="stable")[:MOST_PROPOSALS]])
    proposals = Proposals.of(evidence, here.found.poses, rows)
    priority = PER_FOLD * np.log1p(np.asarray(proposals.alike.sum(axis=1)).ravel())
    turned = proposals.motion[:, :3, :3] @ here.found.poses[proposals.mover, :3, :3]
    priority += here.held(turned, here.up[proposals.stayer])
    tried = proposals.by_priority(priority, TRIED)
    moves: list[Move] = []
    together = max(TOGETHER // max(len(here.pairs), 1), 1)
    for first in range(0, len(tried), together):
        trials = Trial.of(here, proposals, tried[first : first + together])
        moves += [_best_move(here, *each) for each in zip(trials, _cuts(here, trials), strict=True)]
    least = LEAST_GAIN if evidence.exhaustive else LEAST_OF_FEW
    better = sorted((move for move in moves if move.gain > least), key=lambda move: -move.gain)
    return _independent(better, len(here.found.piece))


def _independent(moves: list[Move], count: int) -> list[Move]:
    """The moves (best first) whose views, and the views beside them, no better move involves."""
    moved, stays, chosen = np.zeros(count, bool), np.zeros(count, bool), []
    for move in moves:
        if not ((moved | stays) & move.inside).any() and not moved[move.trial.beside].any():
            moved |= move.inside
            stays[move.trial.beside] = True
            chosen.append(move)
    return chosen


@dataclass(frozen=True)
class Trial:
    """A motion (4, 4) of the world that a group of edges proposes for the views `movable (V,)`, into a piece.

    - `layers (3, P)`: of all pairs after the motion of the second view; `held (V,)`: the gain in upright log-evidence.
    - `beside`: views that the edges join them to.
    """

    motion: Floats
    piece: int
    movable: Bools
    layers: Floats
    held: Floats
    beside: Ints

    @classmethod
    def of(cls, here: Placements, proposals: Proposals, rows: list[int]) -> list[Trial]:
        """The trial of each of these proposals (rows), with the proposals that agree with it."""
        piece, rotations = here.found.piece, here.found.poses[:, :3, :3]
        motions = proposals.mean_motions(rows, here.found.poses)
        out = []
        for row, motion, layers in zip(rows, motions, here.layers(motions), strict=True):
            stayer, moving = proposals.stayer[row], piece[proposals.mover[row]]
            home, beside = piece[stayer], proposals.stayer[proposals.group(row)[0]]
            up = np.broadcast_to(here.up[stayer], here.up.shape)
            held = here.held(motion[:3, :3] @ rotations, up) - here.held(rotations, here.up)
            layers = layers * (piece[here.pairs[:, 0]] == home)
            out.append(cls(motion, int(home), piece == moving, layers, held, beside))
        return out


def _best_move(here: Placements, trial: Trial, sets: Bools) -> Move:
    """The best of these sets (C, V) of views to move."""
    gains = [_gain(here, trial, inside) for inside in sets]
    best = int(np.argmax(gains))
    return Move(gains[best], sets[best], trial)


def _gain(here: Placements, trial: Trial, inside: Bools) -> float:
    """The log-evidence gained by moving the views `inside (V,)`."""
    if not inside.any():
        return 0.0
    cut = ~inside[here.pairs[:, 0]] & inside[here.pairs[:, 1]]
    change = log_evidence(trial.layers[:, cut].sum(axis=1)) - log_evidence(here.current_layers[:, cut].sum(axis=1))
    return float(change + trial.held[inside].sum())


def _cuts(here: Placements, trials: list[Trial]) -> Bools:
    """The views (K, C, V) on the moving side of the minimum cut, for each trial and each of `CUT_THROUGH`. Its
    capacities are the evidence that pairs lose by the motion, and the upright log-evidence that views lose.

    All are cut in one network with one source and one sink, as the overhead of a call is ten times the flow's.
    """
    count, (tail, head) = len(here.found.piece), here.pairs.T
    shape = len(trials), len(CUT_THROUGH), count
    source, every = len(trials) * len(CUT_THROUGH) * count, np.arange(count)
    tails, heads, weights = [], [], []
    for first, (trial, through) in zip(range(0, source, count), product(trials, CUT_THROUGH), strict=True):
        change, movable, held = trial.layers - here.current_layers, trial.movable, trial.held
        lost = np.where(movable[head], -PER_FOLD / (1 + through) * change[0] - change[2], 0.0)
        won, parted = PULL * np.maximum(-lost, 0.0), np.flatnonzero(lost > 0)
        stays = np.bincount(tail, won, count) + np.where(movable, np.maximum(-held, 0.0), PINNED_NATS)
        moves = np.bincount(head, won, count) + np.where(movable, np.maximum(held, 0.0), 0.0)
        tails += [first + tail[parted], np.full(count, source), first + every]
        heads += [first + head[parted], first + every, np.full(count, source + 1)]
        weights += [lost[parted], stays, moves]
    weight = np.ceil(UNIT * np.concatenate(weights)).astype(np.int32)
    ends = np.concatenate(tails), np.concatenate(heads)
    capacity = csr_matrix((weight, ends), shape=(source + 2, source + 2))
    left = capacity - maximum_flow(capacity, source, source + 1).flow
    left.eliminate_zeros()
    inside = np.ones(source + 2, bool)
    inside[breadth_first_order(left, source, return_predecessors=False)] = False
    return np.asarray(inside[:source].reshape(shape) & np.stack([trial.movable for trial in trials])[:, None])


@dataclass(frozen=True)
class Proposals:
    """Edges left out, each in both directions: view `mover (P,)` should move by `motion (P, 4, 4)` of the world, view
    `stayer (P,)` not; `alike (P, P)`: how well two proposals agree, 0 to 1.
    """

    edge: Ints
    mover: Ints
    stayer: Ints
    motion: Floats
    alike: csr_matrix

    @classmethod
    def of(cls, evidence: Evidence, poses: Floats, rows: Ints) -> Proposals:
        """The proposals of these edges (rows) at poses (V, 4, 4)."""
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

    def by_priority(self, priority: Floats, most: int) -> list[int]:
        """Up to `most` proposals by descending `priority (P,)`, none that agrees with one before it."""
        left, out = np.ones(len(priority), bool), list[int]()
        while left.any() and len(out) < most:
            out.append(row := int(np.argmax(np.where(left, priority, -np.inf))))
            group, alike = self.group(row)
            left[group[alike > 0.5]] = False
            left[row] = False
        return out

    def mean_motions(self, rows: list[int], poses: Floats) -> Floats:
        """The mean motions (K, 4, 4) of the groups of these proposals, weighted by agreement."""
        groups, shares = zip(*map(self.group, rows), strict=True)
        which, group = np.repeat(np.arange(len(rows)), list(map(len, groups))), np.concatenate(groups)
        points = poses[self.mover[group], :3, 3]
        return np.asarray(mean_motions(which, self.motion[group], points, np.concatenate(shares), len(rows)))


def _near_in_angle(evidence: Evidence, edge: Ints, motion: Floats) -> tuple[Ints, Ints]:
    """Pairs of proposals (rows) whose rotations are within the largest gate of any edge."""
    quat = se3.to_quat_xyzw(motion).astype(np.float32)
    likeness = np.abs(quat @ quat.T)
    widest = min(np.sqrt(2 * CLOSES_BELOW) * float(evidence.noise.rotation_rad[edge].max(initial=0.0)), np.pi)
    first, second = np.nonzero(likeness >= np.cos(widest / 2))
    return first, second

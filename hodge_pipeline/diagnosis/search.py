"""The local search: sets of views move where edges that a solution leaves out outweigh the edges in use.

Pieces that were merged greedily are never parted again, even where one wrong edge came before many right ones. Each
edge that is left out proposes a motion of the world for its one end. Edges that propose the same motion are weighed
against the lightest set of used edges that separates their ends, a minimum cut (Ford and Fulkerson 1956): where the
log-evidence of the cut rises by it, the side of the cut moves.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import PER_FOLD, Alignment, agreement_of, mean_motions
from hodge_pipeline.diagnosis.placement import Placements, consecutive_log_evidence, log_evidence
from hodge_pipeline.diagnosis.robust_poses import ONCE, Solved, fit
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.types import Bools, Floats, Ints

LARGEST = 150
"""Views: with more, all pairs of them would cost too much."""
ROUNDS = 10
"""Of moves: a limit on cost."""
TRIED, TOGETHER = 200, 50_000
"""Motions in each round; and pairs of views, of all motions that are weighed at once, up to which calls cost more than
what they do.
"""
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


def searched(evidence: Evidence, found: Solved) -> Solved:
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


def _made(found: Solved, moves: list[Move]) -> Alignment:
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
    tried = proposals.most_urgent(urgent, TRIED)
    moves: list[Move] = []
    together = max(TOGETHER // max(len(here.pairs), 1), 1)
    for first in range(0, len(tried), together):
        moves += _best_moves(here, Trial.of(here, proposals, tried[first : first + together]))
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


@dataclass(frozen=True)
class Trial:
    """A motion (4, 4) of the world that a group of edges proposes for the views `movable (V,)`, into a piece.

    `then (3, P)`: the layers of all pairs whose second view has it; `held (V,)`: by how many nats views are held
    better; `is_apart`: whether these are in another piece; `beside`: views that the edges join them to.
    """

    motion: Floats
    piece: int
    movable: Bools
    is_apart: bool
    then: Floats
    held: Floats
    beside: Ints

    @classmethod
    def of(cls, here: Placements, proposals: Proposals, rows: list[int]) -> list[Trial]:
        """What each of these proposals, and those that agree with it, ask for."""
        piece, rotations = here.found.piece, here.found.poses[:, :3, :3]
        motions = proposals.mean_motions(rows, here.found.poses)
        out = []
        for row, motion, then in zip(rows, motions, here.layers(motions), strict=True):
            stayer, moving = proposals.stayer[row], piece[proposals.mover[row]]
            home, beside = piece[stayer], proposals.stayer[proposals.group(row)[0]]
            up = np.broadcast_to(here.up[stayer], here.up.shape)
            held = here.held(motion[:3, :3] @ rotations, up) - here.held(rotations, here.up)
            then = then * (piece[here.pairs[:, 0]] == home)
            out.append(cls(motion, int(home), piece == moving, bool(home != moving), then, held, beside))
        return out


def _best_moves(here: Placements, trials: list[Trial]) -> list[Move]:
    """The best set of views to move for each trial."""
    out = []
    for trial, sets in zip(trials, _cuts(here, trials), strict=True):
        if trial.is_apart:
            sets = np.concatenate([sets, trial.movable[None]])
        gains = [_gain(here, trial, inside) for inside in sets]
        best = int(np.argmax(gains))
        out.append(Move(gains[best], sets[best], trial.motion, trial.piece, trial.beside))
    return out


def _gain(here: Placements, trial: Trial, inside: Bools) -> float:
    """What is gained by moving these views (V,)."""
    if not inside.any():
        return 0.0
    cut = ~inside[here.pairs[:, 0]] & inside[here.pairs[:, 1]]
    change = log_evidence(trial.then[:, cut].sum(axis=1)) - log_evidence(here.now[:, cut].sum(axis=1))
    return float(change + trial.held[inside].sum())


def _cuts(here: Placements, trials: list[Trial]) -> Bools:
    """The views (K, C, V) beyond the lightest cut, for each trial and each of `CUT_THROUGH`: of pairs that it parts it
    costs what they lose by the motion, and of views that move with it what they are held worse.

    All are cut in one network with one source and one sink: a call costs ten times what it takes to find the flow.
    """
    count, (tail, head) = len(here.found.piece), here.pairs.T
    shape = len(trials), len(CUT_THROUGH), count
    source, every = len(trials) * len(CUT_THROUGH) * count, np.arange(count)
    tails, heads, weights = [], [], []
    for first, (trial, through) in zip(range(0, source, count), product(trials, CUT_THROUGH), strict=True):
        change, movable, held = trial.then - here.now, trial.movable, trial.held
        lost = np.where(movable[head], -PER_FOLD / (1 + through) * change[0] - change[2], 0.0)
        won, parted = PULL * np.maximum(-lost, 0.0), np.flatnonzero(lost > 0)
        stays = np.bincount(tail, won, count) + np.where(movable, np.maximum(-held, 0.0), HELD_NATS)
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

    def most_urgent(self, urgent: Floats, most: int) -> list[int]:
        """The most urgent (P,) of those that propose other motions than the ones before, up to so many."""
        left, out = np.ones(len(urgent), bool), list[int]()
        while left.any() and len(out) < most:
            out.append(row := int(np.argmax(np.where(left, urgent, -np.inf))))
            group, alike = self.group(row)
            left[group[alike > 0.5]] = False
            left[row] = False
        return out

    def mean_motions(self, rows: list[int], poses: Floats) -> Floats:
        """The mean motions (K, 4, 4) of the groups of these proposals, each counting as it agrees."""
        groups, shares = zip(*map(self.group, rows), strict=True)
        which, group = np.repeat(np.arange(len(rows)), list(map(len, groups))), np.concatenate(groups)
        points = poses[self.mover[group], :3, 3]
        return np.asarray(mean_motions(which, self.motion[group], points, np.concatenate(shares), len(rows)))


def _near_in_angle(evidence: Evidence, edge: Ints, motion: Floats) -> tuple[Ints, Ints]:
    """Pairs of motions whose rotations may agree."""
    quat = se3.to_quat_xyzw(motion).astype(np.float32)
    likeness = np.abs(quat @ quat.T)
    widest = min(SIGMAS_APART * float(evidence.noise.rotation_rad[edge].max(initial=0.0)), np.pi)
    first, second = np.nonzero(likeness >= np.cos(widest / 2))
    return first, second

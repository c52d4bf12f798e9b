"""A solution improved by moving sets of views to where more speaks for them, until none wants to move.

Pieces that grew together best first are never parted again, also where one wrong edge between consecutive views came
before many right ones between others. Here each edge that disagrees proposes a motion; with the edges that propose the
same it says where a set of views should be. The sets are runs of consecutive views, whole pieces, and those that grow
from the ends of the proposing edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.cuts import GATE, Scene, consecutive_nats, interval_sums, pair_nats, sums_of
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.joining import Joining, learn_joining
from hodge_pipeline.diagnosis.pieces import Alignment
from hodge_pipeline.diagnosis.robust_poses import ONCE, TWICE, Fit, fit
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

ROUNDS = 10
TRIED = 60
"""Motions in each round."""
LEAST_GAIN = 2.0
"""Nats."""
MOST_PROPOSALS = 2000


@dataclass(frozen=True)
class _Proposals:
    """Disagreeing edges, each in both directions: `mover (P,)` by `motion (P, 4, 4)`, in the frame of `stayer`;
    `alike (P, P)` from 1 down to 0 how well the second agrees with the motion of the first.
    """

    mover: Ints
    stayer: Ints
    motion: Floats
    alike: Floats
    urgent: Floats


@dataclass(frozen=True)
class _Move:
    gain: float
    inside: Bools
    motion: Floats
    piece: int


def rearrange(evidence: Evidence, graph: ViewGraph, start: Fit, fair_share: float) -> Fit:
    """The solution after the moves; `graph` has the recentred edges, for `fair_share` see `Scene`."""
    found, joining = start, None
    for _ in range(ROUNDS):
        joining = learned(evidence, found, joining)
        move = _best_move(scene_of(evidence, joining, found, fair_share), found)
        if move is None:
            break
        poses, piece = found.poses.copy(), found.component.copy()
        poses[move.inside], piece[move.inside] = move.motion @ poses[move.inside], move.piece
        found = fit(evidence, graph, Alignment(piece, poses), ONCE)
    return start if found is start else fit(evidence, graph, Alignment(found.component, found.poses), TWICE)


def learned(evidence: Evidence, found: Fit, known: Joining | None = None) -> Joining:
    """The law of joining that the edges which a solution uses show."""
    joined = np.zeros((evidence.vertex_count, evidence.vertex_count), bool)
    i, j = evidence.edges[found.used].T
    joined[i, j] = joined[j, i] = True
    return learn_joining(found.poses, found.component, joined, evidence.reach_m, known)


def scene_of(evidence: Evidence, joining: Joining, found: Fit, fair_share: float = 1.0) -> Scene:
    """What moves of this solution are judged by."""
    same = found.component[:, None] == found.component[None]
    usual = float(joining.between(found.poses, found.poses)[same].mean()) if np.ptp(evidence.prior) > 0 else 0.0
    return Scene(evidence, joining, usual, fair_share)


def _best_move(scene: Scene, found: Fit) -> _Move | None:
    poses, piece = found.poses, found.component
    together = piece[:, None] == piece[None]
    now = scene.layers(poses, poses) * (together & ~np.eye(len(piece), dtype=bool))
    proposals = _proposals(scene, found)
    runs_now = scene.nats(interval_sums(now)[2])
    best, left = None, np.ones(len(proposals.mover), bool)
    for _ in range(TRIED):
        if not left.any():
            break
        row = int(np.argmax(np.where(left, proposals.urgent, -1.0)))
        left &= proposals.alike[row] < 0.5
        left[row] = False
        move = _move(scene, found, now, runs_now, proposals, row)
        if move is not None and move.gain > (LEAST_GAIN if best is None else best.gain):
            best = move
    return best


def _move(scene: Scene, found: Fit, now: Floats, runs_now: Floats, proposals: _Proposals, row: int) -> _Move | None:
    """The best set of views to move as one proposal has it."""
    poses, piece = found.poses, found.component
    home, movable = piece[proposals.stayer[row]], piece == piece[proposals.mover[row]]
    motion = _mean_motion(proposals, row, poses)
    moved = scene.layers(poses, motion @ poses) * ((piece == home)[:, None] & ~np.eye(len(piece), dtype=bool))
    then = np.where(movable[None, None], moved, now)
    sets = [_grown(then, now, movable, proposals.mover[proposals.alike[row] > 0])]
    if not movable[proposals.stayer[row]]:
        sets.append(movable)
    if scene.usual:
        sets.append(_best_run(scene, then, runs_now, movable))
    best = None
    for inside in sets:
        gain = float(scene.nats(sums_of(then, inside)) - scene.nats(sums_of(now, inside))) if inside.any() else 0.0
        if best is None or gain > best.gain:
            best = _Move(gain, inside, motion, int(home))
    return best


def _best_run(scene: Scene, then: Floats, runs_now: Floats, movable: Bools) -> Bools:
    low, high, after = interval_sums(then)
    blocked = np.concatenate([[0], np.cumsum(~movable)])
    gain = np.where(blocked[high] > blocked[low], -np.inf, scene.nats(after) - runs_now)
    best, inside = int(np.argmax(gain)), np.zeros(len(movable), bool)
    if np.isfinite(gain[best]):
        inside[low[best] : high[best]] = True
    return inside


def _grown(then: Floats, now: Floats, movable: Bools, seed: Ints) -> Bools:
    """The set that grows, and shrinks, one view at a time from the seed while the sum over single pairs improves."""
    gain = pair_nats(then) - pair_nats(now)
    inside = np.zeros(len(movable), bool)
    inside[seed] = True
    inside &= movable
    enters, leaves = (~inside).astype(float) @ gain, gain @ inside.astype(float)
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


def _proposals(scene: Scene, found: Fit) -> _Proposals:
    evidence, poses = scene.evidence, found.poses
    i, j = evidence.edges.T
    agreeing = np.where(found.component[i] == found.component[j], scene.agreement(poses[i], poses[j]), 0.0)
    rows = np.flatnonzero((agreeing == 0) & (i != j))
    value = consecutive_nats(evidence)[rows]
    rows = np.sort(rows[np.argsort(-value, kind="stable")[: MOST_PROPOSALS // 2]])
    i, j = i[rows], j[rows]
    forward = poses[i] @ evidence.i_from_j[rows] @ se3.inverse(poses[j])
    mover, motion = np.concatenate([j, i]), np.concatenate([forward, se3.inverse(forward)])
    rows = np.concatenate([rows, rows])
    alike = _alike(motion, poses[mover, :3, 3], evidence.noise.rotation_rad[rows], evidence.noise.translation_m[rows])
    in_order = (np.abs(evidence.edges[rows, 1] - evidence.edges[rows, 0]) == 1) & (scene.usual > 0)
    urgent = 2.0 * np.log1p(alike.sum(1)) + np.where(in_order, consecutive_nats(evidence)[rows], 0.0)
    return _Proposals(mover, np.concatenate([i, j]), motion, alike, urgent)


def _alike(motion: Floats, point: Floats, turn: Floats, shift: Floats) -> Floats:
    quat = se3.to_quat_xyzw(motion)
    cosine = np.minimum(1.0, np.abs(quat @ quat.T))
    first, second = np.nonzero(cosine >= np.cos(np.minimum(np.sqrt(GATE) * turn, np.pi) / 2))
    at = np.einsum("nij,nj->ni", motion[first, :3, :3] - motion[second, :3, :3], point[second])
    at += motion[first, :3, 3] - motion[second, :3, 3]
    squares = (2 * np.arccos(cosine[first, second]) / turn[second]) ** 2
    squares += np.einsum("ni,ni->n", at, at) / shift[second] ** 2
    out = np.zeros(cosine.shape)
    out[first, second] = np.sqrt(np.maximum(0.0, 1 - squares / GATE))
    return out


def _mean_motion(proposals: _Proposals, row: int, poses: Floats) -> Floats:
    """The mean (4, 4) of the motions that agree with one."""
    weight = proposals.alike[row] / proposals.alike[row].sum()
    used = np.flatnonzero(weight)
    weight, motion, point = weight[used], proposals.motion[used], poses[proposals.mover[used], :3, 3]
    rotation = se3.project_to_so3(np.einsum("n,nij->ij", weight, motion[:, :3, :3])[None])[0]
    landed = weight @ (np.einsum("nij,nj->ni", motion[:, :3, :3], point) + motion[:, :3, 3])
    return se3.from_parts(rotation, landed - rotation @ (weight @ point))

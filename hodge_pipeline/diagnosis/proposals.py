"""Motions of views proposed by the edges that disagree with a solution, and how far these agree with each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.cuts import GATE, PlacementCriteria, consecutive_log_evidence
from hodge_pipeline.diagnosis.robust_poses import Fit
from hodge_pipeline.diagnosis.votes import mean_motion
from hodge_pipeline.types import Bools, Floats, Ints

MOST = 2000


@dataclass(frozen=True)
class Proposals:
    """Disagreeing edges, each in both directions: `mover (P,)` by `motion (P, 4, 4)`, in the frame of `stayer`;
    `alike (P, P)` from 1 down to 0 how well the second agrees with the motion of the first; `urgent (P,)` by how many
    agree and by their order.
    """

    mover: Ints
    stayer: Ints
    motion: Floats
    alike: Floats
    urgent: Floats

    def next(self, left: Bools) -> int:
        """The most urgent of those left (P,), from which it and all that propose the same are then gone."""
        row = int(np.argmax(np.where(left, self.urgent, -1.0)))
        left &= self.alike[row] < 0.5
        left[row] = False
        return row

    def mean_motion(self, row: int, poses: Floats) -> Floats:
        """The mean (4, 4) of the motions that agree with one."""
        used = np.flatnonzero(self.alike[row])
        return mean_motion(self.motion[used], poses[self.mover[used], :3, 3], self.alike[row, used])


def propose(criteria: PlacementCriteria, found: Fit) -> Proposals:
    """The proposals of all edges that disagree with a solution, of the likeliest where they are very many."""
    evidence, poses = criteria.evidence, found.poses
    i, j = evidence.edges.T
    agreeing = np.where(found.component[i] == found.component[j], criteria.agreement(poses[i], poses[j]), 0.0)
    rows = np.flatnonzero((agreeing == 0) & (i != j))
    value = consecutive_log_evidence(evidence)[rows]
    rows = np.sort(rows[np.argsort(-value, kind="stable")[: MOST // 2]])
    i, j = i[rows], j[rows]
    forward = poses[i] @ evidence.i_from_j[rows] @ se3.inverse(poses[j])
    mover, motion = np.concatenate([j, i]), np.concatenate([forward, se3.inverse(forward)])
    rows = np.concatenate([rows, rows])
    alike = _alike(motion, poses[mover, :3, 3], evidence.noise.rotation_rad[rows], evidence.noise.translation_m[rows])
    in_order = (np.abs(evidence.edges[rows, 1] - evidence.edges[rows, 0]) == 1) & (criteria.usual > 0)
    urgent = 2.0 * np.log1p(alike.sum(1)) + np.where(in_order, consecutive_log_evidence(evidence)[rows], 0.0)
    return Proposals(mover, np.concatenate([i, j]), motion, alike, urgent)


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

"""Motions of the world proposed by the edges that a solution leaves out, and how far these agree with each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import agreement_of, mean_motions
from hodge_pipeline.types import Bools, Floats, Ints

DRIFTED_RAD, SIGMAS_APART = 0.1, 12.0
"""Motions are compared where they turn alike but for this, and for so many standard deviations."""


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
    widest = min(DRIFTED_RAD + SIGMAS_APART * float(evidence.noise.rotation_rad[edge].max(initial=0.0)), np.pi)
    first, second = np.nonzero(likeness >= np.cos(widest / 2))
    return first, second

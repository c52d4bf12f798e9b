"""Poses moved in clusters, each as one rigid body: drift pulled straight at a cost that hardly grows with the graph.

Drift builds up over long ways, so that a few neighbours which agree keep their places among each other while it is
taken away: some thousand unknown motions stand for all poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components, first_of_component
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.solvers.backends import backend
from hodge_pipeline.solvers.elimination import plan_elimination
from hodge_pipeline.solvers.linear import fill_reducing_order
from hodge_pipeline.solvers.problem import Structure
from hodge_pipeline.solvers.rotations import cross
from hodge_pipeline.types import Bools, Floats, Ints

CLUSTERS = 6000
"""At most, in a graph that holds together: where there are no more poses than this, each is one."""
STEPS, LEAST_DECREASE = 15, 1e-2
HALVINGS = 4
DAMPING = 1e-9
"""Of the diagonal: far above rounding, which edges of wild lengths would make singular."""
FREEDOM, DIMENSION = 4.0, 6
"""Degrees of freedom of Student's t, the tails of real registration errors, and of a pose."""


def clustered(edges: Ints, firm: Bools, vertex_count: int) -> Ints:
    """The cluster (V,) of each vertex: those nearest, along the firm edges (E,), to one of some thousand seeds."""
    ends = edges[firm]
    shape = (vertex_count, vertex_count)
    adjacency = csr_matrix((np.ones(len(ends), np.float32), (ends[:, 0], ends[:, 1])), shape=shape)
    seed = first_of_component(connected_components(ends, vertex_count))
    seed |= np.random.default_rng(0).random(vertex_count) < CLUSTERS / max(vertex_count, 1)
    seeds = np.flatnonzero(seed)
    nearest = dijkstra(adjacency, False, seeds, return_predecessors=True, unweighted=True, min_only=True)[2]
    return np.asarray(np.searchsorted(seeds, nearest), np.int64)


@dataclass(frozen=True)
class Springs:
    """Edges between clusters: rows (m,) of the evidence's edges, and the network of clusters that they hold."""

    rows: Ints
    cluster: Ints
    structure: Structure

    @classmethod
    def of(cls, evidence: Evidence, used: Bools, cluster: Ints) -> Springs:
        """The springs that the used edges (E,) make between the clusters (V,); one of each component is held."""
        count = int(cluster.max(initial=-1)) + 1
        ends = cluster[evidence.edges]
        rows = np.flatnonzero(used & (ends[:, 0] != ends[:, 1]))
        held = first_of_component(connected_components(ends[rows], count))
        free, rest = np.flatnonzero(~held), np.flatnonzero(held)
        place = np.empty(count, np.int64)
        place[free], place[rest] = np.arange(len(free)), len(free) + np.arange(len(rest))
        tail, head = place[ends[rows]].T
        plan = plan_elimination(tail, head, len(free), fill_reducing_order)
        order = np.concatenate([free[plan.order], rest])
        place[order] = np.arange(count)
        tail, head = place[ends[rows]].T
        return cls(rows, cluster, Structure(order, len(free), tail, head, plan, backend("superlu")))

    def settled(self, evidence: Evidence, poses: Floats, squares: Floats, widened: float) -> Floats:
        """The poses (V, 4, 4) once the clusters have moved to where the springs pull them.

        `squares (E,)`: χ² of the edges by which they weigh at first; `widened`: how much larger than noise squared
        errors may be.
        """
        left, squares = _LeftOver.of(evidence, self, poses), squares[self.rows]
        for _ in range(STEPS if self.structure.free_count else 0):
            share = (FREEDOM + DIMENSION) / (FREEDOM + squares / widened)
            before = float(share @ left.squares)
            step = left.step(share)
            for halving in range(HALVINGS):
                moved = self._moved(poses, step / 2**halving)
                new = _LeftOver.of(evidence, self, moved)
                if (after := float(share @ new.squares)) < before:
                    poses, left, squares = moved, new, new.squares
                    break
            if before - after < LEAST_DECREASE * before:
                break
        return poses

    def _moved(self, poses: Floats, step: Floats) -> Floats:
        """The poses after each cluster (C, 6) has turned about its centre and shifted."""
        centres, turned = _centres(self.cluster, poses), se3.so3_exp(step[:, :3])
        motion = se3.from_parts(turned, centres + step[:, 3:] - np.einsum("cij,cj->ci", turned, centres))
        return np.asarray(motion[self.cluster] @ poses)


@dataclass(frozen=True)
class _LeftOver:
    """What the springs leave over in the world's axes: `turn`, `shift (m, 3)`, at these levers from the centres of the
    clusters; weights `stiff_turn`, `stiff_shift (m,)`.
    """

    springs: Springs
    turn: Floats
    shift: Floats
    tail_lever: Floats
    head_lever: Floats
    stiff_turn: Floats
    stiff_shift: Floats

    @classmethod
    def of(cls, evidence: Evidence, springs: Springs, poses: Floats) -> _LeftOver:
        rows, structure = springs.rows, springs.structure
        i, j = evidence.edges[rows].T
        expected = poses[i] @ evidence.i_from_j[rows]
        turn = se3.so3_log(poses[j, :3, :3] @ np.swapaxes(expected[:, :3, :3], 1, 2))
        centres = _centres(springs.cluster, poses)[structure.order]
        return cls(
            springs,
            turn,
            poses[j, :3, 3] - expected[:, :3, 3],
            expected[:, :3, 3] - centres[structure.tail],
            poses[j, :3, 3] - centres[structure.head],
            1 / evidence.noise.rotation_rad[rows] ** 2,
            1 / evidence.noise.translation_m[rows] ** 2,
        )

    @property
    def squares(self) -> Floats:
        """χ² (m,) in the noise."""
        turned, shifted = (np.einsum("ek,ek->e", part, part) for part in (self.turn, self.shift))
        return np.asarray(self.stiff_turn * turned + self.stiff_shift * shifted)

    def step(self, share: Floats) -> Floats:
        """Gauss-Newton's (C, 6): a turn about its centre and a shift of each cluster, zero where it is held."""
        structure = self.springs.structure
        turn, shift = share * self.stiff_turn, share * self.stiff_shift
        pull = np.zeros((len(structure.order), 6))
        for end, lever, sign in ((structure.tail, self.tail_lever, -1), (structure.head, self.head_lever, 1)):
            force = shift[:, None] * self.shift
            wrench = np.concatenate([turn[:, None] * self.turn + cross(lever, force), force], axis=1)
            for axis in range(6):
                pull[:, axis] += sign * np.bincount(end, wrench[:, axis], len(pull))

        def blocks(edges: slice) -> Floats:
            tail, head = se3.hat(self.tail_lever[edges]), se3.hat(self.head_lever[edges])
            weights = turn[edges], shift[edges]
            across = _stiffness(tail, head, *weights)
            own = np.stack([_stiffness(tail, tail, *weights), _stiffness(head, head, *weights)])
            own[:, :, range(6), range(6)] *= 1 + DAMPING
            return np.stack([*own, -across, -np.swapaxes(across, 1, 2)])

        matrix = structure.symmetric_pattern.assemble(blocks, (6, 6))
        factor = structure.backend.factorise_blocks(structure.elimination, matrix)
        out = np.zeros_like(pull)
        free = structure.free_count
        out[structure.order[:free]] = -factor.solve(pull[:free].reshape(-1)).reshape(-1, 6)
        return out


def _stiffness(tail: Floats, head: Floats, turn: Floats, shift: Floats) -> Floats:
    """Aᵀ W B (m, 6, 6) of the Jacobians at two ends, A = (I 0; −[u]ₓ I)."""
    out = np.zeros((len(tail), 6, 6))
    out[:, :3, :3] = -shift[:, None, None] * (tail @ head)
    out[:, :3, 3:] = shift[:, None, None] * tail
    out[:, 3:, :3] = -shift[:, None, None] * head
    for axis in range(3):
        out[:, axis, axis] += turn
        out[:, axis + 3, axis + 3] = shift
    return out


def _centres(cluster: Ints, poses: Floats) -> Floats:
    count = int(cluster.max(initial=-1)) + 1
    sums = [np.bincount(cluster, poses[:, axis, 3], count) for axis in range(3)]
    return np.stack(sums, axis=1) / np.bincount(cluster, minlength=count)[:, None]

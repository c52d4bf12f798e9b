"""How a solved graph bends to known points: smoothly along its path, as finely as the points tell and no finer.

An odometry drifts: over a short way its motions are exact, over a long one they add up to an error that changes slowly.
So all edges together keep their shape, and the path as a whole is moved by twists at few nodes along it, linear between
them. Its stiffness is that of the edges. How many nodes there are, and how much softer edges are over a long way than
they state, is what makes the points likeliest (the evidence of a linear Gaussian model: MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import coo_matrix, csr_matrix, kron

from hodge_pipeline import se3
from hodge_pipeline.complex.judging import residual_twists
from hodge_pipeline.types import Floats, Ints, ViewGraph

MOST_PIECES = 96
"""Of a path: a drift that changes within a hundredth of it is not followed, and the matrices stay small."""
SOFTNESS = np.logspace(0, 8, 33)
"""Squares of factors on the sigma of edges that are tried."""
MOST_STEPS, SETTLED = 20, 1e-5
"""Of Gauss-Newton; and a last one in radians, or metres to the scene's size."""
DAMPING = 1e-9
"""Share of the largest of three axes that holds what points do not tell: how a line of them turns about itself."""


@dataclass(frozen=True)
class Points:
    """What is known of points: each `found (P, 3)` belongs to one of the `vertices (P,)`; how far it is `left (P, 3)`
    of where it is known to be, with the `information (P, 3, 3)` of that.
    """

    vertices: Ints
    found: Floats
    left: Floats
    information: Floats

    def model(self, count: int) -> tuple[csr_matrix, Floats]:
        """The matrix and the right side of their least squares in the twists of all poses."""
        by_twist = _lever(self.found)
        weighed = np.swapaxes(by_twist, 1, 2) @ self.information
        right = np.zeros((count, 6))
        np.add.at(right, self.vertices, np.einsum("nij,nj->ni", weighed, self.left))
        return _blocks((self.vertices, self.vertices), weighed @ by_twist, count), right.ravel()


@dataclass(frozen=True)
class Bent:
    """How far the poses are bent: `poses (V, 4, 4)`, the factors on the sigma of edges, over the whole path, and of
    points, and the `spread (K, 6, K, 6)`, a covariance, of the twists about `centre (3,)` that poses are made of.
    """

    poses: Floats
    edge_factor: float
    point_factor: float
    spread: Floats
    centre: Floats
    way: _Way

    def covariances(self, vertices: Ints, points: Floats) -> Floats:
        """Of points (P, 3), which are fixed to the poses of these vertices."""
        node, share = self.way.node[vertices], self.way.share[vertices]
        twists = np.zeros((len(vertices), 6, 6))
        for a, b in product(range(node.shape[1]), repeat=2):
            twists += (share[:, a] * share[:, b])[:, None, None] * self.spread[node[:, a], :, node[:, b], :]
        moved = _lever(points - self.centre)
        return np.asarray(moved @ twists @ np.swapaxes(moved, 1, 2))


@dataclass(frozen=True)
class _Way:
    """The twist of each pose (V,) as the sum of those of three `node`s times their `share (V, 3)`: the first one moves
    its whole piece, the others bend it. The first `pieces` nodes bend nothing.
    """

    node: Ints
    share: Floats
    pieces: int
    count: int

    @property
    def matrix(self) -> csr_matrix:
        """The twists (6 V) of all poses by those (6 K) of the nodes."""
        rows = np.repeat(np.arange(len(self.node)), self.node.shape[1])
        shares = coo_matrix((self.share.ravel(), (rows, self.node.ravel())), (len(self.node), self.count))
        return kron(shares, np.eye(6), format="csr")


_Level = tuple[_Way, csr_matrix, Floats]
"""A way to bend, its matrix, and how stiff edges are against it."""


class Bending:
    """A graph of edges, with the weights it was solved with, that bends from its `rest (V, 4, 4)`.

    Only the rows `pieces` move, each piece by itself, whose rows are in order along its path.
    """

    def __init__(self, graph: ViewGraph, rest: Floats, pieces: Sequence[Ints]) -> None:
        places = rest[np.concatenate(pieces), :3, 3]
        self._graph, self._centre = graph, places.mean(axis=0)
        self._size_m = max(float(np.linalg.norm(np.ptp(places, axis=0))), 1e-9)
        self._rest = _shifted(rest, -self._centre)
        stiff, _ = self._stiffness(self._rest)
        self._levels: list[_Level] = []
        for way in _ways(rest, pieces):
            matrix = way.matrix
            bends = matrix[:, 6 * len(pieces) :]
            self._levels.append((way, matrix, (bends.T @ stiff @ bends).toarray()))

    def towards(
        self, vertices: Ints, arms: Floats, known: Floats, covariances: Floats, least: float, finest: bool = False
    ) -> Bent:
        """The poses bent to `known (P, 3)` points, each `arms (P, 3)` in the axes of one of the `vertices (P,)`; the
        factor on their sigma is at `least` this. `finest`: at the most nodes, whatever is likeliest.
        """
        information = np.asarray(np.linalg.inv(covariances))

        def points(poses: Floats) -> Points:
            found = np.einsum("nij,nj->ni", poses[vertices, :3, :3], arms) + poses[vertices, :3, 3]
            return Points(vertices, found, known - self._centre - found, information)

        there = points(self._rest)
        levels = self._levels[-1:] if finest else self._levels
        soft, (way, matrix, _), point_factor = self._likeliest(there, least, levels)
        poses = self._rest
        for _ in range(MOST_STEPS):
            stiff, force = self._stiffness(poses)
            wanted, pull = points(poses).model(len(poses))
            hessian = _damped((matrix.T @ (stiff / soft + wanted) @ matrix).toarray())
            twist = np.linalg.solve(hessian, matrix.T @ (pull - force / soft))
            step = (matrix @ twist).reshape(-1, 6)
            poses = se3.exp(step) @ poses
            if np.abs(step / ([1.0] * 3 + [self._size_m] * 3)).max() < SETTLED:
                break
        spread = np.asarray(np.linalg.inv(hessian) * point_factor**2).reshape(way.count, 6, way.count, 6)
        edge_factor = float(np.sqrt(soft)) * point_factor
        return Bent(_shifted(poses, self._centre), edge_factor, point_factor, spread, self._centre, way)

    def _likeliest(self, points: Points, least: float, levels: list[_Level]) -> tuple[float, _Level, float]:
        """The softness of edges against points, the level, and the factor on the sigma of points, of most evidence."""
        matrix, right = points.model(len(self._rest))
        misfit = float(np.einsum("ni,nij,nj->", points.left, points.information, points.left))
        best = (-np.inf, 1.0, levels[0], 1.0)
        for level in levels:
            way, twists, stiff = level
            gained, values, weights = _spectrum(
                (twists.T @ matrix @ twists).toarray(), twists.T @ right, stiff, 6 * way.pieces
            )
            free = 3 * len(points.left) - 6 * way.pieces
            for soft in SOFTNESS:
                left = max(misfit - gained - float((weights / (values + 1 / soft)).sum()), 0.0)
                factor = max(np.sqrt(left / max(free, 1)), least)
                evidence = -left / (2 * factor**2) - free * np.log(factor) - np.log1p(soft * values).sum() / 2
                if evidence > best[0]:
                    best = (evidence, float(soft), level, factor)
        return best[1:]

    def _stiffness(self, poses: Floats) -> tuple[csr_matrix, Floats]:
        """Matrix and gradient of half of chi-squared of all edges by the twists of poses in the world."""
        graph, (i, j) = self._graph, self._graph.edges.T
        carried = se3.adjoint(se3.inverse(poses[j]))
        weighed = np.swapaxes(carried, 1, 2) @ graph.information
        block = weighed @ carried
        force = np.einsum("eij,ej->ei", weighed, residual_twists(graph, poses))
        total = np.zeros((len(poses), 6))
        np.add.at(total, j, force)
        np.add.at(total, i, -force)
        ends = (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))
        return _blocks(ends, np.concatenate([block, block, -block, -block]), len(poses)), total.ravel()


def _spectrum(wanted: Floats, pull: Floats, stiff: Floats, free: int) -> tuple[float, Floats, Floats]:
    """By how much the first `free` unknowns, which edges do not hold, lower the misfit; then, of each way to bend, what
    points tell of it against edges, and by how much it could lower the misfit times that.
    """
    solved = np.linalg.solve(_damped(wanted[:free, :free]), np.column_stack([wanted[:free, free:], pull[:free]]))
    others = wanted[free:, free:] - wanted[free:, :free] @ solved[:, :-1]
    force = pull[free:] - wanted[free:, :free] @ solved[:, -1]
    gained = float(pull[:free] @ solved[:, -1])
    if not len(stiff):
        return gained, np.zeros(0), np.zeros(0)
    size = np.sqrt(np.diag(stiff))
    held = stiff / np.outer(size, size) + DAMPING**1.5 * np.eye(len(size))
    values, vectors = eigh(others / np.outer(size, size), held)
    return gained, np.maximum(values, 0.0), (vectors.T @ (force / size)) ** 2


def _damped(matrix: Floats) -> Floats:
    """The matrix with a little of the largest of each three axes added to all three."""
    most = np.diag(matrix).reshape(-1, 3).max(axis=1)
    return np.asarray(matrix + DAMPING * np.diag(np.repeat(most, 3)))


def _blocks(ends: tuple[Ints, Ints], blocks: Floats, count: int) -> csr_matrix:
    """The sum (6 n, 6 n) of these blocks (B, 6, 6) at the rows and columns of `ends`."""
    six = np.arange(6)
    rows = np.broadcast_to(6 * ends[0][:, None, None] + six[:, None], blocks.shape)
    columns = np.broadcast_to(6 * ends[1][:, None, None] + six, blocks.shape)
    return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), (6 * count, 6 * count)).tocsr()


def _ways(poses: Floats, pieces: Sequence[Ints]) -> list[_Way]:
    """From rigid pieces to ones of ever more nodes, evenly along each one's path."""
    steps = [np.linalg.norm(np.diff(poses[rows, :3, 3], axis=0), axis=1) for rows in pieces]
    along = [np.concatenate([[0.0], np.cumsum(own)]) for own in steps]
    longest = max(own[-1] for own in along)
    ways: list[_Way] = []
    parts = 0
    while parts <= MOST_PIECES:
        node, share = np.zeros((len(poses), 3), np.int64), np.zeros((len(poses), 3))
        count = len(pieces)
        for piece, (rows, way) in enumerate(zip(pieces, along, strict=True)):
            cut = min(round(parts * way[-1] / max(longest, 1e-9)), len(rows) - 1)
            node[rows, 0], share[rows, 0] = piece, 1.0
            if cut:
                at = way / way[-1] * cut
                low = np.minimum(at.astype(np.int64), cut - 1)
                node[rows, 1], share[rows, 1] = count + np.maximum(low - 1, 0), np.where(low > 0, 1 + low - at, 0.0)
                node[rows, 2], share[rows, 2] = count + low, at - low
            count += cut
        if ways and count == ways[-1].count:
            break
        ways.append(_Way(node, share, len(pieces), count))
        parts = max(1, 2 * parts)
    return ways


def _lever(points: Floats) -> Floats:
    """The derivative (P, 3, 6) of points (P, 3) by a twist about the origin."""
    unit = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([-se3.hat(points), unit], axis=2)


def _shifted(poses: Floats, shift: Floats) -> Floats:
    out = poses.copy()
    out[:, :3, 3] += shift
    return out

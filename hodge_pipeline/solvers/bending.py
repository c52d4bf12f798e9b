"""A smooth deformation of a solved graph to known points, as fine as the points support.

Odometry drifts: over short paths its motions are exact, over long ones they add up to an error that changes slowly. So
the graph is deformed by twists at few nodes along its path, linear in between, whose stiffness is that of the edges.
The number of nodes and the softness, a factor on the covariance of edges over long paths, maximise the evidence of a
linear Gaussian model (MacKay 1992).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import coo_matrix, csr_matrix, kron

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import residual_twists
from hodge_pipeline.complex.one_form import shifted
from hodge_pipeline.types import Floats, Ints, ViewGraph

MOST_PIECES = 96
"""Most segments of a path: drift that changes within a hundredth of it is not followed; matrices stay small."""
SOFTNESS = np.logspace(0, 8, 33)
"""Factors on the covariance of edges that are tried."""
MOST_STEPS, SETTLED = 20, 1e-5
"""Gauss-Newton steps; and the step that ends them, in radians, or metres relative to the scene's size."""
DAMPING = 1e-9
"""Damping relative to the largest of three axes, for axes that points leave free, as of a line about itself."""


@dataclass(frozen=True)
class Points:
    """Known points: `found (P, 3)`, at the present poses of the `vertices (P,)`; `left (P, 3)`, the residual to the
    known position; and its `information (P, 3, 3)`.
    """

    vertices: Ints
    found: Floats
    left: Floats
    information: Floats

    def model(self, count: int) -> tuple[csr_matrix, Floats]:
        """The normal equations, matrix and right side, of their least squares in the twists of all poses."""
        by_twist = se3.by_twist(self.found)
        weighted = np.swapaxes(by_twist, 1, 2) @ self.information
        right = np.zeros((count, 6))
        np.add.at(right, self.vertices, np.einsum("nij,nj->ni", weighted, self.left))
        return _blocks((self.vertices, self.vertices), weighted @ by_twist, count), right.ravel()


@dataclass(frozen=True)
class Bent:
    """Deformed `poses (V, 4, 4)`, the factors on the sigma of edges over the whole path and of points, and the
    covariance `spread (K, 6, K, 6)` of the nodes' twists about `centre (3,)`.
    """

    poses: Floats
    edge_factor: float
    point_factor: float
    spread: Floats
    centre: Floats
    layout: _NodeLayout

    def covariances(self, vertices: Ints, points: Floats) -> Floats:
        """Covariances (P, 3, 3) of points (P, 3) that are fixed to the poses of these vertices (P,)."""
        node, share = self.layout.node[vertices], self.layout.share[vertices]
        twists = np.zeros((len(vertices), 6, 6))
        for a, b in product(range(node.shape[1]), repeat=2):
            twists += (share[:, a] * share[:, b])[:, None, None] * self.spread[node[:, a], :, node[:, b], :]
        moved = se3.by_twist(points - self.centre)
        return np.asarray(moved @ twists @ np.swapaxes(moved, 1, 2))


@dataclass(frozen=True)
class _NodeLayout:
    """The twist of each pose as a linear combination of those of three nodes, `node (V, 3)` and `share (V, 3)`: the
    first moves its whole piece rigidly, the others bend it. Of all `count` nodes the first `pieces` are rigid.
    """

    node: Ints
    share: Floats
    pieces: int
    count: int

    @property
    def matrix(self) -> csr_matrix:
        """The matrix (6 V, 6 K) from twists of nodes to twists of poses."""
        rows = np.repeat(np.arange(len(self.node)), self.node.shape[1])
        shares = coo_matrix((self.share.ravel(), (rows, self.node.ravel())), (len(self.node), self.count))
        return kron(shares, np.eye(6), format="csr")


class _Level(NamedTuple):
    """A layout of nodes, its `matrix (6 V, 6 K)`, and the stiffness of the edges in the twists of its bending nodes."""

    layout: _NodeLayout
    matrix: csr_matrix
    stiffness: Floats


class _Fit(NamedTuple):
    """The factor on the covariance of edges over long paths, how finely they bend, and the factor on points' sigma."""

    softness: float
    level: _Level
    point_factor: float


class _Spectrum(NamedTuple):
    """By how much the rigid twists of pieces lower χ²; and of each bending mode the ratio of the information of points
    to the stiffness of edges, and the squared force of points on it.
    """

    rigid_gain: float
    ratios: Floats
    squared_forces: Floats


class Bending:
    """A graph of edges, with the weights it was solved with, deformed from poses `rest (V, 4, 4)`.

    Only rows in `pieces` move, each piece by itself; the rows of a piece are in order along its path.
    """

    def __init__(self, graph: ViewGraph, rest: Floats, pieces: Sequence[Ints]) -> None:
        places = rest[np.concatenate(pieces), :3, 3]
        self._graph, self._centre = graph, places.mean(axis=0)
        self._size_m = max(float(np.linalg.norm(np.ptp(places, axis=0))), 1e-9)
        self._rest = shifted(rest, -self._centre)
        stiffness, _ = self._stiffness(self._rest)
        self._levels: list[_Level] = []
        for layout in _layouts(rest, pieces):
            matrix = layout.matrix
            bends = matrix[:, 6 * len(pieces) :]
            self._levels.append(_Level(layout, matrix, (bends.T @ stiffness @ bends).toarray()))

    def towards(
        self, vertices: Ints, arms: Floats, known: Floats, covariances: Floats, least: float, finest: bool
    ) -> Bent:
        """The poses bent to `known (P, 3)` points, each `arms (P, 3)` in the axes of one of the `vertices (P,)`; the
        factor on their sigma is `least` or more. `finest`: with the most nodes, whatever the evidence.
        """
        information = np.asarray(np.linalg.inv(covariances))

        def points(poses: Floats) -> Points:
            found = np.einsum("nij,nj->ni", poses[vertices, :3, :3], arms) + poses[vertices, :3, 3]
            return Points(vertices, found, known - self._centre - found, information)

        there = points(self._rest)
        levels = self._levels[-1:] if finest else self._levels
        softness, (layout, matrix, _), point_factor = self._likeliest(there, least, levels)
        poses = self._rest
        for _ in range(MOST_STEPS):
            stiffness, force = self._stiffness(poses)
            of_points, pull = points(poses).model(len(poses))
            hessian = _damped((matrix.T @ (stiffness / softness + of_points) @ matrix).toarray())
            twist = np.linalg.solve(hessian, matrix.T @ (pull - force / softness))
            step = (matrix @ twist).reshape(-1, 6)
            poses = se3.exp(step) @ poses
            if np.abs(step / ([1.0] * 3 + [self._size_m] * 3)).max() < SETTLED:
                break
        spread = np.asarray(np.linalg.inv(hessian) * point_factor**2).reshape(layout.count, 6, layout.count, 6)
        edge_factor = float(np.sqrt(softness)) * point_factor
        return Bent(shifted(poses, self._centre), edge_factor, point_factor, spread, self._centre, layout)

    def _likeliest(self, points: Points, least: float, levels: list[_Level]) -> _Fit:
        """The fit of the largest evidence, its factor on the sigma of points `least` or more (MacKay 1992)."""
        matrix, right = points.model(len(self._rest))
        misfit = float(np.einsum("ni,nij,nj->", points.left, points.information, points.left))
        best, highest = _Fit(1.0, levels[0], 1.0), -np.inf
        for level in levels:
            layout, twists, stiffness = level
            rigid_gain, ratios, squared_forces = _spectrum(
                (twists.T @ matrix @ twists).toarray(), twists.T @ right, stiffness, 6 * layout.pieces
            )
            free = 3 * len(points.left) - 6 * layout.pieces
            for softness in SOFTNESS:
                left = max(misfit - rigid_gain - float((squared_forces / (ratios + 1 / softness)).sum()), 0.0)
                factor = max(np.sqrt(left / max(free, 1)), least)
                evidence = -left / (2 * factor**2) - free * np.log(factor) - np.log1p(softness * ratios).sum() / 2
                if evidence > highest:
                    best, highest = _Fit(float(softness), level, factor), evidence
        return best

    def _stiffness(self, poses: Floats) -> tuple[csr_matrix, Floats]:
        """Gauss-Newton Hessian and gradient of half of χ² of all edges, in twists of the poses in the world."""
        graph, (i, j) = self._graph, self._graph.edges.T
        carried = se3.adjoint(se3.inverse(poses[j]))
        weighted = np.swapaxes(carried, 1, 2) @ graph.information
        block = weighted @ carried
        force = np.einsum("eij,ej->ei", weighted, residual_twists(graph, poses))
        total = np.zeros((len(poses), 6))
        np.add.at(total, j, force)
        np.add.at(total, i, -force)
        ends = (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))
        return _blocks(ends, np.concatenate([block, block, -block, -block]), len(poses)), total.ravel()


def _spectrum(of_points: Floats, pull: Floats, stiffness: Floats, free: int) -> _Spectrum:
    """The modes of points against edges: eigenvectors of the information of points relative to the stiffness of edges,
    once the first `free` unknowns, on which edges have no information, are eliminated.
    """
    solved = np.linalg.solve(_damped(of_points[:free, :free]), np.column_stack([of_points[:free, free:], pull[:free]]))
    others = of_points[free:, free:] - of_points[free:, :free] @ solved[:, :-1]
    force = pull[free:] - of_points[free:, :free] @ solved[:, -1]
    rigid_gain = float(pull[:free] @ solved[:, -1])
    if not len(stiffness):
        return _Spectrum(rigid_gain, np.zeros(0), np.zeros(0))
    size = np.sqrt(np.diag(stiffness))
    held = stiffness / np.outer(size, size) + DAMPING**1.5 * np.eye(len(size))
    values, vectors = eigh(others / np.outer(size, size), held)
    return _Spectrum(rigid_gain, np.maximum(values, 0.0), (vectors.T @ (force / size)) ** 2)


def _damped(matrix: Floats) -> Floats:
    """The matrix with `DAMPING` of the largest diagonal entry of each three axes added to all three."""
    most = np.diag(matrix).reshape(-1, 3).max(axis=1)
    return np.asarray(matrix + DAMPING * np.diag(np.repeat(most, 3)))


def _blocks(ends: tuple[Ints, Ints], blocks: Floats, count: int) -> csr_matrix:
    """The sum (6 n, 6 n) of these blocks (B, 6, 6) at the rows and columns of `ends`."""
    six = np.arange(6)
    rows = np.broadcast_to(6 * ends[0][:, None, None] + six[:, None], blocks.shape)
    columns = np.broadcast_to(6 * ends[1][:, None, None] + six, blocks.shape)
    return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), (6 * count, 6 * count)).tocsr()


def _layouts(poses: Floats, pieces: Sequence[Ints]) -> list[_NodeLayout]:
    """Layouts from rigid pieces to ever more nodes, spaced evenly along the path of each piece."""
    steps = [np.linalg.norm(np.diff(poses[rows, :3, 3], axis=0), axis=1) for rows in pieces]
    along = [np.concatenate([[0.0], np.cumsum(own)]) for own in steps]
    longest = max(own[-1] for own in along)
    layouts: list[_NodeLayout] = []
    parts = 0
    while parts <= MOST_PIECES:
        node, share = np.zeros((len(poses), 3), np.int64), np.zeros((len(poses), 3))
        count = len(pieces)
        for piece, (rows, length) in enumerate(zip(pieces, along, strict=True)):
            cut = min(round(parts * length[-1] / max(longest, 1e-9)), len(rows) - 1)
            node[rows, 0], share[rows, 0] = piece, 1.0
            if cut:
                at = length / length[-1] * cut
                low = np.minimum(at.astype(np.int64), cut - 1)
                node[rows, 1], share[rows, 1] = count + np.maximum(low - 1, 0), np.where(low > 0, 1 + low - at, 0.0)
                node[rows, 2], share[rows, 2] = count + low, at - low
            count += cut
        if layouts and count == layouts[-1].count:
            break
        layouts.append(_NodeLayout(node, share, len(pieces), count))
        parts = max(1, 2 * parts)
    return layouts

"""The backbone as paths of vertices: positions along them, motions from one to the next, and the loops between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import has_unit_information
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.cycles import spanning_forest
from hodge_pipeline.solvers.backbone import plane
from hodge_pipeline.solvers.backbone.credible import credible_steps, free_axes
from hodge_pipeline.solvers.backbone.loop_places import corridors, one_of_each_place
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

PLACE = 4.0
"""Length of a place: steps whose variances add up to those of this many loops."""
STEPS_OF_PLACE, FEWEST_PLACES = 20, 50
"""Fewest steps of a place, however large their errors; fewest places of a chain, however small these are."""
SMALLEST_SIGMA = 0.03
"""Share of the largest median standard deviation of rotation, and of translation, that is added to each axis of it, in
squares. Axes turn with poses, which are known to hundredths of a radian: an error of a thousandth of the others is that
of no axis. From .01 to .1 the manhattan graph is judged alike.
"""


@dataclass(frozen=True)
class Chain:
    """Paths of vertices one after the other, and all other edges as loops between positions along them.

    - `order (n,)`: the vertex at each position; `path (n,)`: the path it lies on, ascending.
    - `step (n, 4, 4)` from the position before, `step_covariance (n, p, p)` of ξ in `step · exp(ξ)`, and the graph's
      edge `step_edge (n,)` that they come from; identity, zeros and −1 where a path begins.
    - `loop_edge (M,)`; `ends (M, 2)`, the first the lower position; `motion (M, 4, 4)`; `covariance (M, p, p)`.
    - `bridged (n,)`: steps whose motion is a guess, of a broken step or between paths; no scale is learned for them.
    - `axes (p,)`: free axes of a twist, three in the plane; `stated`: the graph has information, not the identity that
      stands for unknown, and most steps constrain every axis.
    - `unit`: covariances are that identity, whichever end of an edge they are of; see `of_both_ends`.
    - `bias (r,)`: the rotation that was taken out of each measured step; see `without_bias`.
    """

    order: Ints
    path: Ints
    step: Floats
    step_covariance: Floats
    step_edge: Ints
    loop_edge: Ints
    ends: Ints
    motion: Floats
    covariance: Floats
    bridged: Bools
    axes: Ints
    stated: bool
    unit: bool
    bias: Floats

    @property
    def size(self) -> int:
        """How many positions there are."""
        return len(self.order)

    @property
    def is_spatial(self) -> bool:
        """Whether motions leave the plane."""
        return len(self.axes) == 6

    @property
    def rotation_axes(self) -> int:
        """How many of a twist's free axes are rotations."""
        return 3 if self.is_spatial else 1

    @property
    def inner(self) -> Bools:
        """Positions (n,) that a step leads to."""
        return np.asarray((self.step_edge >= 0) | self.bridged)

    @property
    def measured(self) -> Bools:
        """Positions (n,) that a step leads to which no bridge has replaced."""
        return np.asarray((self.step_edge >= 0) & ~self.bridged)

    def lacks(self, kept: Bools) -> Bools:
        """Positions (n,) that a step leads to which is not among the edges `kept (E,)`."""
        return np.asarray(~np.append(kept, True)[self.step_edge])

    @property
    def broken(self) -> Bools:
        """Positions (n,) that a broken step led to, where a bridge is."""
        return self.bridged & (self.step_edge >= 0)

    @property
    def joins(self) -> Bools:
        """Positions (n,) that a bridge from another path leads to."""
        return self.bridged & (self.step_edge < 0)

    @property
    def apart(self) -> Bools:
        """Loops (M,) between two paths."""
        return np.asarray(np.not_equal(*self.path[self.ends].T), bool)

    def parted(self) -> Chain:
        """The chain without bridges between its paths."""
        begins = self.step_edge < 0
        step, covariance = self.step.copy(), self.step_covariance.copy()
        step[begins], covariance[begins] = np.eye(4), 0.0
        path = np.cumsum(begins) - 1
        return replace(self, path=path, step=step, step_covariance=covariance, bridged=self.broken)

    def turned(self, by: Floats) -> Chain:
        """The chain with a rotation (r,) more in each measured step."""
        twist = np.zeros((self.size, len(self.axes)))
        twist[self.measured, : len(by)] = by
        return replace(self, step=self.step @ self.exp(twist), bias=self.bias - by)

    @cached_property
    def poses(self) -> Floats:
        """World from each position (n, 4, 4), each path composed from the identity."""
        out = np.empty((self.size, 4, 4))
        before, inner = np.eye(4), self.inner
        for row in range(self.size):
            before = before @ self.step[row] if inner[row] else self.step[row]
            out[row] = before
        return out

    @cached_property
    def places(self) -> Floats:
        """The ends of each loop (M, 2) along the chain, in units of places: loops are of one place where both ends lie
        within 1. They count once, however many agree, since all of them are wrong where a place is mistaken.
        """
        own = np.median(np.einsum("mii->mi", self.covariance), axis=0)
        steps = np.where(self.bridged[:, None], 0.0, np.einsum("nii->ni", self.step_covariance))
        longest = max(STEPS_OF_PLACE, self.size / FEWEST_PLACES)
        along = np.clip((steps / own).mean(axis=1) / PLACE, 1 / longest, 1 / STEPS_OF_PLACE)
        return np.asarray(np.cumsum(along)[self.ends])

    def corridors_over(self, at: int, loops: Ints) -> int:
        """How many corridors (see `corridors`) the loops (K,) that pass over the step to a position belong to: loops of
        a single one, mistaken for another, agree with a break anywhere.
        """
        low, high = self.ends[loops].T
        ends = self.places[loops[(low < at) & (at <= high)]]
        return len(np.unique(corridors(ends[one_of_each_place(ends)])))

    def spans(self, edges: Ints) -> Ints:
        """The positions (K, 2) of the vertices of edges (K, 2), the lower first."""
        return np.sort(np.argsort(self.order)[edges], axis=1)

    def over(self, ends: Ints, weight: Floats | None = None) -> Floats:
        """The number (n,), or total `weight (K,)`, of the spans (K, 2) of positions that pass over each step."""
        low, high = ends.T
        change = np.bincount(low + 1, weight, self.size + 1) - np.bincount(high + 1, weight, self.size + 1)
        return np.asarray(np.cumsum(change)[:-1])

    def with_loops(self, rows: Ints, ends: Ints) -> Chain:
        """The chain with the loops `rows (K,)` alone, moved to other ends (K, 2)."""
        motion, covariance = self.motion[rows], self.covariance[rows]
        return replace(self, loop_edge=self.loop_edge[rows], ends=ends, motion=motion, covariance=covariance)

    def adjoint(self, poses: Floats) -> Floats:
        """Adjoint matrices (..., p, p) of poses, in the free axes."""
        return se3.adjoint(poses) if self.is_spatial else plane.adjoint(poses)

    def lever(self, origin: Floats) -> Floats:
        """Lever arms (K, 3, 3), (K, 2, 1) in the plane: the lower left block of the adjoint of a shift by −origin."""
        turns = self.axes < 3
        return se3.hat(-origin)[:, self.axes[~turns, None] - 3, self.axes[turns]]

    def carried(self, poses: Floats, covariance: Floats) -> Floats:
        """Covariances `Ad Σ Adᵀ` (..., p, p) of twists, taken by the adjoints of poses (..., 4, 4)."""
        if not self.is_spatial:
            return plane.carried(poses, covariance)
        into = self.adjoint(poses)
        return np.asarray(into @ covariance @ np.swapaxes(into, -1, -2))

    def of_both_ends(self, motions: Floats, covariance: Floats) -> Floats:
        """Mean covariances (M, p, p), in j's axes, of motions i_from_j (M, 4, 4) that err alike at both ends."""
        return 0.5 * (covariance + self.carried(se3.inverse(motions), covariance))

    def between(self, a: Floats, b: Floats) -> Floats:
        """Motions `a⁻¹ b` (..., 4, 4)."""
        return np.asarray(se3.inverse(a) @ b) if self.is_spatial else plane.between(a, b)

    def log(self, motions: Floats) -> Floats:
        """Twists (..., p) of the free axes."""
        return se3.log(motions) if self.is_spatial else plane.log(motions)

    def exp(self, twists: Floats) -> Floats:
        """Motions (..., 4, 4) of twists (..., p)."""
        return se3.exp(twists) if self.is_spatial else plane.exp(twists)


def make_chain(graph: ViewGraph, backbone: Bools) -> Chain:
    """The chain of the backbone's edges (E,), a linear forest; the other edges are its loops, without self-loops."""
    graph, as_stated = credible_steps(graph, backbone)
    unit = has_unit_information(graph)
    order, step_edge, path = _walk(graph.edges, graph.vertex_count, np.flatnonzero(backbone))
    place = np.argsort(order)
    axes = free_axes(graph)
    covariance = se3.covariances(graph.information[:, axes[:, None], axes])
    rows = np.flatnonzero(~backbone & (graph.edges[:, 0] != graph.edges[:, 1]))
    low, high = np.sort(place[graph.edges[rows]], axis=1).T
    rows = rows[np.lexsort((high, low))]  # samples of the loops must not depend on the order of the file
    step, step_covariance = np.tile(np.eye(4), (len(order), 1, 1)), np.zeros((len(order), len(axes), len(axes)))
    at = np.flatnonzero(step_edge >= 0)
    edge = step_edge[at]
    is_reversed = place[graph.edges[edge, 0]] == at
    step[at], step_covariance[at] = _directed(graph.i_from_j[edge], covariance[edge], is_reversed, axes, unit)
    ends = place[graph.edges[rows]]
    motion, loop_covariance = _directed(graph.i_from_j[rows], covariance[rows], ends[:, 0] > ends[:, 1], axes, unit)
    usual = np.median(np.einsum("eii->ei", np.concatenate([step_covariance[at], loop_covariance])), axis=0)
    least = SMALLEST_SIGMA**2 * np.diag(np.where(axes < 3, usual[axes < 3].max(), usual[axes >= 3].max()))
    step_covariance[at] += least
    loop_covariance += least
    return Chain(
        order,
        path,
        step,
        step_covariance,
        step_edge,
        rows,
        np.sort(ends, axis=1),
        motion,
        loop_covariance,
        np.zeros(len(order), bool),
        axes,
        as_stated and not unit,
        unit,
        np.zeros(int((axes < 3).sum())),
    )


def linked(chain: Chain, low: int, high: int, motion: Floats, covariance: Floats) -> Chain:
    """The chain with path `high` appended to path `low < high` by a bridge: its motion (4, 4), covariance (p, p)."""
    second = chain.path == high
    after = int(np.flatnonzero(chain.path == low)[-1]) + 1
    moved = np.concatenate([np.arange(after), np.flatnonzero(second), np.flatnonzero(~second[after:]) + after])
    step, step_covariance, bridged = chain.step[moved], chain.step_covariance[moved], chain.bridged[moved]
    step[after], step_covariance[after], bridged[after] = motion, covariance, True
    ends = np.argsort(moved)[chain.ends]
    loop, loop_covariance = _directed(chain.motion, chain.covariance, ends[:, 0] > ends[:, 1], chain.axes, chain.unit)
    return replace(
        chain,
        order=chain.order[moved],
        path=np.where(second, low, chain.path)[moved],
        step=step,
        step_covariance=step_covariance,
        step_edge=chain.step_edge[moved],
        ends=np.sort(ends, axis=1),
        motion=loop,
        covariance=loop_covariance,
        bridged=bridged,
    )


def _directed(motion: Floats, covariance: Floats, reverse: Bools, axes: Ints, unit: bool) -> tuple[Floats, Floats]:
    """Motions and covariances, inverted where `reverse`: `Z⁻¹` has the covariance `Ad(Z) Σ Ad(Z)ᵀ`, but for units."""
    motion, covariance = motion.copy(), covariance.copy()
    if not unit:
        turned = se3.adjoint(motion[reverse])[:, axes[:, None], axes]
        covariance[reverse] = turned @ covariance[reverse] @ np.swapaxes(turned, 1, 2)
    motion[reverse] = se3.inverse(motion[reverse])
    return motion, covariance


def _walk(edges: Ints, count: int, rows: Ints) -> tuple[Ints, Ints, Ints]:
    """Vertices (V,) path by path, the edge that leads to each (−1 where a path begins), and its path."""
    ends = np.flatnonzero(np.bincount(edges[rows].ravel(), minlength=count) < 2)
    component = connected_components(edges[rows], count)
    begins = ends[np.unique(component[ends], return_index=True)[1]]
    forest = spanning_forest(edges[rows], count, begins)
    path = np.argsort(np.argsort(begins))[component]
    order = np.lexsort((forest.depth, path))
    return order, np.append(rows, -1)[forest.parent_edge[order]], path[order]

"""The backbone as paths of vertices: positions along them, motions from one to the next, and the loops between them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.cycles import spanning_forest
from hodge_pipeline.complex.judging import has_unit_information
from hodge_pipeline.solvers.backbone import plane
from hodge_pipeline.solvers.weights import PLANAR_AXES
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

PLACE = 4.0
"""Loops of which the steps between their ends vary less than so many loops do are of one place."""
STEPS_OF_PLACE, FEWEST_PLACES = 20, 50
"""Steps that a place has at the least, however large the errors of steps are; places that a path has, however small."""


@dataclass(frozen=True)
class Chain:
    """Paths of vertices one after the other, and all other edges as loops between their positions.

    - `order (n,)`: the vertex at each position; `path (n,)`: the path it lies on, ascending.
    - `step (n, 4, 4)` from the position before, `step_covariance (n, p, p)` of ξ in `step · exp(ξ)`, and the graph's
      edge `step_edge (n,)` that they come from; identity, zeros and −1 where a path begins.
    - `loop_edge (M,)`; `ends (M, 2)`, the first the lower position; `motion (M, 4, 4)`; `covariance (M, p, p)`.
    - `bridged (n,)`: steps with a guess in place of what the graph says; no scale is learned for its covariance.
    - `axes (p,)`: of a twist those that are free, three in the plane; `stated`: whether the graph's information is more
      than the identity that stands for unknown, and most steps state something of each axis.
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

    @property
    def size(self) -> int:
        """How many positions there are."""
        return len(self.order)

    @property
    def is_spatial(self) -> bool:
        """Whether motions leave the plane."""
        return len(self.axes) == 6

    @property
    def turns(self) -> int:
        """How many of a twist's free axes are rotations."""
        return 3 if self.is_spatial else 1

    @property
    def inner(self) -> Bools:
        """Positions (n,) that a step leads to."""
        return np.asarray((self.step_edge >= 0) | self.bridged)

    @property
    def broken(self) -> Bools:
        """Positions (n,) that a broken step led to, where a bridge is."""
        return self.bridged & (self.step_edge >= 0)

    @property
    def joins(self) -> Bools:
        """Positions (n,) that a bridge from another path leads to."""
        return self.bridged & (self.step_edge < 0)

    def parted(self) -> Chain:
        """The chain without bridges between its paths."""
        begins = self.step_edge < 0
        step, covariance = self.step.copy(), self.step_covariance.copy()
        step[begins], covariance[begins] = np.eye(4), 0.0
        path = np.cumsum(begins) - 1
        return replace(self, path=path, step=step, step_covariance=covariance, bridged=self.broken)

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
        """Where the ends of each loop (M, 2) lie along the chain, in places: of one place are loops both ends of which
        lie within 1. These are one testimony, however many agree, since a place may be mistaken for another.
        """
        own = np.median(np.einsum("mii->mi", self.covariance), axis=0)
        steps = np.where(self.bridged[:, None], 0.0, np.einsum("nii->ni", self.step_covariance))
        longest = max(STEPS_OF_PLACE, self.size / FEWEST_PLACES)
        along = np.clip((steps / own).mean(axis=1) / PLACE, 1 / longest, 1 / STEPS_OF_PLACE)
        return np.asarray(np.cumsum(along)[self.ends])

    def corridors_over(self, at: int, loops: Ints) -> int:
        """Of how many corridors those of the loops (K,) are that lead over a position: one that is mistaken for another
        agrees with a break anywhere.
        """
        low, high = self.ends[loops].T
        ends = self.places[loops[(low < at) & (at <= high)]]
        return len(np.unique(corridors(ends[one_of_each_place(ends)]))) if len(ends) else 0

    def spans(self, edges: Ints) -> Ints:
        """The positions (K, 2) of two vertices each, the lower first."""
        return np.sort(np.argsort(self.order)[edges], axis=1)

    def over(self, ends: Ints, worth: Floats | None = None) -> Floats:
        """How many of the spans (K, 2) of positions, or how much of their `worth (K,)`, pass over each step (n,)."""
        low, high = ends.T
        change = np.bincount(low + 1, worth, self.size + 1) - np.bincount(high + 1, worth, self.size + 1)
        return np.asarray(np.cumsum(change)[:-1])

    def with_loops(self, rows: Ints, ends: Ints) -> Chain:
        """The chain with these of its loops alone, between other ends (K, 2)."""
        motion, covariance = self.motion[rows], self.covariance[rows]
        return replace(self, loop_edge=self.loop_edge[rows], ends=ends, motion=motion, covariance=covariance)

    def adjoint(self, poses: Floats) -> Floats:
        """Ad (..., p, p) of the free axes."""
        return se3.adjoint(poses) if self.is_spatial else plane.adjoint(poses)

    def lever(self, origin: Floats) -> Floats:
        """The lower left block (K, 3, 3), (K, 2, 1) in the plane, of what takes twists to other origins (K, 3)."""
        turns = self.axes < 3
        return se3.hat(-origin)[:, self.axes[~turns, None] - 3, self.axes[turns]]

    def carried(self, poses: Floats, covariance: Floats) -> Floats:
        """Covariances (..., p, p) of twists, in the axes that the poses lead to: `Ad Σ Adᵀ`."""
        if not self.is_spatial:
            return plane.carried(poses, covariance)
        into = self.adjoint(poses)
        return np.asarray(into @ covariance @ np.swapaxes(into, -1, -2))

    def compose(self, a: Floats, b: Floats) -> Floats:
        """Motions `a b` (..., 4, 4)."""
        return np.asarray(a @ b) if self.is_spatial else plane.compose(a, b)

    def between(self, a: Floats, b: Floats) -> Floats:
        """Motions `a⁻¹ b` (..., 4, 4)."""
        return np.asarray(se3.inverse(a) @ b) if self.is_spatial else plane.between(a, b)

    def log(self, motions: Floats) -> Floats:
        """Twists (..., p) of the free axes."""
        return se3.log(motions) if self.is_spatial else plane.log(motions)

    def exp(self, twists: Floats) -> Floats:
        """Motions (..., 4, 4) of twists (..., p)."""
        return se3.exp(twists) if self.is_spatial else plane.exp(twists)


def consecutive_edges(graph: ViewGraph) -> Bools:
    """Edges (E,) between vertices that follow each other in the order of their ids."""
    return np.asarray(steps_apart(graph) == 1)


def steps_apart(graph: ViewGraph) -> Ints:
    """How far apart the vertices of each edge (E,) lie in the order of their ids."""
    return np.asarray(np.abs(np.diff(vertex_ranks(graph)[graph.edges], axis=1)[:, 0]))


def vertex_ranks(graph: ViewGraph) -> Ints:
    """The place (V,) of each vertex in the order of the ids where these are numbers, else of the rows."""
    if graph.vertex_ids.dtype.kind in "iu":
        return np.argsort(np.argsort(graph.vertex_ids, kind="stable"), kind="stable")
    return np.arange(graph.vertex_count)


def sequential_edges(graph: ViewGraph) -> Bools:
    """Consecutive edges (E,), the first of parallel ones."""
    out, rows = np.zeros(graph.edge_count, bool), np.flatnonzero(consecutive_edges(graph))
    out[rows[np.unique(np.sort(graph.edges[rows], axis=1), axis=0, return_index=True)[1]]] = True
    return out


def linear_forest(edges: Ints, count: int, trusted: Bools) -> Bools:
    """Trusted edges (E,) that make paths: no vertex of more than two, no cycle; those of neighbouring rows first."""
    rows = np.flatnonzero(trusted & (edges[:, 0] != edges[:, 1]))
    rows = rows[np.argsort(np.abs(edges[rows, 0] - edges[rows, 1]), kind="stable")]
    degree, root = [0] * count, list(range(count))

    def find(vertex: int) -> int:
        while root[vertex] != vertex:
            root[vertex] = root[root[vertex]]
            vertex = root[vertex]
        return vertex

    out = np.zeros(len(edges), bool)
    for row, (i, j) in zip(rows.tolist(), edges[rows].tolist(), strict=True):
        if degree[i] < 2 and degree[j] < 2 and (a := find(i)) != (b := find(j)):
            degree[i], degree[j], root[a] = degree[i] + 1, degree[j] + 1, b
            out[row] = True
    return out


def make_chain(graph: ViewGraph, backbone: Bools) -> Chain:
    """The chain of the backbone's edges (E,), which make paths; edges from a vertex to itself are left out."""
    graph, told = believed(graph, backbone)
    order, step_edge, path = _walk(graph.edges, graph.vertex_count, np.flatnonzero(backbone))
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    axes = free_axes(graph)
    covariance = se3.covariances(graph.information[:, axes[:, None], axes])
    rows = np.flatnonzero(~backbone & (graph.edges[:, 0] != graph.edges[:, 1]))
    low, high = np.sort(place[graph.edges[rows]], axis=1).T
    rows = rows[np.lexsort((high, low))]  # samples of the loops must not depend on the order of the file
    step, step_covariance = np.tile(np.eye(4), (len(order), 1, 1)), np.zeros((len(order), len(axes), len(axes)))
    at = np.flatnonzero(step_edge >= 0)
    step[at], step_covariance[at] = _directed(
        graph.i_from_j[step_edge[at]], covariance[step_edge[at]], place[graph.edges[step_edge[at], 0]] == at, axes
    )
    ends = place[graph.edges[rows]]
    motion, loop_covariance = _directed(graph.i_from_j[rows], covariance[rows], ends[:, 0] > ends[:, 1], axes)
    usual = np.median(np.einsum("eii->ei", np.concatenate([step_covariance[at], loop_covariance])), axis=0)
    step_covariance[at] += np.diag(SMALLEST_SIGMA**2 * usual)
    loop_covariance += np.diag(SMALLEST_SIGMA**2 * usual)
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
        told and not has_unit_information(graph),
    )


SMALLEST_SIGMA = 0.03
"""Of the usual standard deviation: none is believed to be much smaller. Beside one of a thousandth the normal
equations lose what the other edges say; from .01 to .1 the manhattan graph is judged alike.
"""


MOST_OF_A_STEP = 0.2
"""An odometry's error where it states no larger one, root mean squares. On 71 simulated graphs where nothing is stated
75 wrong loops were kept without it and 19 with it, 13 and 12 right ones lost.
"""
NOTHING_RAD, NOTHING_TIMES = np.pi, 100.0
"""Standard deviations of steps, in radians and in those of the middle one of three axes, from which on they state
nothing: robots on a floor fill the covariance of their odometry with 1e6 for what they assume and 1e3 for what they do
not know.
"""


def believed(graph: ViewGraph, steps: Bools) -> tuple[ViewGraph, bool]:
    """The graph with what is believed of its steps (E,), and whether that is what they state: an axis of which most of
    them state nothing errs as the others of its kind do, or by `MOST_OF_A_STEP` where that is more. Of unknown
    information, the identity, nothing is changed.
    """
    rows, axes = np.flatnonzero(steps), free_axes(graph)
    if has_unit_information(graph) or not len(rows):
        return graph, True
    covariance = se3.covariances(graph.information[rows[:, None, None], axes[:, None], axes])
    moved, spread = se3.log(graph.i_from_j[rows])[:, axes], np.sqrt(np.einsum("sii->si", covariance))
    usual, factor = np.median(spread, axis=0), np.ones_like(spread)
    for part, least in ((np.flatnonzero(axes < 3), NOTHING_RAD), (np.flatnonzero(axes >= 3), 0.0)):
        step = float(np.sqrt(np.mean(moved[:, part] ** 2)))
        told = usual[part] <= (least or max(step, NOTHING_TIMES * float(np.median(usual[part]))))
        if not told.all() and step > 0:
            others = np.sqrt(np.mean(spread[:, part[told]] ** 2, axis=1)) if told.any() else 0.0
            factor[:, part[~told]] = (np.maximum(others, MOST_OF_A_STEP * step) / spread[:, part[~told]].T).T
    if (factor == 1).all():
        return graph, True
    information = graph.information.copy()
    inverse = np.linalg.inv(factor[:, :, None] * covariance * factor[:, None, :])
    information[rows[:, None, None], axes[:, None], axes] = inverse
    return replace(graph, information=information), False


def free_axes(graph: ViewGraph) -> Ints:
    """Of a twist (6,) the axes in which the graph's frames move."""
    return PLANAR_AXES if graph.dimension == 2 else np.arange(6)


def linked(chain: Chain, low: int, high: int, motion: Floats, covariance: Floats) -> Chain:
    """The chain with the path `high` behind the path `low < high`, and a bridge of this motion (4, 4) between them."""
    second = chain.path == high
    after = int(np.flatnonzero(chain.path == low)[-1]) + 1
    moved = np.concatenate([np.arange(after), np.flatnonzero(second), np.flatnonzero(~second[after:]) + after])
    place = np.empty(chain.size, np.int64)
    place[moved] = np.arange(chain.size)
    step, step_covariance, bridged = chain.step[moved], chain.step_covariance[moved], chain.bridged[moved]
    step[after], step_covariance[after], bridged[after] = motion, covariance, True
    ends = place[chain.ends]
    loop, loop_covariance = _directed(chain.motion, chain.covariance, ends[:, 0] > ends[:, 1], chain.axes)
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


def _directed(motion: Floats, covariance: Floats, reverse: Bools, axes: Ints) -> tuple[Floats, Floats]:
    """Motions and covariances, of some the inverse: `Z⁻¹` has the covariance `Ad(Z) Σ Ad(Z)ᵀ`."""
    motion, covariance = motion.copy(), covariance.copy()
    turned = se3.adjoint(motion[reverse])[:, axes[:, None], axes]
    covariance[reverse] = turned @ covariance[reverse] @ np.swapaxes(turned, 1, 2)
    motion[reverse] = se3.inverse(motion[reverse])
    return motion, covariance


def _walk(edges: Ints, count: int, rows: Ints) -> tuple[Ints, Ints, Ints]:
    """Vertices (V,) path by path, the edge that leads to each (−1 at a beginning), and its path."""
    ends = np.flatnonzero(np.bincount(edges[rows].ravel(), minlength=count) < 2)
    component = connected_components(edges[rows], count)
    begins = ends[np.unique(component[ends], return_index=True)[1]]
    forest = spanning_forest(edges[rows], count, begins)
    path = np.argsort(np.argsort(begins))[component]
    order = np.lexsort((forest.depth, path))
    return order, np.append(rows, -1)[forest.parent_edge[order]], path[order]


def loops_at_place(ends: Floats) -> Floats:
    """How many loops (M,), each itself included, are of the place of each; `ends (M, 2)` are given in places."""
    near = cKDTree(ends).query_ball_point(ends, 1.0, p=np.inf, return_length=True) if len(ends) else []
    return np.asarray(near, float)


def one_of_each_place(ends: Floats) -> Ints:
    """Rows of loops, ascending, whose `ends (M, 2)` are given in places: first those that have the most others near."""
    tree, free, out = cKDTree(ends), np.ones(len(ends), bool), []
    for row in np.argsort(-loops_at_place(ends), kind="stable").tolist():
        if free[row]:
            out.append(row)
            free[tree.query_ball_point(ends[row], 1.0, p=np.inf)] = False
    return np.sort(np.array(out, np.int64))


def corridors(ends: Floats) -> Ints:
    """The runs (K,) of places that follow each other, of which loops have these ends (K, 2), in parts of up to
    `LONGEST_CORRIDOR`.
    """
    adjacent = cKDTree(ends).query_pairs(ADJACENT, p=np.inf, output_type="ndarray")
    run = connected_components(adjacent, len(ends))
    part, after = np.empty_like(run), 0
    for number in range(run.max(initial=-1) + 1):
        rows = np.flatnonzero(run == number)
        along = ends[rows, np.ptp(ends[rows], axis=0).argmax()]
        at = ((along - along.min()) / LONGEST_CORRIDOR).astype(np.int64)
        part[rows] = after + np.unique(at, return_inverse=True)[1]
        after = int(part[rows].max()) + 1
    return part


ADJACENT = 2.0
"""Places between places that follow each other: a corridor that is mistaken for another is one testimony."""
LONGEST_CORRIDOR = 5.0
"""Places of a mistaken corridor, of 20 steps or more each: a longer run is as many testimonies as it has such parts.
Without a limit none of 52 loops of a second lap counted, each of which says nothing alone beside 160 m of drift.
"""

"""The edges of a run as one table that grows by columns, and the viewing graph that solvers take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hodge_pipeline.errors import GraphError
from hodge_pipeline.types.arrays import Bools, Floats, Ints, Words

CANDIDATE, HELD_OUT, REJECTED = "candidate", "held_out", "rejected"
USED, IGNORED, DISABLED = "used", "ignored", "disabled"
"""The `status` of a row of `Edges`: proposed; held out to judge by; rejected by acceptance; an edge that counts; one to
which the solver gave no weight; one that a person disabled.
"""


@dataclass(frozen=True)
class Priors:
    """Unary pose priors: `vertices (P,)` rows, `world_from_vertex (P, 4, 4)`, `information (P, 6, 6)`.

    The information is of ξ = (rotation, translation) in `world_from_vertex · exp(ξ)`, radians and metres; a vertex may
    have several.
    """

    vertices: Ints
    world_from_vertex: Floats
    information: Floats

    def select(self, rows: Ints | Bools) -> Priors:
        """These priors only, in this order."""
        return Priors(self.vertices[rows], self.world_from_vertex[rows], self.information[rows])


@dataclass(frozen=True)
class Registration:
    """The registration of one pair; see `ViewGraph` for the meaning and units of each field.

    `iterations` counts the steps from the guess. A registrar that `converged` in none did not use the guess, so the
    pair is not registered again from other poses. `by_landmarks`: they gave the motion, not surfaces, which may slide.
    """

    i_from_j: Floats
    information: Floats
    fitness: float
    rmse_m: float
    correspondences: int
    iterations: int
    converged: bool
    by_landmarks: bool = False


@dataclass(frozen=True)
class ViewGraph:
    """The viewing graph, in columns. A million edges are arrays, not a million objects.

    - `vertex_ids (V,)` int64 or str, as the source names them; `edges (E, 2)` hold *rows* of it.
    - `i_from_j (E, 4, 4)`: moves points of vertex j into vertex i, for the edge (i, j) in the direction measured.
      Parallel edges are legal.
    - `information (E, 6, 6)`: inverse covariance of ξ = (rotation, translation) in `i_from_j · exp(ξ)`, radians and
      metres in j's axes.
    - `fitness (E,)`: share of cloud j with a correspondence, or of i where the registrar says so; `rmse_m (E,)`: their
      RMS distance; NaN where unknown.
    - `source (E,)`: where the edge comes from (sequential, overlap, sift, colmap, g2o, …).
    - `correspondences (E,)`: how many; 0 where unknown.
    - `dimension`: 2 for a graph in the plane z = 0, lifted, with no information out of it; it stays one when written.
    - `fixed`: rows of the vertices that the source holds at the poses it gives them.
    - `priors`: unary pose priors, None without any.
    """

    vertex_ids: NDArray[np.generic]
    edges: Ints
    i_from_j: Floats
    information: Floats
    fitness: Floats
    rmse_m: Floats
    source: NDArray[np.str_]
    correspondences: Ints
    dimension: int = 3
    fixed: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    priors: Priors | None = None

    def __repr__(self) -> str:
        return f"ViewGraph({self.vertex_count} vertices, {self.edge_count} edges)"

    @property
    def vertex_count(self) -> int:
        """How many vertices there are, isolated ones included."""
        return len(self.vertex_ids)

    @property
    def edge_count(self) -> int:
        """How many edges there are, parallel ones each."""
        return len(self.edges)

    @classmethod
    def from_edges(
        cls,
        vertex_ids: NDArray[np.generic],
        edges: Ints,
        i_from_j: Floats,
        information: Floats | None = None,
        source: str = "given",
        *,
        dimension: int = 3,
        fixed: Ints | None = None,
    ) -> ViewGraph:
        """A graph of measured edges; the information defaults to the identity, unknown columns are NaN or 0.

        Raises `GraphError` where there is not one motion (4, 4) and one information (6, 6) for each edge.
        """
        count = len(edges)
        for name, given, side in (("i_from_j", i_from_j, 4), ("information", information, 6)):
            if count and given is not None and np.shape(given) != (count, side, side):
                raise GraphError(f"{name} has the shape {np.shape(given)}: expected ({count}, {side}, {side})")
        return cls(
            vertex_ids=np.asarray(vertex_ids),
            edges=np.asarray(edges, np.int64).reshape(-1, 2),
            i_from_j=np.asarray(i_from_j, float).reshape(-1, 4, 4),
            information=np.broadcast_to(np.eye(6), (count, 6, 6)).copy()
            if information is None
            else np.asarray(information, float),
            fitness=np.full(count, np.nan),
            rmse_m=np.full(count, np.nan),
            source=np.full(count, source),
            correspondences=np.zeros(count, np.int64),
            dimension=dimension,
            fixed=np.zeros(0, np.int64) if fixed is None else np.asarray(fixed, np.int64),
        )

    def select(self, rows: Ints | Bools) -> ViewGraph:
        """The graph with these edges only, in this order; every vertex is kept."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in ("edges", "source", *MEASURED)}
        return replace(self, **columns)

    @classmethod
    def joined(cls, graphs: Sequence[ViewGraph]) -> ViewGraph:
        """One graph with the edges of all graphs in order, over the vertices of the first."""
        names = ("edges", "source", *MEASURED)
        columns: dict[str, Any] = {name: np.concatenate([getattr(graph, name) for graph in graphs]) for name in names}
        return replace(graphs[0], **columns)


@dataclass(frozen=True)
class Edges:
    """Every pair of views that a run knows of, in columns that fill from proposal to verdict; unknown is NaN or empty.

    - Proposed: `pairs (E, 2)`, rows of the vertices, in the direction measured, i < j where only proposed; parallel
      ones are legal. `proposed_by (E,)`: the reasons, joined by "+", or the format that a measured edge comes from.
      `overlap (E,)`: the score of the proposal in [0, 1].
    - Registered: `i_from_j`, `information`, `fitness`, `rmse_m`, `correspondences` as in `ViewGraph`, `iterations`, and
      whether it `converged`, and `by_landmarks`. `seen_through (E,)`: the share of the points in view that the other
      depth camera saw through, where surfaces gave the motion.
    - Accepted: `status (E,)`, one of the six words; `why (E,)`: the reason of a rejection, later of the verdict.
    - Solved: `weight (E,)` relative to its own information, `residual_m`, `residual_rad (E,)` under the poses.
    - Judged: `verdict (E,)`; `probability (E,)` that it is right, NaN where untestable; `leverage (E,)`: its share in
      fixing the poses of its ends.
    """

    pairs: Ints
    proposed_by: Words
    overlap: Floats
    i_from_j: Floats
    information: Floats
    fitness: Floats
    rmse_m: Floats
    seen_through: Floats
    correspondences: Ints
    iterations: Ints
    converged: Bools
    by_landmarks: Bools
    status: Words
    why: Words
    weight: Floats
    residual_m: Floats
    residual_rad: Floats
    verdict: Words
    probability: Floats
    leverage: Floats

    def __len__(self) -> int:
        return len(self.pairs)

    def __repr__(self) -> str:
        words, counts = np.unique(self.status, return_counts=True)
        parts = [f"{count} {word}" for word, count in zip(words.tolist(), counts.tolist(), strict=True)]
        return f"Edges({len(self)} pairs{': ' * bool(parts)}{', '.join(parts)})"

    @classmethod
    def of(cls, pairs: Ints | Sequence[Sequence[int]], proposed_by: str | Words = "") -> Edges:
        """Candidate pairs (P, 2) as they are; everything else is unknown."""
        pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
        count = len(pairs)
        number, word, whole = np.full(count, np.nan), np.full(count, ""), np.zeros(count, np.int64)
        nothing = np.array(np.nan)  # broadcast to every element, which takes no memory
        return cls(
            pairs=pairs,
            proposed_by=np.full(count, proposed_by),
            overlap=number,
            i_from_j=np.broadcast_to(nothing, (count, 4, 4)),
            information=np.broadcast_to(nothing, (count, 6, 6)),
            fitness=number,
            rmse_m=number,
            seen_through=number,
            correspondences=whole,
            iterations=whole,
            converged=np.zeros(count, bool),
            by_landmarks=np.zeros(count, bool),
            status=np.full(count, CANDIDATE),
            why=word,
            weight=number,
            residual_m=number,
            residual_rad=number,
            verdict=word,
            probability=number,
            leverage=number,
        )

    @classmethod
    def proposed(cls, pairs: Ints, proposed_by: str, overlap: Floats | None = None) -> Edges:
        """The table of an edge builder: distinct pairs (P, 2) of one reason, each turned to i < j, all sorted."""
        pairs = np.sort(np.asarray(pairs, np.int64).reshape(-1, 2), axis=1)
        order = np.lexsort((pairs[:, 1], pairs[:, 0]))
        table = cls.of(pairs[order], proposed_by)
        return table if overlap is None else replace(table, overlap=np.asarray(overlap, float)[order])

    @classmethod
    def measured(cls, graph: ViewGraph) -> Edges:
        """The edges of a graph, all of which count."""
        columns = {name: getattr(graph, name) for name in MEASURED}
        return replace(cls.of(graph.edges, graph.source), status=np.full(graph.edge_count, USED), **columns)

    def with_registrations(self, found: Sequence[Registration]) -> Edges:
        """The table with a registration of each row; all count until acceptance rejects some."""
        columns: dict[str, Any] = {"status": np.full(len(found), USED)}
        for name in (one.name for one in fields(Registration)):
            old = getattr(self, name)
            columns[name] = np.array([getattr(one, name) for one in found], old.dtype).reshape(-1, *old.shape[1:])
        return replace(self, **columns)

    def put(self, rows: Ints | Bools | slice, **columns: Any) -> Edges:
        """The table with new values in some rows of these columns."""
        filled: dict[str, NDArray[Any]] = {}
        for name, values in columns.items():
            old = getattr(self, name)
            filled[name] = old.astype(np.result_type(old, np.asarray(values)))  # a longer word must fit
            filled[name][rows] = values
        return replace(self, **filled)

    def select(self, rows: Ints | Bools | slice) -> Edges:
        """These rows only, in this order."""
        return Edges(*(getattr(self, column.name)[rows] for column in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Edges]) -> Edges:
        """These tables one after the other."""
        parts = [cls.of(np.zeros((0, 2), np.int64)), *parts]
        return cls(*(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(cls)))

    @property
    def counts(self) -> Bools:
        """The rows (E,) that a solver is given."""
        return np.isin(self.status, (USED, IGNORED))

    @property
    def in_graph(self) -> Bools:
        """The rows (E,) that are edges, those disabled by hand included."""
        return np.isin(self.status, (USED, IGNORED, DISABLED))

    @property
    def rejected_counts(self) -> dict[str, int]:
        """How many pairs were rejected for each reason."""
        reasons, counts = np.unique(self.why[self.status == REJECTED], return_counts=True)
        return dict(zip(reasons.tolist(), counts.tolist(), strict=True))

    def as_graph(self, vertex_ids: ArrayLike, rows: Ints | Bools | slice = slice(None)) -> ViewGraph:
        """The viewing graph of these rows, each of which must have a motion."""
        columns = {name: getattr(self, name)[rows] for name in MEASURED}
        pairs, source = self.pairs[rows], self.proposed_by[rows]
        return ViewGraph(vertex_ids=np.asarray(vertex_ids), edges=pairs, source=source, **columns)


MEASURED = ("i_from_j", "information", "fitness", "rmse_m", "correspondences")
"""The columns that `Edges` and `ViewGraph` have in common."""
REGISTERED = (*MEASURED, "seen_through", "iterations", "converged", "by_landmarks")
"""The columns of what a registrar finds."""

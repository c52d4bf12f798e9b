"""Energy of what the edges leave over: how much is gradient, curl of triangles, or loops that no triangle fills."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.cech import orient_edges
from hodge_pipeline.complex.parts import decompose, flag_of, one_form
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

PARTS = ("exact", "co-exact", "harmonic")
ALL_EDGES = "all edges"
BEFORE, AFTER = "before", "after"
MOST_PIECES = 8
MOST_EDGES = 50_000
CAVEAT = (
    "energy shares are of ω = log(T_i Z_ij T_j⁻¹) at the robust poses, unit weights, world origin at the centroid of "
    "each piece; where residual motions are large ω is only their linearisation, and wrong edges dominate it"
)
SHARE_CAVEAT = (
    "Inside one piece the three parts are orthogonal: their shares add up to the whole. Those of one source are "
    "of the sum of its three parts, which are orthogonal only together with the other sources."
)


@dataclass(frozen=True)
class EnergyRow:
    """Energy of some edges' ω: `rotation (3,)` in rad² and `translation (3,)` in m², by `PARTS`."""

    group: str
    when: str
    edges: int
    rotation: Floats
    translation: Floats

    @property
    def shares(self) -> tuple[Floats, Floats]:
        """Shares (3,) that add up to 1, of the rotation and of the translation; zeros where there is no energy."""
        return _share(self.rotation), _share(self.translation)


ROUNDING = 1e-20
"""Energies below it, squares of radians and metres, are those of rounding."""


def _share(energy: Floats) -> Floats:
    total = float(energy.sum())
    return energy / total if total > ROUNDING else np.zeros(3)


def energy_rows(
    graph: ViewGraph, world_from_cam: Floats, piece: Ints, kept: Bools
) -> tuple[tuple[EnergyRow, ...], tuple[str, ...]]:
    """Rows for all edges, each piece (V,) and each source, with every edge (`before`) and the `kept (E,)` ones
    (`after`); and in a line why there are none, where the graph is too large.

    ω is taken at the poses (V, 4, 4), with unit weights, the world's origin at the centroid of each piece.
    """
    inside = piece[graph.edges[:, 0]] == piece[graph.edges[:, 1]]
    inside &= graph.edges[:, 0] != graph.edges[:, 1]
    rows: list[EnergyRow] = []
    try:
        for when, chosen in ((BEFORE, inside), (AFTER, inside & kept)):
            rows += _rows(graph.select(np.flatnonzero(chosen)), world_from_cam, piece, when)
    except GraphError as error:
        return (), (f"energy shares are left out: {error}",)
    return tuple(sorted(rows, key=lambda row: _place(row.group))), ()


def in_words(rows: Sequence[EnergyRow]) -> tuple[str, ...]:
    """A line each for all edges before and after: 3 % exact, …"""
    lines = []
    for row in rows:
        if row.group == ALL_EDGES:
            told = [
                f"{kind} {_told(shares)}" for kind, shares in zip(("rotation", "translation"), row.shares, strict=True)
            ]
            which = "of all edges" if row.when == BEFORE else "of the edges kept"
            lines.append(f"{'; '.join(told)} ({which})")
    return tuple(lines)


def _told(shares: Floats) -> str:
    if not shares.any():
        return "none, nothing is left over"
    return ", ".join(f"{100 * share:.1f} % {part}" for share, part in zip(shares, PARTS, strict=True))


def _place(group: str) -> tuple[int, str]:
    return (("all", "piece", "source").index(group.split(" ")[0]), group)


def _rows(graph: ViewGraph, world_from_cam: Floats, piece: Ints, when: str) -> Iterator[EnergyRow]:
    if not graph.edge_count:
        return
    if graph.edge_count > MOST_EDGES:
        raise GraphError(f"there are more than {MOST_EDGES} edges")
    omega, oriented = one_form(graph, world_from_cam, piece), orient_edges(graph.edges, graph.vertex_count)
    found = decompose(flag_of(graph), omega)
    energy = np.stack([omega.weights[:, None] * part**2 for part in (found.exact, found.coexact, found.harmonic)])
    source = np.full(len(oriented.edges), "", graph.source.dtype)
    source[oriented.row[::-1]] = graph.source[::-1]
    for group, chosen in _groups(piece[oriented.edges[:, 0]], source):
        picked = energy[:, chosen]
        yield EnergyRow(
            group, when, int(chosen.sum()), picked[:, :, :3].sum(axis=(1, 2)), picked[:, :, 3:].sum(axis=(1, 2))
        )


def _groups(piece: NDArray[np.int64], source: NDArray[np.str_]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    yield ALL_EDGES, np.ones(len(piece), bool)
    pieces, sources = np.unique(piece), np.unique(source)
    if len(pieces) > 1:
        for number in pieces[:MOST_PIECES].tolist():
            yield f"piece {number}", piece == number
    if len(sources) > 1:
        for name in sources.tolist():
            yield f"source {name}", source == name

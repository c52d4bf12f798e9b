"""Energy of the 1-form, piece by piece and source by source: how much is exact, co-exact and harmonic."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.complex.cech import clique_counts, flag_complex, orient_edges
from hodge_pipeline.complex.coboundary import coboundary_0
from hodge_pipeline.complex.decomposition import hodge_decomposition
from hodge_pipeline.diagnosis.energy import MOST_TRIANGLES
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Floats, ViewGraph

PARTS = ("exact", "co-exact", "harmonic")
MOST_PIECES = 8
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


def _share(energy: Floats) -> Floats:
    total = float(energy.sum())
    return energy / total if total > 0 else np.zeros(3)


def energy_rows(graph: ViewGraph, diagnosis: Diagnosis) -> tuple[tuple[EnergyRow, ...], tuple[str, ...]]:
    """Rows for all edges, each piece and each source, with every edge (`before`) and those kept (`after`); and why not.

    ω is taken at the robust poses, with unit weights, the world's origin at the centroid of each piece.
    """
    inside = diagnosis.piece[graph.edges[:, 0]] == diagnosis.piece[graph.edges[:, 1]]
    inside &= graph.edges[:, 0] != graph.edges[:, 1]
    rows: list[EnergyRow] = []
    try:
        for when, chosen in (("before", inside), ("after", inside & diagnosis.kept)):
            rows += _rows(graph.select(np.flatnonzero(chosen)), diagnosis, when)
    except GraphError as error:
        return (), (f"energy shares are left out: {error}",)
    return tuple(sorted(rows, key=lambda row: _place(row.group))), ()


def _place(group: str) -> tuple[int, str]:
    return (("all", "piece", "source").index(group.split(" ")[0]), group)


def _rows(graph: ViewGraph, diagnosis: Diagnosis, when: str) -> Iterator[EnergyRow]:
    if not graph.edge_count:
        return
    if clique_counts(graph.edges, graph.vertex_count)[2] > MOST_TRIANGLES:
        raise GraphError(f"there are more than {MOST_TRIANGLES} triangles")
    i, j = graph.edges.T
    poses = _centred(diagnosis)
    omega = se3.log(poses[i] @ graph.i_from_j @ se3.inverse(poses[j]))
    oriented = orient_edges(graph.edges, graph.vertex_count)
    form, weights = oriented.pooled(omega, np.ones(graph.edge_count))
    complex_ = flag_complex(graph.edges, graph.vertex_count)
    d0 = coboundary_0(complex_.simplices[1], graph.vertex_count)
    found = hodge_decomposition(d0, complex_.coboundary(1), form, weights)
    energy = np.stack([weights[:, None] * part**2 for part in (found.exact, found.coexact, found.harmonic)])
    source = np.full(len(form), "", graph.source.dtype)
    source[oriented.row[::-1]] = graph.source[::-1]
    for group, chosen in _groups(diagnosis.piece[oriented.edges[:, 0]], source):
        picked = energy[:, chosen]
        yield EnergyRow(
            group, when, int(chosen.sum()), picked[:, :, :3].sum(axis=(1, 2)), picked[:, :, 3:].sum(axis=(1, 2))
        )


def _groups(piece: NDArray[np.int64], source: NDArray[np.str_]) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    yield "all edges", np.ones(len(piece), bool)
    pieces, sources = np.unique(piece), np.unique(source)
    if len(pieces) > 1:
        for number in pieces[:MOST_PIECES].tolist():
            yield f"piece {number}", piece == number
    if len(sources) > 1:
        for name in sources.tolist():
            yield f"source {name}", source == name


def _centred(diagnosis: Diagnosis) -> Floats:
    sizes = np.bincount(diagnosis.piece)
    poses = np.array(diagnosis.world_from_cam)
    sums = [np.bincount(diagnosis.piece, poses[:, axis, 3]) for axis in range(3)]
    poses[:, :3, 3] -= (np.stack(sums, axis=1) / sizes[:, None])[diagnosis.piece]
    return poses

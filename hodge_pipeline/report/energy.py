"""Energy of the residual motions: exact part (gradient), co-exact part (curl of triangles), harmonic part (loops)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hodge_pipeline.complex.energies import Energies
from hodge_pipeline.complex.parts import decompose, flag_of, one_form
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

PARTS = ("exact", "co-exact", "harmonic")
BEFORE, AFTER = "before", "after"
MOST_EDGES = 50_000
"""So many, half of them long loops, take 24 CPU s."""
CAVEAT = (
    "energy shares are of ω = log(T_i Z_ij T_j⁻¹) at the robust poses, unit weights, world origin at the centroid of "
    "each piece; where residual motions are large ω is only their linearisation, and wrong edges dominate it"
)


@dataclass(frozen=True)
class EnergyRow:
    """Energies of the ω of so many edges inside pieces: of all, `before`, or of those that are kept, `after`."""

    when: str
    edges: int
    energies: Energies

    @property
    def kinds(self) -> dict[str, tuple[float, tuple[float, ...]]]:
        """Of rotation (rad²) and of translation (m²): the energy, and the shares of `PARTS`; zeros where it is none."""
        shares = tuple(self.energies.shares.values())
        return {
            name: (self.energies.total[kind], tuple(share[kind] for share in shares))
            for kind, name in enumerate(("rotation", "translation"))
        }


def energy_rows(
    graph: ViewGraph, world_from_cam: Floats, piece: Ints, kept: Bools
) -> tuple[tuple[EnergyRow, ...], tuple[str, ...]]:
    """Rows for all edges inside a component `piece (V,)` and for the `kept (E,)` ones; none, and a note, where the
    graph is too large.

    ω is taken at the poses (V, 4, 4), with unit weights, the world's origin at the centroid of each piece.
    """
    inside = piece[graph.edges[:, 0]] == piece[graph.edges[:, 1]]
    inside &= graph.edges[:, 0] != graph.edges[:, 1]
    rows = []
    try:
        for when, chosen in ((BEFORE, inside), (AFTER, inside & kept)):
            if not chosen.any():
                continue
            if chosen.sum() > MOST_EDGES:
                raise GraphError(f"there are more than {MOST_EDGES} edges")
            part = graph.select(np.flatnonzero(chosen))
            complex_, omega = flag_of(part), one_form(part, world_from_cam, piece)
            rows.append(EnergyRow(when, len(omega.values), decompose(complex_, omega).energies(complex_.counts)))
    except GraphError as error:
        return (), (f"energy shares are left out: {error}",)
    return tuple(rows), ()


def in_words(rows: Sequence[EnergyRow]) -> tuple[str, ...]:
    """A line each for all edges before and after: 3 % exact, …"""
    lines = []
    for row in rows:
        told = [f"{kind} {_told(shares)}" for kind, (_, shares) in row.kinds.items()]
        lines.append(f"{'; '.join(told)} ({'of all edges' if row.when == BEFORE else 'of the edges kept'})")
    return tuple(lines)


def _told(shares: Sequence[float]) -> str:
    if not any(shares):
        return "none, nothing is left over"
    return ", ".join(f"{100 * share:.1f} % {part}" for share, part in zip(shares, PARTS, strict=True))

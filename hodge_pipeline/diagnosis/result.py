"""The result of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy import str_
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.complex.components import describe_components
from hodge_pipeline.diagnosis.cycles import Cycles
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.solvers.backbone.sequence import vertex_ranks
from hodge_pipeline.solvers.resistance import Network, effective_resistance
from hodge_pipeline.types import Bools, Edges, Floats, Ints, ViewGraph

VERDICTS = CONSISTENT, SUSPECT, WRONG, UNTESTABLE = "consistent", "suspect", "wrong", "untestable"
WORST_FIRST = (WRONG, SUSPECT, UNTESTABLE, CONSISTENT)


@dataclass(frozen=True)
class Diagnosis:
    """Every edge judged, and the poses of those that agree.

    - `verdict (E,)`: consistent, suspect, wrong or untestable; `probability (E,)` that it is right, NaN where
      untestable; `reason`: one line for each edge.
    - `kept (E,)`: edges in use: consistent ones, and untestable ones but for those from a vertex to itself and loops
      that are all that joins two backbones.
    - `residual_m`, `residual_deg (E,)`: against the robust poses; NaN between two pieces.
    - `leverage (E,)`: an edge's share in determining the relative pose of its ends, 1 where removing it splits its
      piece; 0 for one that is not kept.
    - `information (E, 6, 6)`: that the edges were judged with, in j's axes.
    - `cycles`; `witnesses_for`, `witnesses_against (E, 3)`: their rows, the most telling first, −1 for none.
    - `piece (V,)`: 0 the largest; `world_from_cam (V, 4, 4)`: each piece in the frame of its lowest id.
    - `network`: of the kept edges as resistors.
    - `notes`: counts and caveats, one line each; `findings`: those on what is wrong with many
      edges at once.
    """

    verdict: NDArray[str_]
    probability: Floats
    reason: tuple[str, ...]
    kept: Bools
    residual_m: Floats
    residual_deg: Floats
    leverage: Floats
    information: Floats
    cycles: Cycles
    witnesses_for: Ints
    witnesses_against: Ints
    piece: Ints
    world_from_cam: Floats
    network: Network
    notes: tuple[str, ...]
    findings: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        graph: ViewGraph,
        *,
        verdict: NDArray[str_],
        probability: Floats,
        reasons: Callable[[tuple[Floats, Floats]], tuple[str, ...]],
        kept: Bools,
        cycles: Cycles,
        witnesses: tuple[Ints, Ints],
        world_from_cam: Floats,
        tested: tuple[str, ...],
        findings: tuple[str, ...] = (),
    ) -> Diagnosis:
        """The diagnosis with these verdicts, whose pieces are those of the kept edges; `reasons` makes the lines from
        residuals (E,), metres and degrees; `tested`: notes on what tested the edges.
        """
        network = Network.of(graph.edges[kept], graph.vertex_count)
        piece = network.component
        apart = piece[graph.edges[:, 0]] != piece[graph.edges[:, 1]]
        by_id = np.argsort(vertex_ranks(graph))
        first = by_id[np.unique(piece[by_id], return_index=True)[1]]
        world_from_cam = se3.inverse(world_from_cam[first])[piece] @ world_from_cam
        displacement_m, angle = edge_residuals(graph, world_from_cam)
        residual = np.where(apart, np.nan, displacement_m), np.where(apart, np.nan, np.degrees(angle))
        leverage = np.where(kept, 1 - 1 / (1 + effective_resistance(graph.edges, kept, network)), 0.0)
        notes = f"edges: {count_verdicts(verdict)}", *tested, *describe_components(piece, graph.vertex_ids)
        columns = verdict, probability, reasons(residual), kept, *residual, leverage, graph.information, cycles
        return cls(*columns, *witnesses, piece, world_from_cam, network, notes, findings)

    def __repr__(self) -> str:
        return f"Diagnosis({len(self.verdict)} edges: {count_verdicts(self.verdict)})"

    def put_into(self, edges: Edges) -> Edges:
        """The table with the verdict on each edge of its graph, and why."""
        return edges.put(
            edges.in_graph,
            verdict=self.verdict,
            probability=self.probability,
            leverage=self.leverage,
            why=np.array(self.reason, dtype=np.str_),
        )


def count_verdicts(verdict: NDArray[str_]) -> str:
    """How many edges have each verdict, in words."""
    return ", ".join(f"{int((verdict == name).sum())} {name}" for name in (CONSISTENT, SUSPECT, WRONG, UNTESTABLE))

"""The diagnosis of a graph with a trusted backbone: each loop judged by the backbone and the other loops."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.closing import cycle_errors
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.cycles import Loops
from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.cycles import WITNESSES, Cycles
from hodge_pipeline.diagnosis.options import WRONG_BELOW
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG, Diagnosis
from hodge_pipeline.diagnosis.wording import distance
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.trust import Backbone
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

MOST_ENTRIES = 500_000
"""Most edges of all listed cycles together, of which the shortest are listed: a limit on memory."""
RIGHT_STEP = 0.99
"""The probability of a step that confirmed loops pass over; of a broken or contradicted step 1 − this."""


def judged_on_backbone(graph: ViewGraph, backbone: Backbone) -> Diagnosis:
    """The diagnosis by a backbone, whose steps are kept unless broken or contradicted."""
    kept = backbone.used
    in_loop = np.zeros(graph.edge_count, bool)
    in_loop[np.flatnonzero(kept)] = series_classes(graph.edges[kept], graph.vertex_count) >= 0
    piece = connected_components(graph.edges[kept], graph.vertex_count)
    tested = np.where(backbone.steps, in_loop, np.equal(*piece[graph.edges.T]))
    probability = np.where(tested, np.where(backbone.steps, RIGHT_STEP, backbone.right), np.nan)
    refuted = backbone.steps & ~kept | backbone.contradicted
    probability[refuted] = 1 - RIGHT_STEP
    untestable = np.isnan(probability)
    wrong = ~kept & (probability < WRONG_BELOW) & (refuted | backbone.found.confirmed)
    verdict = np.select([untestable, wrong, kept], [UNTESTABLE, WRONG, CONSISTENT], SUSPECT)
    cycles, cycle = _cycles(graph, backbone, in_loop)
    witness = np.pad(cycle[:, None], ((0, 0), (0, WITNESSES - 1)), constant_values=-1)
    return Diagnosis.of(
        graph,
        verdict=verdict,
        probability=probability,
        reasons=partial(_reasons, graph.edges, backbone, verdict),
        kept=kept,
        cycles=cycles,
        witnesses=(np.where(kept[:, None], witness, -1), np.where(kept[:, None], -1, witness)),
        world_from_cam=backbone.world_from_cam,
        tested=backbone.notes,
        findings=backbone.findings,
    )


def _cycles(graph: ViewGraph, backbone: Backbone, in_loop: Bools) -> tuple[Cycles, Ints]:
    """The cycle of each loop with the steps that it spans, and the row (E,) of the cycle of each loop, −1 for none.

    Listed are the shortest loops all of whose steps are in use and in a cycle of used edges.
    """
    chain = backbone.chain
    low, high = chain.ends.T
    torn = np.cumsum(chain.lacks(in_loop) | (chain.step_edge < 0))
    same = torn[low] == torn[high]
    order = np.flatnonzero(same)[np.argsort((high - low)[same], kind="stable")]
    order = order[np.cumsum((high - low)[order] + 1) <= MOST_ENTRIES]
    low, high, chords = low[order], high[order], chain.loop_edge[order]
    loops = _around(graph, chain, chords, low, high)
    row = np.full(graph.edge_count, -1, np.int64)
    row[chords] = np.arange(len(chords))
    return Cycles(loops, *cycle_errors(loops, graph.i_from_j), backbone.chi2[chords], backbone.used[chords]), row


def _around(graph: ViewGraph, chain: Chain, chords: Ints, low: Ints, high: Ints) -> Loops:
    """The cycles of loops (K,) from `low` to `high`, and back along the steps that they span."""
    offsets = np.concatenate([[0], np.cumsum(high - low + 1)])
    row = np.repeat(np.arange(len(chords)), high - low + 1)
    nth = np.arange(len(row)) - offsets[row]
    at = high[row] - np.maximum(nth - 1, 0)
    edge = np.where(nth == 0, chords[row], chain.step_edge[at])
    begin = chain.order[np.where(nth == 0, low[row], at)]
    return Loops(offsets, edge, np.where(graph.edges[edge, 0] == begin, 1, -1))


def _reasons(
    edges: Ints, backbone: Backbone, verdict: NDArray[np.str_], residual: tuple[Floats, Floats]
) -> tuple[str, ...]:
    """One line for each edge: what confirms or contradicts it, and its residual at the poses."""
    over = _passed_over(edges, backbone)
    others = int(backbone.loops_used.sum())
    lines = []
    for edge, name in enumerate(verdict.tolist()):
        if backbone.steps[edge] and name != WRONG:
            # loops over a bridge between two paths also pass over steps that lie in no cycle
            some = over[edge] > 0 and name != UNTESTABLE
            passed = f"{over[edge]} confirmed loops pass over it" if some else "no confirmed loop passes over it"
            lines.append(f"an edge of the backbone: {passed}")
            continue
        away = distance(residual[0][edge], residual[1][edge])
        if backbone.contradicted[edge]:
            lines.append(f"the other edges over the same steps contradict it: {away}")
        elif backbone.steps[edge]:
            lines.append(f"an edge of the backbone that {over[edge]} confirmed loops over it contradict: {away}")
        elif backbone.used[edge]:
            lines.append(f"it agrees with the backbone and {others - 1} other loops: {away}")
        elif name == UNTESTABLE and edges[edge, 0] == edges[edge, 1]:
            lines.append("it joins a vertex to itself and constrains no other")
        elif name == UNTESTABLE:
            lines.append("it joins two paths of the backbone that nothing else joins: nothing can test it")
        elif not others:
            lines.append(f"nothing confirms it, nor any other loop: {away}, which are the backbone's")
        else:
            fails = "it contradicts" if name == WRONG else "the evidence for it is too weak beside"
            lines.append(f"{fails} the backbone and {others} confirmed loops: {away}")
    return tuple(lines)


def _passed_over(edges: Ints, backbone: Backbone) -> Ints:
    """How many used loops (E,) pass over each step."""
    chain, out = backbone.chain, np.zeros(len(backbone.steps), np.int64)
    ends = chain.ends[backbone.loops_used & (chain.path[chain.ends[:, 0]] == chain.path[chain.ends[:, 1]])]
    over, steps = chain.over(ends), np.flatnonzero(chain.step_edge >= 0)
    out[chain.step_edge[steps]] = over[steps]
    out[backbone.merged] = over[chain.spans(edges[backbone.merged])[:, 1]]
    return out

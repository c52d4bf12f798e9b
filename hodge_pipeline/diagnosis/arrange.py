"""The best of several arrangements of a scene in which every pair was tried, and how the others vote."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.cycles import root_from_vertex, spanning_forest
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.joining import Joining, learn_joining
from hodge_pipeline.diagnosis.pieces import Alignment
from hodge_pipeline.diagnosis.placement import LENIENT, STRICT, Scene
from hodge_pipeline.diagnosis.rearrange import rearrange
from hodge_pipeline.diagnosis.robust_poses import Fit, fit
from hodge_pipeline.types import Bools, Floats, ViewGraph

ROUNDS = 2
ORDER_TRUST = 15.0
"""Nats for the arrangement found from the order of the views: evidence that places which look alike cannot fake."""
TEMPERATURE = 5.0
"""Nats: arrangements that are worse by more hardly vote; the evidence is coarser than its sum pretends."""


def best_arrangement(evidence: Evidence, graph: ViewGraph, starts: list[Alignment]) -> tuple[Fit, Floats]:
    """The fit of the arrangement that most speaks for, from these starts and from the order of the views where that
    tells; and the weighted share (E,) of the arrangements that each edge agrees with.
    """
    in_order = bool(np.ptp(evidence.prior) > 0) if len(evidence.prior) else False
    starts = [*starts, in_sequence(evidence)] if in_order else starts
    tried = [_settled(evidence, graph, start, in_order) for start in starts]
    values = [scene.total(found.poses, found.component) for scene, found in tried]
    leader = tried[int(np.argmax(values))][0]
    values = [leader.total(found.poses, found.component) for _, found in tried]
    values[-1] += ORDER_TRUST if in_order else 0.0
    glue = replace(leader, scales=LENIENT)
    fits = [_glued(evidence, graph, found, glue) for _, found in tried]
    weight = np.exp((np.array(values) - max(values)) / TEMPERATURE)
    votes = np.array([_agreeing(evidence, found) for found in fits])
    return fits[int(np.argmax(values))], np.asarray(weight @ votes / weight.sum())


def in_sequence(evidence: Evidence) -> Alignment:
    """The views chained along edges between neighbours in order; pieces where such an edge is missing."""
    rows = np.flatnonzero(np.abs(evidence.edges[:, 1] - evidence.edges[:, 0]) == 1)
    edges = evidence.edges[rows]
    chained = root_from_vertex(spanning_forest(edges, evidence.vertex_count), evidence.i_from_j[rows])
    return Alignment(connected_components(edges, evidence.vertex_count), chained)


def _settled(evidence: Evidence, graph: ViewGraph, start: Alignment, in_order: bool) -> tuple[Scene, Fit]:
    scene = Scene(evidence, Joining(evidence.reach_m, np.zeros(3)), STRICT, in_order)
    alignment = start
    for _ in range(ROUNDS):
        found = fit(evidence, graph, rearrange(scene, alignment), 1)
        alignment = Alignment(found.component, found.poses)
        joining = learn_joining(scene.joining, found.poses, found.component, _joined(evidence, found.used))
        scene = replace(scene, joining=joining)
    return scene, found


def _glued(evidence: Evidence, graph: ViewGraph, found: Fit, glue: Scene) -> Fit:
    pieces = rearrange(glue, Alignment(found.component, found.poses), whole_pieces=True)
    return fit(evidence, graph, pieces, 2)


def _joined(evidence: Evidence, used: Bools) -> Bools:
    out = np.zeros((evidence.vertex_count, evidence.vertex_count), bool)
    i, j = evidence.edges[used].T
    out[i, j] = out[j, i] = True
    return out


def _agreeing(evidence: Evidence, found: Fit) -> Floats:
    return np.asarray(np.where(found.used, np.maximum(0.0, 1 - found.chi2 / 90.0), 0.0))

"""Priors of single poses, such as satellite fixes, and which contradict the edges which count and the other priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import chi2_by_information, tail_gate, tail_weight
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS, SIGMAS
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.priors import with_world
from hodge_pipeline.solvers.reweighted import SETTLED
from hodge_pipeline.solvers.weights import PLANAR_AXES, UNUSED_PRIOR, dimension_of, edge_weights
from hodge_pipeline.types import Bools, Floats, Ints, Priors, ViewGraph
from hodge_pipeline.types.text import counted, suiting

LEAST_SHARE = 0.01
"""Share of right priors beyond the gate, or one of all where that is less, as for edges."""


def right_priors(graph: ViewGraph, priors: Priors, solved: Callable[[ViewGraph], Floats]) -> Bools:
    """Which priors (P,) count beside the edges of the graph: all, or those within the gate where fewer than half lie
    beyond it in a solve with Student's t.

    `solved` gives the poses (V, 4, 4) of a graph with its priors. Priors may err more than they state, as all do alike.
    """
    priors = as_solved(graph, priors)
    axes = _axes(priors)
    every, weights = np.ones(len(axes), bool), np.ones(len(axes))
    size = np.maximum(axes, 1)  # a prior that states nothing has a χ² of 0
    gate = np.array([tail_gate(each, min(LEAST_SHARE, 1 / len(axes))) for each in size.tolist()])
    middle = np.asarray(chdtri(size, 0.5))
    for _ in range(MOST_ROUNDS):
        weighted = replace(priors, information=weights[:, None, None] * priors.information)
        chi2 = chi2_of_priors(graph, priors, solved(replace(graph, priors=weighted)))
        if (chi2 <= gate).all():
            return every
        known = axes > 0
        scaled = chi2 / max(float(np.median(chi2[known] / middle[known])), 1.0)
        before, weights = weights, np.minimum(tail_weight(scaled, axes), 1.0)
        if np.abs(weights - before).max() < SETTLED:
            break
    right = scaled <= gate
    return right if 2 * (~right).sum() < (axes > 0).sum() else every  # else nothing tells which: the edges may be wrong


def as_solved(graph: ViewGraph, priors: Priors) -> Priors:
    """The priors with the information that a solve heeds: of a planar graph that in the plane, of others none that
    lacks axes of both rotation and translation.
    """
    whole, _ = with_world(graph, priors, None, None)
    of_priors, dimension = whole.select(np.arange(graph.edge_count, whole.edge_count)), dimension_of(graph)
    axes = PLANAR_AXES if dimension == 2 else np.arange(6)
    heeded = np.ix_(edge_weights(of_priors, dimension).used, axes, axes)
    information = np.zeros(of_priors.information.shape)
    information[heeded] = of_priors.information[heeded]
    return replace(priors, information=information)


def chi2_of_priors(graph: ViewGraph, priors: Priors, world_from_cam: Floats) -> Floats:
    """χ² (P,) of the priors at poses (V, 4, 4)."""
    whole, poses = with_world(graph, priors, world_from_cam, None)
    return np.maximum(chi2_by_information(whole.select(np.arange(graph.edge_count, whole.edge_count)), poses), 0.0)


def excess_of_priors(graph: ViewGraph, priors: Priors, world_from_cam: Floats) -> float:
    """By how many times what they state priors are off, √(mean χ² of an axis)."""
    priors = as_solved(graph, priors)
    return float(np.sqrt(chi2_of_priors(graph, priors, world_from_cam).sum() / max(_axes(priors).sum(), 1)))


def _axes(priors: Priors) -> Ints:
    """How many numbers each prior states, (P,)."""
    return np.asarray(np.linalg.matrix_rank(priors.information, hermitian=True), np.int64)


def left_out_note(graph: ViewGraph, priors: Priors, right: Bools, world_from_cam: Floats) -> str:
    """How many priors do not count, and the farthest of them: see `_farthest`."""
    return (
        f"{counted(int((~right).sum()), 'prior is|priors are')} left out of {len(right)}, since the edges and the "
        f"other priors contradict them: {_farthest(graph, priors, right, world_from_cam)}"
    )


def priors_told(graph: ViewGraph, kept: ViewGraph) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Notes on the graph's priors, and findings where they contradict its edges; `kept`: the edges that count."""
    priors = graph.priors
    if priors is None or not len(priors.vertices):
        return (), ()
    unused = int((_axes(as_solved(graph, priors)) == 0).sum())
    notes = (f"{counted(unused, 'prior')} {UNUSED_PRIOR}",) if unused else ()
    if unused == len(priors.vertices):
        return notes, ()

    def solved(chosen: ViewGraph) -> Floats:
        return solve(chosen).world_from_cam

    right = right_priors(kept, priors, solved)
    poses = solved(replace(kept, priors=priors.select(right)))
    excess = excess_of_priors(kept, priors.select(right), poses)
    tested, wrong = len(right) - unused, int((~right).sum())
    used = tested - wrong
    told = (
        f"{counted(used, 'prior is|priors are')} off by {excess:.2g} times what {suiting(used, 'it states|they state')}"
    )
    findings = []
    if wrong:
        contradict = f"{wrong} of {counted(tested, 'prior')} {suiting(wrong, 'contradicts|contradict')} the edges"
        findings.append(f"{contradict} and the others: {_farthest(graph, priors, right, poses)}")
    if excess > SIGMAS:
        findings.append(told)
    return (*notes, *dict.fromkeys((told, *findings))), tuple(findings)


def _farthest(graph: ViewGraph, priors: Priors, right: Bools, world_from_cam: Floats) -> str:
    """The prior that is not right and farthest from the poses (V, 4, 4): in degrees where they state no place."""
    out = np.flatnonzero(~right)
    off = se3.inverse(world_from_cam[priors.vertices[out]]) @ priors.world_from_vertex[out]
    stated = np.einsum("pii->pi", priors.information[out]) > 0
    shift = priors.world_from_vertex[out, :3, 3] - world_from_cam[priors.vertices[out], :3, 3]
    far_m = np.linalg.norm(shift * stated[:, 3:], axis=1)
    turn_deg = np.degrees(np.linalg.norm(se3.log(off)[:, :3], axis=1))
    row = int(np.argmax(far_m if far_m.any() else turn_deg))
    how = f"{far_m[row]:.3g} m" if far_m.any() else f"{turn_deg[row]:.3g}°"
    return f"that of vertex {graph.vertex_ids[priors.vertices[out[row]]]} is {how} off"

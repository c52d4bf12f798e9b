"""Parallel edges fused into one: odometry, as of wheels and of a scan matcher, and loops that are written again."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import has_unit_information, in_vertex_order, tail_gate
from hodge_pipeline.solvers.backbone.credible import free_axes
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.solvers.backbone.levels import FEWEST
from hodge_pipeline.solvers.backbone.step_tests import closes, gate_of
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph


@dataclass(frozen=True)
class Fused:
    """A graph with one edge for each step, and one for each loop, fused from all that measure it and agree.

    Rows of the graph that was given: `rows (E',)` of its edges; `merged (N,)` of edges fused into its steps;
    `contradicted (K,)` of edges, steps among them, that the others over the same steps contradict; `copies (C,)` of
    loops fused into the loops `copied (C,)`.
    """

    graph: ViewGraph
    rows: Ints
    merged: Ints
    contradicted: Ints
    copies: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    copied: Ints = field(default_factory=lambda: np.zeros(0, np.int64))


def fused(graph: ViewGraph, repeats: Bools) -> Fused:
    """The graph in which parallel edges of `repeats (E,)` are replaced by their information-weighted mean; one whose
    distance from the first exceeds the χ² gate stays an edge of its own.
    """
    whole = np.arange(graph.edge_count)
    first, second = _repeated(graph, np.flatnonzero(repeats))
    if len(second) < FEWEST:
        return Fused(graph, whole, whole[:0], whole[:0])
    graph = in_vertex_order(graph)[0]
    apart, chi2 = _apart(graph, first, second)
    agree = chi2 <= _usual(graph, chi2) * tail_gate(len(free_axes(graph)), 1 / len(chi2))
    motions, total = _mean(graph, first[agree], second[agree], apart[agree])
    left = np.setdiff1d(whole, second[agree])
    return Fused(replace(graph, i_from_j=motions, information=total).select(left), left, second[agree], whole[:0])


def loops_once(given: Fused, loops: Bools) -> Fused:
    """The graph in which copies among the `loops (E,)` of the graph that was given count once: their mean, with the
    information of one, since all register the same two views.

    Copies differ from the first by no more than usual and close as short cycles do. The scale of errors is else that of
    the copies.
    """
    graph = in_vertex_order(given.graph)[0]
    limits = gate_of(graph.i_from_j[~loops[given.rows]])
    first, second = _repeated(graph, np.flatnonzero(loops[given.rows]))
    if not len(second):
        return given
    apart, chi2 = _apart(graph, first, second)
    near = closes(graph.i_from_j[first], graph.i_from_j[second], limits)
    agree = near & (chi2 <= _usual(graph, chi2[near]) * tail_gate(len(free_axes(graph)), 1 / len(chi2)))
    first, second = first[agree], second[agree]
    motions, total = _mean(graph, first, second, apart[agree])
    if not has_unit_information(graph):
        total /= 1 + np.bincount(first, minlength=graph.edge_count)[:, None, None]
    graph = replace(graph, i_from_j=motions, information=total)
    left = np.setdiff1d(np.arange(graph.edge_count), second)
    copies, copied = given.rows[second], given.rows[first]
    return replace(given, graph=graph.select(left), rows=given.rows[left], copies=copies, copied=copied)


def _repeated(graph: ViewGraph, rows: Ints) -> tuple[Ints, Ints]:
    """For each of these edges (rows) but the first between two vertices: that first one, and itself."""
    i, j = np.sort(graph.edges[rows], axis=1).T
    rows, pair = rows[i != j], (i * graph.vertex_count + j)[i != j]
    _, begin, group = np.unique(pair, return_index=True, return_inverse=True)
    first = rows[begin][group]
    return first[first != rows], rows[first != rows]


def _apart(graph: ViewGraph, first: Ints, second: Ints) -> tuple[Floats, Floats]:
    """The twists (N, 6) from the first edges to the second ones, and their χ² (N,)."""
    axes = free_axes(graph)
    apart = se3.log(se3.inverse(graph.i_from_j[first]) @ graph.i_from_j[second])
    both = se3.covariances(graph.information[np.concatenate([first, second])][:, axes[:, None], axes])
    return apart, mahalanobis(apart[:, axes], both[: len(first)] + both[len(first) :])[0]


def _usual(graph: ViewGraph, chi2: Floats) -> float:
    """The usual χ² per axis, no less than is stated; of few edges as stated, or that of exact copies."""
    least = np.finfo(float).eps if has_unit_information(graph) else 1.0
    return max(float(np.median(chi2)) / len(free_axes(graph)), least) if len(chi2) >= FEWEST else least


def _mean(graph: ViewGraph, first: Ints, second: Ints, apart: Floats) -> tuple[Floats, Floats]:
    """The motions (E, 4, 4) and information (E, 6, 6) where the second edges are fused into the first ones; the
    identity, for unknown information, stays.
    """
    axes, information, total = free_axes(graph), graph.information[second], graph.information.copy()
    pull = np.zeros((graph.edge_count, 6))
    np.add.at(total, first, information)
    np.add.at(pull, first, np.einsum("nij,nj->ni", information, apart))
    motions, changed = graph.i_from_j.copy(), np.unique(first)
    mean = np.zeros((len(changed), 6))
    spread = se3.covariances(total[changed[:, None, None], axes[:, None], axes])
    mean[:, axes] = np.einsum("nij,nj->ni", spread, pull[changed[:, None], axes])
    motions[changed] = motions[changed] @ se3.exp(mean)
    return motions, graph.information if has_unit_information(graph) else total

"""Parallel odometry edges, such as of wheels and of a scan matcher, fused into one edge for each step."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import has_unit_information, in_vertex_order, tail_gate
from hodge_pipeline.solvers.backbone.chain import free_axes
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.types import Bools, Ints, ViewGraph

FEWEST = 10
"""Fewest repeated steps whose differences are enough to estimate how much is usual."""


@dataclass(frozen=True)
class Fused:
    """A graph with one edge for each step, fused from all that measure it and agree.

    Rows of the graph that was given: `rows (E',)` of its edges; `merged (N,)` of edges fused into these;
    `contradicted (K,)` of edges, steps among them, that the others over the same steps contradict.
    """

    graph: ViewGraph
    rows: Ints
    merged: Ints
    contradicted: Ints


def fused(graph: ViewGraph, repeats: Bools) -> Fused:
    """The graph in which parallel edges of `repeats (E,)` are replaced by their information-weighted mean; one whose
    distance from the first exceeds the χ² gate stays an edge of its own.
    """
    whole, (i, j) = np.arange(graph.edge_count), np.sort(graph.edges, axis=1).T
    rows = np.flatnonzero(repeats & (i != j))
    _, begin, group = np.unique((i * graph.vertex_count + j)[rows], return_index=True, return_inverse=True)
    first = rows[begin][group]
    second, first = rows[first != rows], first[first != rows]
    if len(second) < FEWEST:
        return Fused(graph, whole, whole[:0], whole[:0])
    axes, unknown, graph = free_axes(graph), has_unit_information(graph), in_vertex_order(graph)[0]
    apart = se3.log(se3.inverse(graph.i_from_j[first]) @ graph.i_from_j[second])
    both = se3.covariances(graph.information[np.concatenate([first, second])][:, axes[:, None], axes])
    chi2 = mahalanobis(apart[:, axes], both[: len(first)] + both[len(first) :])[0]
    usual = max(float(np.median(chi2)) / len(axes), np.finfo(float).eps if unknown else 1.0)
    agree = chi2 <= usual * tail_gate(len(axes), 1 / len(chi2))
    first, second, apart, information = first[agree], second[agree], apart[agree], graph.information[second[agree]]
    total, pull = graph.information.copy(), np.zeros((graph.edge_count, 6))
    np.add.at(total, first, information)
    np.add.at(pull, first, np.einsum("nij,nj->ni", information, apart))
    motions, changed = graph.i_from_j.copy(), np.unique(first)
    mean = np.zeros((len(changed), 6))
    spread = se3.covariances(total[changed[:, None, None], axes[:, None], axes])
    mean[:, axes] = np.einsum("nij,nj->ni", spread, pull[changed[:, None], axes])
    motions[changed] = motions[changed] @ se3.exp(mean)
    left = np.setdiff1d(whole, second)
    total = graph.information if unknown else total
    return Fused(replace(graph, i_from_j=motions, information=total).select(left), left, second, whole[:0])

"""Whether the errors that a graph states explain what its solution leaves over."""

from __future__ import annotations

import math

from hodge_pipeline.complex.judging import has_unit_information
from hodge_pipeline.solvers.weights import is_planar
from hodge_pipeline.types import Solution, ViewGraph

SIGMAS = 3.0
"""Standard deviations of χ², √(2 degrees of freedom), by which it may exceed these."""


def is_explained(graph: ViewGraph, solution: Solution) -> bool:
    """Whether the χ² of a maximum-likelihood solution of all edges of a graph is no more than the graph's information
    has chance make of it; False where the information is the identity that stands for unknown.
    """
    if has_unit_information(graph):
        return False
    axes = 3 if graph.dimension == 2 or is_planar(graph) else 6
    tree = graph.vertex_count - int(solution.component.max(initial=-1)) - 1
    freedom = axes * (graph.edge_count - tree)
    return not freedom or solution.metrics["objective"] <= freedom + SIGMAS * math.sqrt(2 * freedom)

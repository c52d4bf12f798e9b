"""Whether the information of a graph's edges explains what their maximum-likelihood solution leaves over."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import chdtri

from hodge_pipeline.complex.chi2 import EXACT, MEDIAN_CHI2, chi2_by_information, has_unit_information
from hodge_pipeline.solvers.backbone.levels import SIGMAS
from hodge_pipeline.solvers.weights import PLANAR_AXES, dimension_of, measured_axes
from hodge_pipeline.types import Bools, Floats, Solution, ViewGraph


def is_explained(graph: ViewGraph, solution: Solution) -> bool:
    """Whether the χ² of the maximum-likelihood solution of all edges agrees with its degrees of freedom; False where
    the information is the identity that stands for unknown. Its standard deviation is √(2 degrees of freedom).
    """
    if has_unit_information(graph):
        return False
    freedom = degrees_of_freedom(graph, solution)
    return freedom <= 0 or solution.metrics["objective"] <= freedom + SIGMAS * math.sqrt(2 * freedom)


def is_each_explained(graph: ViewGraph, world_from_cam: Floats) -> bool:
    """Whether the largest χ² of an edge at poses (V, 4, 4) is one that chance reaches among as many edges."""
    chi2, size = _chi2(graph, world_from_cam)
    return bool(chi2.max(initial=0.0) <= chdtri(size, LEAST_SHARE / max(len(chi2), 1)))


def is_each_usual(graph: ViewGraph, world_from_cam: Floats, steps: Bools) -> bool:
    """Whether the largest χ² of the `steps (E,)` at poses (V, 4, 4), and of the other edges, is one that chance reaches
    by errors of which the median of each is the usual one.
    """
    chi2, size = _chi2(graph, world_from_cam)
    for each in (chi2[steps], chi2[~steps]):
        each = each[each > EXACT * each.max(initial=0.0)]
        if len(each) and each.max() > np.median(each) / MEDIAN_CHI2[size] * chdtri(size, LEAST_SHARE / len(chi2)):
            return False
    return True


def _chi2(graph: ViewGraph, world_from_cam: Floats) -> tuple[Floats, int]:
    """The χ² (E,) of the edges at poses (V, 4, 4), and how many axes it has."""
    return chi2_by_information(graph, world_from_cam), len(PLANAR_AXES) if dimension_of(graph) == 2 else 6


LEAST_SHARE = 0.01
"""Share of graphs whose largest χ² may be larger by chance. Without this one wrong edge that nothing tests bent the
other 5600 of a city's streets: 6.1 m for 0.95.
"""


def degrees_of_freedom(graph: ViewGraph, solution: Solution) -> int:
    """How many more numbers edges and priors state than the poses of their solution have."""
    axes = PLANAR_AXES if dimension_of(graph) == 2 else np.arange(6)
    stated = int(measured_axes(graph.information[:, axes[:, None], axes]).sum())
    with_prior = np.zeros(0, np.int64) if graph.priors is None else graph.priors.vertices
    free = np.ones(int(solution.component.max(initial=-1)) + 1, np.int64)  # gauge: one pose of each component
    free[solution.component[with_prior]] = 0
    held = np.maximum(np.bincount(solution.component[graph.fixed], minlength=len(free)), free).sum()
    return stated + len(axes) * int(len(with_prior) - graph.vertex_count + held)

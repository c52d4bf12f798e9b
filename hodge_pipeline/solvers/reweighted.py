"""Iteratively reweighted least squares: weights of edges by Student's t, from their residuals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hodge_pipeline.complex.chi2 import chi2_by_information, student_weight
from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.solvers.weights import dimension_of
from hodge_pipeline.types import Floats, Solution, ViewGraph

ROUNDS, SETTLED = 4, 1e-2
"""Most rounds, and the largest change of a weight that ends them: less moves no edge in or out."""
ROUNDING = 1e-9
"""Radians, and share of the poses' distance from the origin: more than rounding adds up to in thousands of products."""


def reweighted(
    graph: ViewGraph,
    weights: Floats,
    solution: Solution,
    solved: Callable[[Floats, Floats], Solution],
    registered: bool = False,
) -> tuple[Floats, Solution]:
    """The weights (E,), at most those given, and the solution that they lead to; `solution` is that of the given ones.

    `solved` gives the solution of weights (E,) from poses (V, 4, 4); `registered`: see `student_weight`. An edge in no
    cycle, which priors alone contradict, keeps a weight: without it they would leave a part of the graph free to turn.
    """
    used, axes = weights > 0, 3 if dimension_of(graph) == 2 else 6
    needed = np.zeros_like(used)
    if graph.priors is not None:
        needed[used] = series_classes(graph.edges[used], graph.vertex_count) < 0
    for _ in range(ROUNDS):
        chi2 = np.maximum(chi2_by_information(graph, solution.world_from_cam), 0.0)
        usual = chi2[used & (chi2 > _chi2_of_rounding(graph, solution.world_from_cam))]
        new = np.where(used, student_weight(chi2, axes, usual=usual, registered=registered, needed=needed), 0.0)
        if np.abs(new - weights).max(initial=0.0) < SETTLED:
            break
        weights, solution = new, solved(new, solution.world_from_cam)
    return weights, solution


def _chi2_of_rounding(graph: ViewGraph, world_from_cam: Floats) -> Floats:
    """The χ² (E,) of what rounding leaves over at poses (V, 4, 4), as of edges of a path, which no cycle tests."""
    far = float(np.abs(world_from_cam[:, :3, 3]).max(initial=0.0))
    squares = (ROUNDING * np.repeat([1.0, far], 3)) ** 2
    return np.asarray(np.einsum("eii,i->e", graph.information, squares))

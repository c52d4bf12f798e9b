"""Credible information on the steps of an odometry, where what they state cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import has_unit_information
from hodge_pipeline.solvers.weights import PLANAR_AXES
from hodge_pipeline.types import Bools, Ints, ViewGraph

MOST_OF_A_STEP = 0.2
"""Bound on the error of odometry as a share of its motion (root mean squares), unless it states more. On 71 simulated
graphs without information 75 wrong loops were kept without it and 19 with it, 13 and 12 right ones lost.
"""
NOTHING_TIMES = 100.0
"""Multiple of the standard deviation of the median axis of the translation beyond which an axis of it is unconstrained;
one of the rotation is beyond half a turn. Robots on a floor have 1e6 in their odometry's covariance for what they
assume, 1e3 for the unknown.
"""


def credible_steps(graph: ViewGraph, steps: Bools) -> tuple[ViewGraph, bool]:
    """The graph with credible information on its steps (E,), and whether that is what they state.

    Along an axis that most steps leave unconstrained, errors are set to those of the other axes of rotation or
    translation, or to `MOST_OF_A_STEP` of the motion where that is more. The identity, for unknown information, stays.
    """
    rows, axes = np.flatnonzero(steps), free_axes(graph)
    if has_unit_information(graph) or not len(rows):
        return graph, True
    covariance = se3.covariances(graph.information[rows[:, None, None], axes[:, None], axes])
    moved, spread = se3.log(graph.i_from_j[rows])[:, axes], np.sqrt(np.einsum("sii->si", covariance))
    usual, factor = np.median(spread, axis=0), np.ones_like(spread)
    for part, least in ((axes < 3, np.pi), (axes >= 3, 0.0)):
        step = float(np.sqrt(np.mean(moved[:, part] ** 2)))
        is_free = usual > (least or max(step, NOTHING_TIMES * float(np.median(usual[part]))))
        free, stated = part & is_free, part & ~is_free
        if free.any() and step > 0:
            others = np.sqrt(np.mean(spread[:, stated] ** 2, axis=1, keepdims=True)) if stated.any() else 0.0
            factor[:, free] = np.maximum(others, MOST_OF_A_STEP * step) / spread[:, free]
    if (factor == 1).all():
        return graph, True
    information = graph.information.copy()
    inverse = np.linalg.inv(factor[:, :, None] * covariance * factor[:, None, :])
    information[rows[:, None, None], axes[:, None], axes] = inverse
    return replace(graph, information=information), False


def free_axes(graph: ViewGraph) -> Ints:
    """The axes (p,) of a twist in which the graph's frames move."""
    return PLANAR_AXES if graph.dimension == 2 else np.arange(6)

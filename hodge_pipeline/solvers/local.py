"""A descent in the neighbourhood of a few edges, all else held: most of what a change of them moves is near."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order

from hodge_pipeline.solvers.full import FullObjective
from hodge_pipeline.solvers.minimise import descend_isotropic, full_objective
from hodge_pipeline.solvers.newton import Limits, descend
from hodge_pipeline.solvers.problem import Problem, make_problem
from hodge_pipeline.solvers.setup import Setup
from hodge_pipeline.types import Floats, Ints

SHARE = 10
"""One free vertex in so many moves."""
FEWEST = 500
"""Below it the whole graph is solved as fast."""


def settled_nearby(setup: Setup, changed: Ints, limits: Limits, full: bool) -> Setup:
    """The set-up with start poses that are at their best near the changed edges (rows of the problem's)."""
    problem = setup.problem
    most = problem.free_count // SHARE
    if not len(changed) or most < FEWEST:
        return setup
    inside = np.zeros(problem.count, bool)
    inside[_nearest(problem, changed, most)] = True
    inside[problem.free_count :] = False
    edges = np.flatnonzero((inside[problem.tail] | inside[problem.head]) & (problem.kappa > 0))
    vertices, ends = np.unique(np.stack([problem.tail[edges], problem.head[edges]]), return_inverse=True)
    local = make_problem(
        ends.reshape(2, -1).T,
        problem.rotations[edges],
        problem.translations[edges],
        problem.kappa[edges],
        problem.tau[edges],
        ~inside[vertices],
    )
    rotations, translations = setup.initial("given")
    places = vertices[local.order]
    begin = rotations[places], translations[places]
    if full:
        objective = FullObjective.of(local, full_objective(setup).information[edges])
        end = descend(objective, objective.at(*begin), limits, setup.rounding).point
    else:
        end = descend_isotropic(local, begin, limits, setup.rounding).point
    rotations[places], translations[places] = end.rotations, end.translations
    return _with_start(setup, rotations, translations)


def _nearest(problem: Problem, changed: Ints, most: int) -> Ints:
    """The first vertices that a breadth-first search from the ends of the changed edges reaches."""
    ends = np.unique(np.concatenate([problem.tail[changed], problem.head[changed]]))
    root = problem.count
    tail = np.concatenate([problem.tail, np.full(len(ends), root)])
    head = np.concatenate([problem.head, ends])
    ones = np.ones(len(tail), np.int32)
    adjacency = csr_matrix((ones, (tail, head)), shape=(root + 1, root + 1))
    found = breadth_first_order(adjacency, root, directed=False, return_predecessors=False)
    return np.asarray(found[1 : most + 1], np.int64)


def _with_start(setup: Setup, rotations: Floats, translations: Floats) -> Setup:
    start, d, order = setup.start.copy(), setup.dimension, setup.problem.order
    start[order, :d, :d], start[order, :d, 3] = rotations, translations
    return replace(setup, start=start)

"""A descent in the neighbourhood of a few edges, all other poses held: a change of these edges moves few poses far."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order

from hodge_pipeline.solvers.full_information import FullObjective
from hodge_pipeline.solvers.minimise import descend_isotropic, full_objective
from hodge_pipeline.solvers.newton import Descent, Limits, descend, still_to_come
from hodge_pipeline.solvers.problem import make_problem
from hodge_pipeline.solvers.setup import Setup
from hodge_pipeline.types import Floats, Ints

SHARE = 10
"""One free vertex in so many moves at most."""
FEWEST = 500
"""Below it the whole graph is solved as fast."""
GROWTH, GROWTHS = 4, 2
"""The neighbourhood's, from the smallest on."""
LEAST_SHARE = 0.25
"""Of what one growth wins, that the next one is expected to win: what is far decays slowly."""


def settled_nearby(setup: Setup, changed: Ints, limits: Limits, full: bool) -> tuple[Setup, float]:
    """The set-up with start poses that are at their best near the changed edges (rows of the problem's), and what the
    poses farther off may still win: foretold from what the neighbourhood won as it grew.
    """
    most = setup.problem.free_count // SHARE
    if not len(changed):
        return setup, 0.0
    if most < FEWEST:
        return setup, math.inf
    nearest, poses, won = _nearest(setup, changed, most), setup.initial("given"), [0.0]
    for growth in range(GROWTHS, -1, -1):
        end = _settled(setup, nearest[: most // GROWTH**growth], poses, limits, full)
        won.append(end.costs[0] - end.costs[-1])
    return _with_start(setup, *poses), still_to_come(won[-1], won[-2], LEAST_SHARE)


def _settled(setup: Setup, moving: Ints, poses: tuple[Floats, Floats], limits: Limits, full: bool) -> Descent:
    """The descent of the poses of some vertices, written to where the others are."""
    problem, (rotations, translations) = setup.problem, poses
    inside = np.zeros(problem.count, bool)
    inside[moving] = True
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
    places = vertices[local.order]
    begin = rotations[places], translations[places]
    if full:
        objective = FullObjective.of(local, full_objective(setup).information[edges])
        found = descend(objective, objective.at(*begin), limits, setup.rounding)
    else:
        found = descend_isotropic(local, begin, limits, setup.rounding)
    rotations[places], translations[places] = found.point.rotations, found.point.translations
    return found


def _nearest(setup: Setup, changed: Ints, most: int) -> Ints:
    """The first vertices that a breadth-first search from the ends of the changed edges reaches."""
    problem = setup.problem
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

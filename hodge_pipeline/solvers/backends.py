"""The two ways to solve a graph's linear systems, and which is cheaper on which graph.

SuperLU factorises; multigrid preconditions conjugate gradients, at a cost that grows with the graph alone and not with
its fill. (CHOLMOD was tried in SuperLU's place: after the block elimination it is hardly faster on any graph.)
"""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from hodge_pipeline.solvers.cg import solved_columns
from hodge_pipeline.solvers.direct import factor_s, laplacian_step_s
from hodge_pipeline.solvers.elimination import Elimination, Ordering, plan_elimination, unordered
from hodge_pipeline.solvers.linear import CHAIN_EDGES_PER_VERTEX, Factor, factorise, fill_reducing_order
from hodge_pipeline.solvers.multigrid import Coarsening, Modes, Preconditioning, multigrid
from hodge_pipeline.types import Floats, Ints

ITERATIVE_FROM = 15_000
"""Vertices: below, a factorisation and a hundred solves cost less than the hierarchies."""
WIDEST = 20.0
"""Of the levels of what the block elimination leaves over, as a share of the square root of its vertices: those of
towns of 20,000 to 80,000 poses are up to 16. Of wider ones, as in a tangle, the order itself would cost too much.
"""
SECONDS_A_BLOCK = 2e-5
"""Seconds of a Newton step by multigrid, for each block of its matrix: measured."""
LAPLACIAN_STEPS = 20
"""Steps of CG with the scalar Laplacians for a Newton step of such towns."""
JOINT_SIZE = 6
"""Rows of a block of rotations and translations together."""
SCALAR_TOLERANCE, MAX_SCALAR_STEPS = 1e-12, 300
"""Of conjugate gradients with one number to a vertex: as exact as a factorisation."""


def choose(tail: Ints, head: Ints, count: int, direct: bool = False) -> tuple[Preconditioning | None, Elimination]:
    """What preconditions linear systems of a graph, None where they are factorised, and its plan of elimination.

    Of edges (tail, head), those with an end at or past `count` lead to pinned vertices. It is the cheaper of a
    factorisation, whose fill is foretold, and multigrid; where one will be needed (`direct`), it is a factorisation.
    """
    if direct or count <= ITERATIVE_FROM:
        return None, plan_elimination(tail, head, count, fill_reducing_order)
    if len(tail) < CHAIN_EDGES_PER_VERTEX * count:
        plan = plan_elimination(tail, head, count, _order_of_narrow)
        by_cg = factor_s(plan, 1) + LAPLACIAN_STEPS * laplacian_step_s(plan)
        if min(by_cg, factor_s(plan, JOINT_SIZE)) < SECONDS_A_BLOCK * (count + 2 * len(tail)):
            return None, plan
    return _multigrid(), unordered(count)


def _order_of_narrow(core: csc_matrix) -> Ordering:
    """The core's order, at infinite cost where the core is too wide to be worth the look."""
    size = int(core.shape[0])
    if not size or _width(core) <= WIDEST * math.sqrt(size):
        return fill_reducing_order(core)
    return Ordering(np.arange(size), math.inf, math.inf)


def _width(core: csc_matrix) -> float:
    """How many vertices lie within one level of a breadth-first search, by the median of a narrow order's band."""
    place = np.argsort(reverse_cuthill_mckee(csr_matrix(core), symmetric_mode=True))
    columns = np.repeat(np.arange(core.shape[1]), np.diff(core.indptr))
    reach = np.abs(place[core.indices] - place[columns])
    return float(np.median(np.maximum.reduceat(reach, core.indptr[:-1])))


def laplacian_factor(laplacian: csc_matrix, precondition: Preconditioning | None) -> Factor:
    """What solves with a scalar Laplacian (n, n), its rows in the order of elimination, to the rounding of a factor."""
    if precondition is None or not laplacian.shape[0]:
        return factorise(laplacian, "NATURAL")
    matrix = csr_matrix(laplacian)
    blocks = matrix.tobsr((1, 1))
    apply = precondition(blocks, Modes())

    def solve(rhs: Floats) -> Floats:
        return solved_columns(
            lambda x: np.asarray(matrix @ x), lambda r: apply(blocks, r), rhs, SCALAR_TOLERANCE, MAX_SCALAR_STEPS
        )

    return Factor(int(matrix.shape[0]), solve)


def _multigrid() -> Preconditioning:
    """Multigrid for matrices that share their patterns, as those of one problem do."""
    coarsening = Coarsening()
    return lambda matrix, modes: multigrid(matrix, modes, lambda coarse: factorise(coarse).solve, coarsening).cycle

"""Covariances of solved poses: a few columns of the inverse of the Gauss-Newton Hessian, by selected solves.

ξ = (rotation, translation) in the pose's own axes, T · exp(ξ), radians and metres; to first order around the minimum.
"""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.full_information import FullObjective
from hodge_pipeline.solvers.linear import factorise_blocks
from hodge_pipeline.solvers.priors import with_world
from hodge_pipeline.solvers.setup import Setup, prepare
from hodge_pipeline.solvers.weights import PLANAR_AXES
from hodge_pipeline.types import Floats, Ints, ViewGraph


def marginal_covariances(graph: ViewGraph, world_from_cam: Floats, vertices: Ints) -> Floats:
    """Covariances (K, 6, 6) of the poses of these vertex rows; priors count as in `solve`.

    Zeros for what is held still: the graph's fixed vertices, and the first vertex of each component without any.
    `world_from_cam (V, 4, 4)` must be the full objective's minimum. In the plane the other rows are zero.
    """
    vertices = np.asarray(vertices, np.int64)
    joint, _ = _joint_covariance(graph, world_from_cam, vertices)
    return np.stack([joint[k, :, k] for k in range(len(vertices))]) if len(vertices) else np.zeros((0, 6, 6))


def relative_covariances(graph: ViewGraph, world_from_cam: Floats, pairs: Ints) -> Floats:
    """Covariances (P, 6, 6) of `T_i⁻¹ T_j · exp(ξ)` for pairs of vertex rows (P, 2), whatever the free gauge.

    Raises `GraphError` for a pair in two components, which no edge relates.
    """
    pairs = np.asarray(pairs, np.int64).reshape(-1, 2)
    vertices, inverse = np.unique(pairs, return_inverse=True)
    joint, setup = _joint_covariance(graph, world_from_cam, vertices)
    apart = setup.component[pairs[:, 0]] != setup.component[pairs[:, 1]]
    if apart.any():
        i, j = graph.vertex_ids[pairs[np.argmax(apart)]]
        raise GraphError(f"vertices {i} and {j} are in two components: no edge relates them")
    first, second = inverse.reshape(-1, 2).T
    moved = se3.adjoint(se3.inverse(world_from_cam[pairs[:, 1]]) @ world_from_cam[pairs[:, 0]])
    transposed = np.swapaxes(moved, 1, 2)
    cross = moved @ joint[first, :, second]
    return np.asarray(
        joint[second, :, second] + moved @ joint[first, :, first] @ transposed - cross - np.swapaxes(cross, 1, 2)
    )


def _joint_covariance(graph: ViewGraph, world_from_cam: Floats, vertices: Ints) -> tuple[Floats, Setup]:
    """The covariance (K, 6, K, 6) of these vertices together."""
    if graph.priors is not None and len(graph.priors.vertices):
        graph, world_from_cam = with_world(graph, graph.priors, world_from_cam, None)
    setup = prepare(graph, world_from_cam, graph.fixed, direct=True)
    if not setup.weights.definite:
        raise GraphError("covariances need positive semi-definite information: mend the indefinite matrices")
    problem = setup.problem
    objective = FullObjective.of(problem, setup.weights.information[setup.weights.used])
    point = objective.at(*setup.initial("given"))
    _, hessian = objective.normal_equations(point.left)
    size, free = problem.tangent_size + problem.dimension, problem.free_count
    position = np.empty(problem.count, np.int64)
    position[problem.order] = np.arange(problem.count)
    place = position[vertices]
    moving = np.flatnonzero(place < free)
    rows = (place[moving, None] * size + np.arange(size)).reshape(-1)
    columns = np.zeros((free * size, len(rows)))
    columns[rows, np.arange(len(rows))] = 1.0
    inverse = (
        factorise_blocks(problem.structure.elimination, hessian)
        .solve(columns)[rows]
        .reshape(len(moving), size, len(moving), size)
    )
    body = np.zeros((len(moving), size, size))
    p = problem.tangent_size
    turned = np.swapaxes(point.rotations[place[moving]], 1, 2)
    body[:, :p, :p], body[:, p:, p:] = (turned if p == 3 else 1.0), turned
    local = np.einsum("aij,ajbk,blk->aibl", body, inverse, body)
    axes = np.arange(6) if size == 6 else PLANAR_AXES
    joint = np.zeros((len(vertices), 6, len(vertices), 6))
    joint[np.ix_(moving, axes, moving, axes)] = local
    return joint, setup

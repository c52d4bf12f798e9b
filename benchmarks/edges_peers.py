"""The same edges through two other programs: Open3D's line process and GTSAM's graduated non-convexity.

Each answers (kept edges (E,), poses (V, 4, 4), piece (V,)). Their settings are plain defaults, not tuned to the
graphs: a lever of 2 m between rotation and translation, an error of 5 cm.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.complex.cycles import root_from_vertex, spanning_forest
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

Answer = tuple[Bools, Floats, Ints]
LEVER_M = 2.0
SIGMA_M = 0.05
LINE_PROCESS_M = 0.2
POINTS = 1000.0


def consecutive(graph: ViewGraph) -> Bools:
    """The edges between neighbours in order, which other systems trust."""
    return np.asarray(np.abs(graph.edges[:, 1] - graph.edges[:, 0]) == 1)


def open3d_line_process(graph: ViewGraph) -> Answer:
    """Open3D's global optimisation as its reconstruction system calls it: odometry certain, the rest uncertain."""
    import open3d as o3d

    module = o3d.pipelines.registration
    trusted = consecutive(graph)
    start = _odometry_start(graph, trusted)
    problem = module.PoseGraph()
    for pose in start:
        problem.nodes.append(module.PoseGraphNode(pose))
    information = POINTS * np.diag([LEVER_M**2] * 3 + [1.0] * 3)
    for (i, j), motion, certain in zip(graph.edges.tolist(), graph.i_from_j, trusted, strict=True):
        # Open3D's edge (a, b) moves a into b
        problem.edges.append(module.PoseGraphEdge(j, i, motion, information, uncertain=not certain))
    options = module.GlobalOptimizationOption(
        max_correspondence_distance=LINE_PROCESS_M,
        edge_prune_threshold=0.25,
        preference_loop_closure=1.0,
        reference_node=0,
    )
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        module.global_optimization(
            problem,
            module.GlobalOptimizationLevenbergMarquardt(),
            module.GlobalOptimizationConvergenceCriteria(),
            options,
        )
    poses = np.array([node.pose for node in problem.nodes])
    left = {(edge.target_node_id, edge.source_node_id) for edge in problem.edges}
    kept = np.array([tuple(pair) in left for pair in graph.edges.tolist()])
    return kept, poses, connected_components(graph.edges[kept], graph.vertex_count)


def gtsam_gnc(graph: ViewGraph, trust_odometry: bool, stated: bool = False) -> Answer:
    """GTSAM's GNC with truncated least squares, the 99 % threshold; `stated`: with the graph's own information."""
    import gtsam

    trusted = consecutive(graph)
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.array([SIGMA_M / LEVER_M] * 3 + [SIGMA_M] * 3))
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for (i, j), motion, information in zip(graph.edges.tolist(), graph.i_from_j, graph.information, strict=True):
        if stated:
            flat = np.diag(information) == 0  # in the plane nothing leaves it
            noise = gtsam.noiseModel.Gaussian.Information(information + np.diag(flat * 1.0))
        factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(motion), noise))
    component = connected_components(graph.edges, graph.vertex_count)
    firm = gtsam.noiseModel.Diagonal.Sigmas(np.full(6, 1e-4))
    start = _odometry_start(graph, trusted)
    roots = np.unique(component, return_index=True)[1]
    for vertex, pose in enumerate(start):
        values.insert(vertex, gtsam.Pose3(pose))
    for root in roots.tolist():
        factors.add(gtsam.PriorFactorPose3(root, gtsam.Pose3(start[root]), firm))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    known = list(range(graph.edge_count, graph.edge_count + len(roots)))
    parameters.setKnownInliers([*(np.flatnonzero(trusted).tolist() if trust_odometry else []), *known])
    optimizer = gtsam.GncLMOptimizer(factors, values, parameters)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    result = optimizer.optimize()
    kept = np.asarray(optimizer.getWeights())[: graph.edge_count] > 0.5
    poses = np.array([result.atPose3(vertex).matrix() for vertex in range(graph.vertex_count)])
    return kept, poses, connected_components(graph.edges[kept], graph.vertex_count)


Peer = Callable[[ViewGraph], Answer]
PEERS: dict[str, dict[str, Peer]] = {
    "open3d": {"Open3D line process": open3d_line_process},
    "gtsam": {
        "GTSAM GNC, odometry": lambda graph: gtsam_gnc(graph, True),
        "GTSAM GNC": lambda graph: gtsam_gnc(graph, False),
    },
}
"""By the module that each needs."""


def installed_peers() -> dict[str, Peer]:
    """The peers whose library is here; a line on stderr for each that is not."""
    found: dict[str, Peer] = {}
    for module, peers in PEERS.items():
        if importlib.util.find_spec(module) is not None:
            found |= peers
        else:
            print(f"without {' and '.join(peers)}: {module} is missing: pip install '.[bench]'", file=sys.stderr)
    return found


def _odometry_start(graph: ViewGraph, trusted: Bools) -> Floats:
    """Poses chained along consecutive edges; over a gap along any other edge."""
    order = np.argsort(~trusted, kind="stable")
    forest = spanning_forest(graph.edges[trusted], graph.vertex_count)
    poses = root_from_vertex(forest, graph.i_from_j[trusted])
    component = connected_components(graph.edges[trusted], graph.vertex_count)
    for edge in order.tolist():
        i, j = graph.edges[edge]
        if component[i] == component[j]:
            continue
        moving = component == component[j]
        poses[moving] = poses[i] @ graph.i_from_j[edge] @ se3.inverse(poses[j]) @ poses[moving]
        component[moving] = component[i]
    return np.asarray(poses)

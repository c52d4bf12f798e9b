"""The other solvers, each on its own objective: GTSAM (chordal start and Gauss-Newton; GNC) and g2o (from the file)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from clock import Times, timed

from hodge_pipeline.types import Ints, ViewGraph


def _problem(path: Path) -> Any:
    import gtsam

    factors, _ = gtsam.readG2o(str(path), True)
    return gtsam, factors


def gtsam_seconds(path: Path, graph: ViewGraph, repeats: int) -> Times | str:
    """What GTSAM takes (it reads q_vec as an angle), or why there is no figure. 3-D only."""
    try:
        gtsam, factors = _problem(path)
        first = int(graph.vertex_ids[0])
        factors.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))

        def run() -> Any:
            start = gtsam.InitializePose3.initialize(factors)
            return gtsam.GaussNewtonOptimizer(factors, start).optimize()

        return timed(run, repeats)[0]
    except ImportError:
        return "not installed"
    except RuntimeError:
        return "fails"


def gnc_weights(path: Path, graph: ViewGraph) -> tuple[Times, Any] | str:
    """What GTSAM's graduated non-convexity takes from its chordal start, edges of neighbours in time trusted, and the
    weight of each edge.
    """
    try:
        gtsam, factors = _problem(path)
    except ImportError:
        return "not installed"
    first = int(graph.vertex_ids[0])
    factors.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    trusted: Ints = np.flatnonzero(graph.edges[:, 1] - graph.edges[:, 0] == 1)
    parameters = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    parameters.setKnownInliers([*trusted.tolist(), factors.size() - 1])

    def run() -> Any:
        optimizer = gtsam.GncLMOptimizer(factors, gtsam.InitializePose3.initialize(factors), parameters)
        optimizer.optimize()
        return optimizer.getWeights()

    seconds, weights = timed(run, 1)
    return seconds, np.asarray(weights)[: graph.edge_count]


def g2o_seconds(path: Path, dimension: int) -> tuple[Times, float] | str:
    """What g2o takes from the file's own poses by Levenberg-Marquardt, and the chi² that it ends at."""
    try:
        import g2opy as g2o
    except ImportError:
        return "not installed"
    kind = "SE2" if dimension == 2 else "SE3"
    optimizer = g2o.SparseOptimizer()
    blocks = getattr(g2o, f"BlockSolver{kind}")(getattr(g2o, f"LinearSolverEigen{kind}")())
    optimizer.set_algorithm(g2o.OptimizationAlgorithmLevenberg(blocks))
    if not optimizer.load(str(path)) or not optimizer.vertices():
        return "no start"
    optimizer.vertex(min(optimizer.vertices())).set_fixed(True)
    optimizer.initialize_optimization()
    seconds, _ = timed(lambda: optimizer.optimize(100), 1)
    return seconds, float(optimizer.active_chi2())

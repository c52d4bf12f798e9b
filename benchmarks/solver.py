"""How long the maximum-likelihood solver takes, and how good its minimum is: prints one Markdown table.

    python benchmarks/solver.py                       # the real graphs of HODGE_DATA, GTSAM beside where importable
    python benchmarks/solver.py --synthetic 10000 100000 1000000
    python benchmarks/solver.py --files my.g2o

CPU seconds, the median of several calls, reading excluded; every graph runs in a process of its own, whose peak memory
is given. F is the isotropic objective with the file's information as it stands (as SE-Sync reads it), chi² the full one
(as g2o reads it). Set OMP_NUM_THREADS=1 to compare with other solvers on one thread.
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hodge_adapters.g2o import information_for_file, load_g2o
from hodge_pipeline import se3
from hodge_pipeline.solvers.hodge import solve
from hodge_pipeline.types import Floats, Ints, Solution, ViewGraph

CERTIFIED_OPTIMA = {
    "smallGrid3D": 1025.39806,
    "parking-garage": 1.26252443,
    "sphere_bignoise_vertex3": 2961756.490,
    "sphere2500": 1687.005814,
    "torus3D": 24227.04556,
    "cubicle": 717.125991,
}
SYNTHETIC = ("cylinder", "trajectory", "lattice", "sphere")
COLUMNS = (
    "graph", "V / E", "F", "F / optimum − 1", "CPU s", "certified", "CPU s with it", "chi²", "CPU s", "GTSAM CPU s",
    "GTSAM / F", "GTSAM / chi²", "peak MB",
)  # fmt: skip


def cylinder(count: int) -> tuple[Floats, Ints]:
    """Rings of 100 poses, each joined to the ring below twice: loops everywhere."""
    k = np.arange(count)
    angle = 2 * np.pi * k / 100
    radius = 100 / (2 * np.pi)
    position = np.stack([radius * np.cos(angle), radius * np.sin(angle), k / 100], axis=1)
    poses = se3.from_parts(se3.so3_exp(np.outer(angle, [0, 0, 1])), position)
    return poses, np.concatenate([np.stack([k[:-s], k[s:]], axis=1) for s in (1, 100, 101)])


def trajectory(count: int) -> tuple[Floats, Ints]:
    """A random walk in a grid of streets, with a loop closure at three in ten returns: like a chain."""
    rng = np.random.default_rng(0)
    heading = np.repeat(rng.integers(0, 4, count // 10 + 1), 10)[:count]
    position = np.cumsum(np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[heading], axis=0)
    turns = se3.so3_exp(np.outer(heading * np.pi / 2, [0, 0, 1]))
    poses = se3.from_parts(turns, np.pad(position, ((0, 0), (0, 1))).astype(float))
    place = position[:, 0] * 10**7 + position[:, 1]
    order = np.argsort(place, kind="stable")
    returns = np.stack([order[:-1], order[1:]], axis=1)[np.diff(place[order]) == 0]
    returns = returns[(returns[:, 1] - returns[:, 0] > 1) & (rng.random(len(returns)) < 0.3)]
    k = np.arange(count)
    return poses, np.concatenate([np.stack([k[:-1], k[1:]], axis=1), returns])


def sphere(count: int) -> tuple[Floats, Ints]:
    """Rings of 44 poses on a sphere, each joined to the next and to three of the ring above."""
    k = np.arange(count)
    turn, tilt = 2 * np.pi * k / 44, np.pi * (k + 1) / (count + 1)
    position = 50 * np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    rotation = se3.so3_exp(np.outer(turn, [0, 0, 1])) @ se3.so3_exp(np.outer(tilt, [0, 1, 0]))
    return se3.from_parts(rotation, position), np.concatenate(
        [np.stack([k[:-s], k[s:]], axis=1) for s in (1, 43, 44, 45)]
    )


def chained(graph: ViewGraph) -> Floats:
    """Poses by a walk along the edges from each vertex to the next: a start that leads to a local minimum."""
    steps = graph.i_from_j[np.flatnonzero(graph.edges[:, 1] - graph.edges[:, 0] == 1)]
    poses = [np.eye(4)]
    for step in steps:
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def lattice(count: int) -> tuple[Floats, Ints]:
    """A cube of poses turned at random, each joined to its six neighbours: the worst fill."""
    side = round(count ** (1 / 3))
    k = np.arange(side**3).reshape(side, side, side)
    position = np.stack(np.unravel_index(np.arange(side**3), k.shape), axis=1).astype(float)
    poses = se3.from_parts(se3.so3_exp(np.random.default_rng(1).normal(size=(side**3, 3))), position)
    pairs = [(k.take(range(side - 1), axis), k.take(range(1, side), axis)) for axis in range(3)]
    return poses, np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


SHAPES: dict[str, tuple[Callable[[int], tuple[Floats, Ints]], float, float]] = {
    "cylinder": (cylinder, 0.05, 0.1),
    "trajectory": (trajectory, 0.01, 0.02),
    "lattice": (lattice, 0.05, 0.1),
    "sphere": (sphere, 0.35, 0.5),
}


def synthetic(shape: str, count: int) -> ViewGraph:
    """A modelled graph with noise of this many radians and metres an axis."""
    make, sigma_rad, sigma_m = SHAPES[shape]
    poses, edges = make(count)
    sigma = np.repeat([sigma_rad, sigma_m], 3)
    noise = sigma * np.random.default_rng(2).normal(size=(len(edges), 6))
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ se3.exp(noise)
    information = np.tile(np.diag(sigma**-2), (len(edges), 1, 1))
    return ViewGraph.from_edges(np.arange(len(poses)), edges, measured, information)


def timed(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """The median CPU seconds of some calls, and what the last one gave."""
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        result = call()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds), result


def gtsam_seconds(path: Path, dimension: int, graph: ViewGraph, repeats: int) -> str:
    """CPU seconds of GTSAM's chordal start and Gauss-Newton, on another objective (it reads q_vec as an angle)."""
    try:
        import gtsam
    except ImportError:
        return "not installed"
    if dimension == 2:
        return ""
    try:
        factors, _ = gtsam.readG2o(str(path), True)
        first = int(graph.vertex_ids[0])
        factors.add(gtsam.PriorFactorPose3(first, gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))

        def run() -> Any:
            start = gtsam.InitializePose3.initialize(factors)
            return gtsam.GaussNewtonOptimizer(factors, start).optimize()

        seconds, _ = timed(run, repeats)
    except RuntimeError:
        return "fails"
    return f"{seconds:.3f}"


def row(task: tuple[str, str | int, int]) -> list[str]:
    """One line of the table."""
    name, what, repeats = task
    path, dimension = Path(str(what)), 3
    if isinstance(what, int):
        graph = synthetic(name, what)
        isotropic = graph
    else:
        file = load_g2o(path)
        graph, dimension = file.graph, file.graph.dimension
        raw = np.roll(information_for_file(graph.information), (3, 3), axis=(1, 2))
        isotropic = graph if dimension == 2 else dataclasses.replace(graph, information=raw)
    plain_s, plain = timed(lambda: solve(isotropic, objective="isotropic"), repeats)
    certified_s, certified = (
        (float("nan"), plain)
        if graph.vertex_count > 20_000
        else timed(lambda: solve(isotropic, objective="isotropic", certificate=True), repeats)
    )
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    full_s, full = timed(lambda: solve(graph), repeats)
    other = "" if isinstance(what, int) else gtsam_seconds(path, dimension, graph, repeats)
    optimum = CERTIFIED_OPTIMA.get(path.stem)
    cost = plain.metrics["objective"]
    return [
        name,
        f"{graph.vertex_count} / {graph.edge_count}",
        f"{cost:.10g}",
        "" if optimum is None else f"{cost / optimum - 1:+.1e}",
        f"{plain_s:.3f}",
        {1.0: "yes", 0.0: "no"}.get(certified.metrics.get("certified", -1.0), ""),
        "" if np.isnan(certified_s) else f"{certified_s:.3f}",
        chi2_cell(full),
        f"{full_s:.3f}",
        other,
        *(ratio(other, seconds) for seconds in (plain_s, full_s)),
        f"{peak_mb:.0f}",
    ]


def ratio(other: str, seconds: float) -> str:
    """How many times as long the other solver took, where it did."""
    return f"{float(other) / seconds:.1f}" if other.replace(".", "").isdigit() else ""


def chi2_cell(solution: Solution) -> str:
    """The chi², or that there is none."""
    return f"{solution.metrics['chi2']:.9g}" if "chi2" in solution.metrics else "indefinite"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--synthetic", nargs="*", type=int, default=[], metavar="POSES")
    parser.add_argument("--shapes", nargs="*", choices=SYNTHETIC, default=SYNTHETIC)
    parser.add_argument("--files", nargs="*", type=Path, default=[])
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    data = Path(os.environ.get("HODGE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    files = options.files or ([] if options.synthetic else sorted((data / "pose_graphs").glob("*/*.g2o")))
    tasks: list[tuple[str, str | int, int]] = [(path.stem, str(path), options.repeats) for path in files]
    tasks += [(s, n, options.repeats if n <= 10_000 else 1) for n in options.synthetic for s in options.shapes]
    print("|" + "|".join(COLUMNS) + "|", "|" + "---|" * len(COLUMNS), sep="\n", flush=True)
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for cells in pool.imap(row, tasks):
            print("|" + "|".join(cells) + "|", flush=True)


if __name__ == "__main__":
    main()

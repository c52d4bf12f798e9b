"""How long the maximum-likelihood solver takes, and how good its minimum is: prints the tables of solver.md.

    OMP_NUM_THREADS=1 python benchmarks/solver.py --write              # benchmarks/solver.md, all but the largest
    OMP_NUM_THREADS=1 python benchmarks/solver.py --write --million    # and graphs of a million poses
    python benchmarks/solver.py --files my.g2o --synthetic             # these only

Seconds are medians of several calls, reading excluded; every graph runs in a process of its own, whose peak memory is
given. F is the isotropic objective with the file's information as it stands (as SE-Sync reads it), chi² the full one
(as g2o reads it). The real graphs are those of HODGE_DATA; GTSAM and g2o run beside where they can be imported
(`pip install hodge-pipeline[bench]`).
"""

from __future__ import annotations

import argparse
import dataclasses
import multiprocessing
import os
import platform
import resource
import tempfile
from collections.abc import Iterator
from datetime import date
from pathlib import Path

import numpy as np
import scipy
from clock import Times, timed
from peers import g2o_seconds, gnc_weights, gtsam_seconds
from pose_graphs import SHAPES, synthetic, with_wrong_edges

from hodge_adapters.pose_graphs.g2o import information_for_file, load_g2o, write_g2o
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.objective import gradient, residuals
from hodge_pipeline.solvers.setup import prepare
from hodge_pipeline.types import Solution, ViewGraph

CERTIFIED_OPTIMA = {
    "smallGrid3D": 1025.39806,
    "parking-garage": 1.26252443,
    "sphere2500": 1687.005814,
    "torus3D": 24227.04556,
    "cubicle": 717.125991,
    "MIT": 61.1541155246,
    "CSAIL": 31.7037158836,
    "intel": 52.3482272865,
    "manhattan": 6431.39138722,
    "kitti_00": 125.693514968,
    "kitti_05": 276.514377003,
}
DEFAULT_SHAPES = ["cylinder", "trajectory", "streets", "lattice"]
MOST_CERTIFIED = 6000
GTSAM_TO = {"trajectory": 100_000, "streets": 10_000}
COLUMNS = (
    "graph", "V / E", "F", "F / optimum − 1", "CPU s", "wall s", "gradient", "certified", "CPU s with it", "chi²",
    "CPU s", "g2o chi²", "g2o CPU s", "GTSAM CPU s", "GTSAM / F", "GTSAM / chi²", "peak MB",
)  # fmt: skip
ROBUST_COLUMNS = ("solver", "edges", "wrong", "wrong ones kept", "right ones left out", "CPU s")
EXPLAINED = """# The maximum-likelihood solver, measured

Made by `OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/solver.py --write{flags}` on {day}: {machine}.
{load}

CPU seconds are medians over the repeats, reading excluded. F is the isotropic objective, chi² the full one: two
problems with two minima, each with its own seconds. `gradient` is its norm at the end of F over that at the start.
GTSAM's seconds are for its chordal start and Gauss-Newton on its own objective (3-D graphs only), g2o's for
Levenberg-Marquardt from the file's poses, its quaternions normalised, in the same run.
The last ratios are how many times as long GTSAM took as
F without the certificate, and as chi². Peak memory is of the process after solving F. `sphere` has the noise of
sphere_bignoise; the graphs below it show how the cost grows.
"""


def row(task: tuple[str, str | int, int]) -> list[str]:
    """One line of the table."""
    name, what, repeats = task
    with tempfile.TemporaryDirectory() as folder:
        path = Path(str(what))
        if isinstance(what, int):
            graph = isotropic = synthetic(name, what)
            path = Path(folder) / f"{name}.g2o"
        else:
            graph = load_g2o(path).graph
            raw = np.roll(information_for_file(graph.information), (3, 3), axis=(1, 2))
            isotropic = graph if graph.dimension == 2 else dataclasses.replace(graph, information=raw)
        plain_s, plain = timed(lambda: solve(isotropic, objective="isotropic"), repeats)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        slope = relative_gradient(isotropic, plain.world_from_cam)
        certified_s, certified = None, plain
        if graph.vertex_count <= MOST_CERTIFIED:
            certified_s, certified = timed(lambda: solve(isotropic, objective="isotropic", certificate=True), repeats)
        full_s, full = timed(lambda: solve(graph), repeats) if graph.vertex_count <= 500_000 else (None, plain)
        if isinstance(what, int) and what <= GTSAM_TO.get(name, 10_000):
            write_g2o(path, graph)
        peers = path.is_file()
        gtsam = gtsam_seconds(path, graph, min(repeats, 3)) if peers and graph.dimension == 3 else ""
        readable = not isinstance(what, int) and "chi2" in full.metrics
        g2o = g2o_seconds(normalised(path, Path(folder)), graph.dimension) if readable else ""
    optimum = CERTIFIED_OPTIMA.get(path.stem)
    cost = plain.metrics["objective"]
    return [
        name,
        f"{graph.vertex_count} / {graph.edge_count}",
        f"{cost:.10g}",
        "" if optimum is None else f"{cost / optimum - 1:+.1e}",
        f"{plain_s.cpu_s:.3f}",
        f"{plain_s.wall_s:.3f}",
        f"{slope:.0e}",
        {True: "yes", False: "no"}.get(certified.certified, ""),
        seconds(certified_s),
        "" if full_s is None else chi2_cell(full),
        seconds(full_s),
        f"{g2o[1]:.9g}" if isinstance(g2o, tuple) else g2o,
        seconds(g2o[0]) if isinstance(g2o, tuple) else "",
        gtsam if isinstance(gtsam, str) else seconds(gtsam),
        *(ratio(gtsam, own) for own in (plain_s, full_s)),
        f"{peak_mb:.0f}",
    ]


def normalised(path: Path, folder: Path) -> Path:
    """A copy with quaternions of unit length to the last digit: g2o takes those of a file as they stand."""
    source = load_g2o(path)
    assert source.graph is not None
    copy = folder / path.name
    write_g2o(copy, source.graph, None if source.trajectory is None else source.trajectory.world_from_cam)
    return copy


def relative_gradient(graph: ViewGraph, world_from_cam: np.ndarray) -> float:
    """The norm of F's gradient at these poses (V, 4, 4) over that at the start which `solve` would choose."""
    setup = prepare(graph, world_from_cam)

    def norm(rotations: np.ndarray, translations: np.ndarray) -> float:
        return float(np.linalg.norm(gradient(setup.problem, residuals(setup.problem, rotations, translations))))

    return norm(*setup.initial("given")) / max(norm(*setup.initial("chordal")), 1e-300)


def seconds(times: Times | None) -> str:
    return "" if times is None else f"{times.cpu_s:.3f}"


def ratio(other: Times | str, own: Times | None) -> str:
    """How many times as long the other solver took, where it did."""
    return "" if isinstance(other, str) or own is None else f"{other.cpu_s / own.cpu_s:.1f}"


def chi2_cell(solution: Solution) -> str:
    """The chi², or that there is none."""
    return f"{solution.metrics['chi2']:.9g}" if "chi2" in solution.metrics else "indefinite"


def robust_rows(count: int, share: float) -> Iterator[list[str]]:
    """A cylinder with wrong edges: this solver, which trusts no edge, and GTSAM's GNC, which is told whom to trust."""
    graph, wrong = with_wrong_edges(synthetic("cylinder", count), share)
    own_s, solution = timed(lambda: solve_robust(graph), 1)
    yield robust_row("robust", graph, wrong, solution.weights > 0, own_s)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cylinder.g2o"
        write_g2o(path, graph)
        other = gnc_weights(path, graph)
    if isinstance(other, str):
        yield ["GTSAM GNC", other, *[""] * 4]
    else:
        yield robust_row("GTSAM GNC, sequence trusted", graph, wrong, other[1] > 0.5, other[0])


def robust_row(name: str, graph: ViewGraph, wrong: np.ndarray, kept: np.ndarray, times: Times) -> list[str]:
    is_wrong = np.zeros(graph.edge_count, bool)
    is_wrong[wrong] = True
    counts = graph.edge_count, len(wrong), (kept & is_wrong).sum(), (~kept & ~is_wrong).sum()
    return [name, *(str(int(number)) for number in counts), seconds(times)]


def robust_table(task: tuple[int, float]) -> list[list[str]]:
    return list(robust_rows(*task))


def machine() -> str:
    """The machine in words."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        models = [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        model = models[0] if models else model
    versions = f"CPython {platform.python_version()}, numpy {np.__version__}, scipy {scipy.__version__}"
    return f"{model}, {os.cpu_count()} cores, {platform.system()}; {versions}"


def table(columns: tuple[str, ...], rows: Iterator[list[str]]) -> Iterator[str]:
    yield f"|{'|'.join(columns)}|"
    yield f"|{'---|' * len(columns)}"
    for cells in rows:
        yield f"|{'|'.join(cells)}|"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--synthetic", nargs="*", type=int, default=[10_000, 100_000], metavar="POSES")
    parser.add_argument(
        "--shapes", nargs="*", choices=list(SHAPES), default=["cylinder", "trajectory", "streets", "lattice"]
    )
    parser.add_argument("--files", nargs="*", type=Path, default=None)
    parser.add_argument(
        "--million", action="store_true", help="a cylinder, a trajectory and streets of a million poses: 8 GB"
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--write", action="store_true", help="write benchmarks/solver.md")
    options = parser.parse_args()
    data = Path(os.environ.get("HODGE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    files = sorted((data / "pose_graphs" / "sesync").glob("*.g2o")) if options.files is None else options.files
    tasks: list[tuple[str, str | int, int]] = [(path.stem, str(path), options.repeats) for path in files]
    if options.files is None:
        tasks.append(("sphere", 2200, options.repeats))
    tasks += [(shape, n, 1) for n in options.synthetic for shape in options.shapes]
    tasks += [(shape, 1_000_000, 1) for shape in ("cylinder", "trajectory", "streets") if options.million]
    day, load = date.today().isoformat(), os.getloadavg()[0] / (os.cpu_count() or 1)
    busy = f"Other jobs kept the machine {'busy' if load > 0.5 else 'hardly busy'}: {load:.1f} waiting for each core."
    lines = [EXPLAINED.format(flags=" --million" * options.million, day=day, machine=machine(), load=busy)]
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for line in table(COLUMNS, pool.imap(row, tasks)):
            print(line, flush=True)
            lines.append(line)
        lines += ["", "Edges replaced by random motions, one in five, in a cylinder of 500 poses:", ""]
        for line in table(ROBUST_COLUMNS, iter(pool.apply(robust_table, ((500, 0.2),)))):
            print(line, flush=True)
            lines.append(line)
    if options.write:
        Path(__file__).with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""The same recipe, input and seed give the same bits on any workers and threads; odd graphs have known answers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from small_run import Outcome, made

from hodge_pipeline import registry, se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.types import ViewGraph

RUNS = {
    "0 workers": ({}, "executor.workers=0"),
    "1 worker": ({}, "executor.workers=1"),
    "2 workers": ({}, "executor.workers=2"),
    "3 workers": ({}, "executor.workers=3"),
    "2 threads": ({"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}, "executor.workers=0"),
    "hash seed 1": ({"PYTHONHASHSEED": "1"}, "executor.workers=0"),
    "another place and language": ({"LC_ALL": "C", "TZ": "Asia/Tokyo"}, "executor.workers=0"),
}
GRAPHS = ("chain", "ring", "twice", "loop", "two parts", "one vertex", "no edge", "half turn", "far", "small")
COMMAND = (
    "import sys; sys.path[:0] = sys.argv[1:3]; from pathlib import Path; import hodge_pipeline; import small_run; "
    "hodge_pipeline.run(small_run.recipe(Path(sys.argv[3]), *sys.argv[5:]), sys.argv[4])"
)


def cases(full: bool, scratch: Path, seed: int) -> list[str]:
    """Each way to run, each graph by each solver."""
    return [*(f"run/{name}" for name in RUNS), *(f"graph/{s}/{g}" for s in registry.names("solvers") for g in GRAPHS)]


def check(name: str, scratch: Path) -> dict[str, int]:
    """One way to run, or one graph."""
    kind, what = name.split("/", 1)
    return _run(what, scratch) if kind == "run" else _solved(*what.split("/"))


def _run(name: str, scratch: Path) -> dict[str, int]:
    things, folder = made(scratch), scratch / "repeated"
    shutil.rmtree(folder, ignore_errors=True)
    environment, setting = RUNS[name]
    here = Path(__file__).parent
    paths = [str(here), str(here.parent), str(things.source), str(folder), setting]
    subprocess.run(
        [sys.executable, "-W", "ignore", "-c", COMMAND, *paths], env={**os.environ, **environment}, check=True
    )
    differences = Outcome.of(things.run).differences(Outcome.of(folder))
    assert not differences, differences
    return {"same bits": 1}


def graph_of(name: str) -> tuple[ViewGraph, np.ndarray]:
    """A graph whose edges are exact, and its poses; the unit, a half turn, a vertex alone are what is odd."""
    scale = {"far": 1e6, "small": 1e-6}.get(name, 1.0)
    count = 1 if name == "one vertex" else 6
    steps = np.linspace(0, 1, count)[:, None] * np.array([[0.3, 0.2, 0.9, 2 * scale, scale, 0.5 * scale]])
    if name == "half turn":
        steps = np.arange(count)[:, None] * np.array([[0, 0, np.pi, 1.0, 0, 0]])
    poses = se3.exp(steps)
    pairs = {
        "ring": [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 0), (0, 3)],
        "twice": [(0, 1), (0, 1), (1, 0), (1, 2), (2, 3), (3, 4), (4, 5), (5, 4)],
        "loop": [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 3)],
        "two parts": [(0, 1), (1, 2), (3, 4), (4, 5)],
        "one vertex": [],
        "no edge": [],
    }.get(name, [(row, row + 1) for row in range(count - 1)])
    edges = np.array(pairs, np.int64).reshape(-1, 2)
    i_from_j = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    return ViewGraph.from_edges(np.arange(count), edges, i_from_j), poses


def _solved(solver: str, name: str) -> dict[str, int]:
    graph, poses = graph_of(name)
    try:
        found = registry.load("solvers", solver)().solve(graph, np.tile(np.eye(4), (len(poses), 1, 1)))
    except GraphError as error:
        assert "\n" not in str(error)
        return {"refused in one line": 1}
    i_from_j = se3.inverse(found.world_from_cam[graph.edges[:, 0]]) @ found.world_from_cam[graph.edges[:, 1]]
    size = max(1e-9, float(np.abs(graph.i_from_j[:, :3, 3]).max(initial=0)))
    error = np.abs(i_from_j - graph.i_from_j)
    worst = max(float(error[:, :3, :3].max(initial=0)), float(error[:, :3, 3].max(initial=0)) / size)
    assert np.isfinite(found.world_from_cam).all()
    assert len(found.component) == len(poses)
    assert worst < 1e-3, f"off by {worst:.2g}"
    return {"known answer": 1}

"""What works where importing open3d fails, as on a bare machine: solve, diagnose, convert, inspect; its lean import."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from command import Ended
from hodge_pipeline import se3
from hodge_pipeline.registry import load
from hodge_pipeline.types import Source, Trajectory
from synthetic import short_sequence  # noqa: F401 - a fixture

SCRIPT = Path(__file__).resolve().parents[1] / "tools" / "system-libraries.sh"
DEBIAN = re.findall(r"^need \S+ (\S+)", SCRIPT.read_text("utf-8"), re.M)
MESSAGE = "libGL.so.1: cannot open shared object file"


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a machine where open3d is installed and does not load."""
    site = tmp_path_factory.mktemp("broken")
    (site / "open3d").mkdir()
    (site / "open3d" / "__init__.py").write_text(f'raise ImportError("{MESSAGE}")\n')
    paths = [str(site), str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ring of twenty poses, each joined with the next two, in a g2o file."""
    count = 20
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    poses = se3.exp(np.stack([0 * angle, 0 * angle, angle, 0 * angle, 0 * angle, 0 * angle], axis=1))
    poses[:, :2, 3] = 3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    edges = np.array([(i, (i + step) % count) for i in range(count) for step in (1, 2)])
    noise = se3.exp(0.01 * np.random.default_rng(0).standard_normal((len(edges), 6)))
    motions = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ noise
    measured = hodge_pipeline.ViewGraph.from_edges(np.arange(count), edges, motions)
    path = tmp_path_factory.mktemp("graph") / "ring.g2o"
    trajectory = Trajectory(np.arange(count, dtype=float), poses)
    load("writers", "g2o")().write(path, Source("ring", path, trajectory=trajectory, graph=measured))
    return path


def ended(environment: dict[str, str], *commands: tuple[object, ...]) -> list[Ended]:
    """What commands left, one after the other in one process of that environment."""
    script = "import json, sys; from command import hodge; from dataclasses import astuple\n"
    script += "print(json.dumps([astuple(hodge(*words)) for words in json.loads(sys.argv[1])]))"
    words = json.dumps([[*map(str, each)] for each in commands])
    done = subprocess.run(
        [sys.executable, "-c", script, words], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return [Ended(*each) for each in json.loads(done.stdout)]


def test_open3d_does_not_load_there(broken: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import open3d"], env=broken, capture_output=True, text=True, check=False
    )
    assert MESSAGE in done.stderr


def test_a_pose_graph_needs_no_open3d(broken: dict[str, str], graph: Path, tmp_path: Path) -> None:
    solved = tmp_path / "solved.g2o"
    commands: tuple[tuple[object, ...], ...] = (
        ("inspect", graph),
        ("solve", graph, "--out", solved, "--certificate", "--objective", "isotropic"),
        ("solve", graph, "--out", tmp_path / "robust.tum", "--robust"),
        ("diagnose", graph, "--out", tmp_path / "why"),
        ("convert", solved, tmp_path / "graph.json"),
        ("convert", solved, tmp_path / "poses.tum"),
        ("inspect", tmp_path / "poses.tum"),
    )
    for words, done in zip(commands, ended(broken, *commands), strict=True):
        assert done.returncode == 0, (words, done.stderr)
    assert (tmp_path / "why" / "diagnosis.html").is_file() and (tmp_path / "why" / "edges.csv").is_file()


def test_a_sequence_is_inspected_and_converted_and_what_needs_open3d_says_so(
    broken: dict[str, str],
    short_sequence: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    sets = ("--set", "registration=point_to_plane")
    commands: tuple[tuple[object, ...], ...] = (
        ("inspect", short_sequence),
        ("convert", short_sequence, tmp_path / "poses.kitti"),
        ("stages",),
        ("run", "demo", "--source", short_sequence, *sets, "--out", tmp_path / "run"),
    )
    *fine, needing = ended(broken, *commands)
    for words, done in zip(commands, fine, strict=False):
        assert done.returncode == 0, (words, done.stderr)
    stages = fine[-1].stdout
    assert "point_to_plane" in stages and "gicp" in stages and MESSAGE in stages
    assert needing.returncode == 1, "what needs it says so in a line"
    assert MESSAGE in needing.stderr and needing.stderr.count("\n") == 1
    assert all(package in needing.stderr for package in DEBIAN)


LEAN = """
import sys
from hodge_pipeline.lean_open3d import o3d
assert not {"dash", "plotly", "IPython"} & sys.modules.keys()
before = o3d.visualization.draw_plotly
figures = [o3d.visualization.get_plotly_fig([]) for _ in range(2)]
assert "plotly" in sys.modules and type(figures[1]).__name__ == "Figure"
assert o3d.visualization.draw_plotly is before and callable(before)
from open3d.visualization.draw_plotly import get_plotly_fig
assert get_plotly_fig.__module__ == "open3d.visualization.draw_plotly"
"""


def test_open3d_comes_without_what_draws_in_a_browser_until_that_is_called() -> None:
    done = subprocess.run([sys.executable, "-c", LEAN], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

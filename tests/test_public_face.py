"""What a user of the package sees first: its public names, what they do and how they print."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hodge_pipeline
from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError, RecipeError, SourceError
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import KeyFrames, Round
from hodge_pipeline.types import CloudSet, Edges, Frame, PointCloud, Source, ViewGraph

LONGEST = 200
"""Characters of a value as an interpreter shows it: two lines of a terminal."""
MANY = 3000

IMPORT_EVERYTHING = """
import importlib, pkgutil, hodge_pipeline
before = {name: getattr(hodge_pipeline, name) for name in hodge_pipeline.__all__}
for module in pkgutil.walk_packages(hodge_pipeline.__path__, "hodge_pipeline."):
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        assert not error.name.startswith("hodge"), error
changed = [name for name, value in before.items() if getattr(hodge_pipeline, name) is not value]
assert not changed, f"replaced by a submodule: {changed}"
"""


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_importing_every_submodule_replaces_no_public_name() -> None:
    done = python(IMPORT_EVERYTHING)
    assert done.returncode == 0, done.stderr


def test_every_public_name_is_there_and_listed() -> None:
    assert sorted(hodge_pipeline.__all__) == hodge_pipeline.__all__
    for name in hodge_pipeline.__all__:
        assert name in dir(hodge_pipeline)
        value = getattr(hodge_pipeline, name)
        assert value.__name__ == name and value.__doc__
    with pytest.raises(AttributeError, match="no attribute 'sovle'"):
        hodge_pipeline.sovle  # noqa: B018


def test_importing_the_package_imports_nothing_else() -> None:
    done = python("import hodge_pipeline, sys; print([name for name in sys.modules if name in ('numpy', 'open3d')])")
    assert done.stdout == "[]\n", done.stderr


def test_a_graph_is_read_and_solved_without_libraries_that_few_graphs_need() -> None:
    done = python("""
import sys
from hodge_pipeline import registry
from hodge_pipeline.cli import diagnose, solve
for name in registry.names("readers"):
    registry.load("readers", name)
print({"jinja2", "matplotlib", "open3d", "pycolmap", "rerun", "scipy.optimize"} & sys.modules.keys())
""")
    assert done.stdout == "set()\n", done.stderr


def surface(count: int = 3000) -> np.ndarray:
    """Points of a corner of three walls, in metres, the same every time."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(0, 2, (count, 3))
    flat[np.arange(count), np.arange(count) % 3] = 0
    return flat


MOTION = se3.exp(np.array([0.03, -0.02, 0.01, 0.04, 0.03, -0.02]))


@pytest.mark.parametrize("registrar", ["gicp", Gicp()])
def test_register_takes_arrays(registrar: Any) -> None:
    target = surface()
    source = se3.transform(se3.inverse(MOTION), surface())
    found = hodge_pipeline.register(target, source, registrar=registrar)
    assert np.abs(found.i_from_j - MOTION).max() < 1e-3
    assert found.converged and found.fitness > 0.9 and (np.linalg.eigvalsh(found.information) > 0).all()


def test_register_takes_open3d_and_our_clouds() -> None:
    from hodge_pipeline.registration.one_thread import o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(surface()))
    cloud.colors = o3d.utility.Vector3dVector(np.full((3000, 3), 0.5))
    ours = PointCloud(se3.transform(se3.inverse(MOTION), surface()).astype(np.float32))
    found = hodge_pipeline.register(cloud, ours, np.eye(4), max_iterations=30)
    assert np.abs(found.i_from_j - MOTION).max() < 1e-3


def test_from_clouds_to_poses() -> None:
    truth = np.stack([np.eye(4), MOTION, MOTION @ MOTION])
    clouds = [se3.transform(se3.inverse(pose), surface()) for pose in truth]
    edges = hodge_pipeline.register_clouds(clouds, [(0, 1), (1, 2), (0, 2)])
    assert edges.proposed_by.tolist() == ["gicp"] * 3 and edges.converged.all()
    graph = edges.as_graph(range(3))
    poses = hodge_pipeline.solve_robust(graph, start=np.tile(np.eye(4), (3, 1, 1))).world_from_cam
    assert np.abs(poses - truth).max() < 2e-3
    assert hodge_pipeline.diagnose(graph).kept.all()


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        ((np.zeros((5, 2)), surface()), {}, SourceError, r"cloud 0 has the shape \(5, 2\): expected points \(N, 3\)"),
        ((surface(), surface(), np.eye(3)), {}, GraphError, r"shape \(1, 3, 3\): expected \(1, 4, 4\)"),
        ((surface(), surface(), MOTION.T), {}, GraphError, r"the guess i_from_j of pair \(0, 1\) looks transposed"),
        (
            (surface(), surface()),
            {"registrar": "gcip"},
            RecipeError,
            "^register: registration: no stage 'gcip'",
        ),
        ((surface(), surface()), {"neighbors": 9}, RecipeError, "registration.neighbors: unknown .*'neighbours'"),
        ((surface(), surface()), {"registrar": Gicp(), "neighbours": 9}, RecipeError, "set them on the stage itself"),
        ((surface(), surface()), {"registrar": 3}, RecipeError, "register: 3 is no stage of kind 'registration'"),
    ],
)
def test_register_says_what_is_wrong(arguments: Any, options: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        hodge_pipeline.register(*arguments, **options)


def test_pairs_of_no_cloud_are_named() -> None:
    with pytest.raises(GraphError, match="give rows from 0 to 1"):
        hodge_pipeline.register_clouds([surface(), surface()], [(0, 2)])


def test_open_source(tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    path.write_text("".join(f"{row} {row} 0 0 0 0 0 1\n" for row in range(5)))
    for reader in (None, "tum_poses"):
        source = hodge_pipeline.open_source(path, reader)
        assert source.trajectory is not None and len(source.trajectory) == 5
    with pytest.raises(RecipeError, match="open_source: readers: no stage 'tun_poses'"):
        hodge_pipeline.open_source(path, "tun_poses")
    for reader in (None, "tum_poses"):
        with pytest.raises(RecipeError, match="readers.evry: unknown option"):
            hodge_pipeline.open_source(path, reader, evry=2)


README = Path(__file__).parents[1] / "README.md"


def test_the_clouds_of_the_readme(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = README.read_text("utf-8").split("```python\n")[1:]
    code = next(block.partition("```")[0] for block in blocks if "register_clouds" in block)
    names: dict[str, Any] = {}
    exec(code, names)
    steps = names["solution"].world_from_cam[:, :3, 3] - names["solution"].world_from_cam[0, :3, 3]
    np.testing.assert_allclose(steps, [[0, 0, 0], [0.05, 0, 0.02], [0.1, 0, 0.04]], atol=2e-3)
    assert "Edges(3 pairs: 3 used)" in capsys.readouterr().out


@pytest.mark.parametrize("page", ["README.md", "docs/quick-start.md"])
def test_pages_use_public_names_alone(page: str) -> None:
    text = (README.parent / page).read_text("utf-8")
    named = set(re.findall(r"hodge_pipeline\.(\w+)(?!\w*/)", text)) | set(
        re.findall(r"from hodge_pipeline import (\w+)", text)
    )
    assert named and named <= set(hodge_pipeline.__all__), named - set(hodge_pipeline.__all__)
    assert not re.search(r"(from|import) hodge_pipeline\.", text)


def frames() -> tuple[Frame, ...]:
    return tuple(Frame(row, float(row), world_from_cam=np.eye(4)) for row in range(MANY))


def large_run() -> Run:
    poses = np.tile(np.eye(4), (MANY, 1, 1))
    source = Source("long", Path("long"), frames())
    clouds = CloudSet.from_clouds([PointCloud(np.zeros((2, 3), np.float32))] * MANY)
    first = Round(Edges.measured(large_graph()), np.arange(MANY), poses)
    return Run(Path("runs/long"), source, KeyFrames.all_of(source, poses), clouds, (first,), poses, {})


def large_graph() -> ViewGraph:
    rows = np.arange(MANY - 1)
    return ViewGraph.from_edges(
        np.arange(MANY), np.stack([rows, rows + 1], axis=1), np.tile(np.eye(4), (MANY - 1, 1, 1))
    )


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (large_run, "Run('runs/long': 3000 frames, 2999 edges, unfinished)"),
        (lambda: Source("long", Path("long"), frames()), "Source('long': 3000 frames)"),
        (
            lambda: Source("g", Path("g.g2o"), graph=large_graph()),
            "Source('g': 0 frames, ViewGraph(3000 vertices, 2999 edges))",
        ),
        (large_graph, "ViewGraph(3000 vertices, 2999 edges)"),
        (lambda: Edges.measured(large_graph()), "Edges(2999 pairs: 2999 used)"),
        (lambda: Edges.of([]), "Edges(0 pairs)"),
        (
            lambda: hodge_pipeline.solve(large_graph()),
            "Solution(3000 poses in 1 component, 2999 of 2999 edges count)",
        ),
        (lambda: hodge_pipeline.diagnose(large_graph()), "Diagnosis(2999 edges: 0 consistent, 0 suspect, 0 wrong,"),
        (lambda: large_run().clouds, "CloudSet(3000 clouds, 6000 points)"),
    ],
)
def test_values_print_in_a_line(value: Any, shown: str) -> None:
    text = repr(value())
    assert text.startswith(shown) and len(text) < LONGEST

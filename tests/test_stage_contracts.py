"""Every registered stage against the contract of its kind; solvers and readers have tests of their own."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import pytest

from colmap_data import synthetic
from hodge_pipeline import registry, testing
from hodge_pipeline.testing.writers import whole_source
from readers_data import seven_scenes_sequence

OWN = "hodge-pipeline "
PROPERTIES = {kind: check.properties for kind, check in testing.CHECKS.items() if kind != "readers"}
OPTIONS: dict[str, dict[str, Any]] = {
    "executors: local": {"workers": 2},
    "edges: place": {
        "reach": 1,
        "min_similarity": 0.5,
        "thinned": 1,
    },  # the room's frames are few, and follow each other
    "edges: combined": {"builders": tuple(registry.load("edges", name)() for name in ("sequential", "overlap"))},
}
LACKS = {
    "rewriters: seven_scenes": {"new poses"},  # it writes the poses alone, which without images are no sequence
}
FILES = {
    "tum": "poses.tum",
    "kitti": "poses.kitti",
    "g2o": "graph.g2o",
    "colmap": "model",
    "nerfstudio": "transforms.json",
    "open3d_pose_graph": "graph.json",
    "open3d_trajectory": "trajectory.json",
    "euroc": "data.csv",
    "log": "poses.log",
    "ply": "cloud.ply",
    "mcap": "poses.mcap",
}
READERS = {
    "tum": "tum_poses",
    "kitti": "kitti_poses",
    "open3d_pose_graph": "open3d",
    "open3d_trajectory": "open3d",
    "ply": "clouds",
}
"""The readers of what writers write, where they have other names."""


def own_stages(kind: str) -> list[str]:
    return [name for name in registry.names(kind) if registry.origin(kind, name).startswith(OWN)]


def made(kind: str, name: str) -> Any:
    return registry.load(kind, name)(**OPTIONS.get(f"{kind}: {name}", {}))


@pytest.mark.parametrize(
    ("kind", "name", "what"),
    [
        (kind, name, what)
        for kind in ("start", "edges", "registration", "global_registration", "executors", "fusion")
        for name in own_stages(kind)
        for what in PROPERTIES[kind]
    ],
)
def test_every_stage_keeps_its_contract(kind: str, name: str, what: str) -> None:
    lacks = LACKS.get(f"{kind}: {name}", set()) & {what}
    testing.CHECKS[kind](made(kind, name), lacks=lacks, properties=[what])


@pytest.mark.parametrize("what", PROPERTIES["writers"])
@pytest.mark.parametrize("name", own_stages("writers"))
def test_every_writer_keeps_its_contract(name: str, what: str) -> None:
    reader = registry.load("readers", READERS.get(name, name))()
    testing.check_writer(made("writers", name), FILES[name], reader, properties=[what])


def original(name: str, folder: Path) -> Path:
    """A file, or folder, whose poses are rewritten."""
    if name == "seven_scenes":
        return seven_scenes_sequence(folder)
    writer = {"tum_poses": "tum", "icl_nuim": "tum", "kitti_poses": "kitti", "open3d": "open3d_trajectory"}.get(
        name, name
    )
    path = folder / FILES[writer]
    registry.load("writers", writer)().write(path, whole_source())
    return path


@pytest.mark.parametrize("what", PROPERTIES["rewriters"])
@pytest.mark.parametrize("name", own_stages("rewriters"))
def test_every_rewriter_keeps_its_contract(name: str, what: str, tmp_path: Path) -> None:
    reader = registry.load("readers", "tum_poses" if name == "icl_nuim" else name)()
    lacks = LACKS.get(f"rewriters: {name}", set()) & {what}
    path = original(name, tmp_path)
    testing.check_rewriter(made("rewriters", name), path, reader, lacks=lacks, properties=[what])


@pytest.mark.parametrize("what", PROPERTIES["models"])
@pytest.mark.parametrize("name", own_stages("models"))
def test_every_reader_of_models_keeps_its_contract(name: str, what: str, tmp_path: Path) -> None:
    synthetic(tmp_path)
    testing.check_model_reader(made("models", name), tmp_path / "text", properties=[what])


def test_every_kind_has_a_check() -> None:
    assert list(testing.CHECKS) == list(registry.KINDS)
    assert {*PROPERTIES, "readers"} == {*registry.KINDS}


@pytest.mark.parametrize("page", ["docs/examples/far_loops/test_far_loops.py", "tests/plugin_package/test_ring.py"])
def test_the_examples_of_plugins_pass_their_own_tests(page: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(__file__).parents[1] / page
    monkeypatch.syspath_prepend(path.parent)
    (test,) = (each for name, each in runpy.run_path(str(path)).items() if name.startswith("test_"))
    test()

"""A third party's package, really installed: found, run from a recipe; its broken stage harms nobody."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from command import hodge
from hodge_pipeline import registry
from plugin_metadata import installed
from synthetic import LIGHT, short_sequence  # noqa: F401 - a fixture

PACKAGE = Path(__file__).parent / "plugin_package"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the package is installed."""
    site = tmp_path_factory.mktemp("site")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target"]
    subprocess.run([*pip, str(site), str(PACKAGE)], check=True, capture_output=True)
    return site


@pytest.fixture
def environment(site: Path) -> Iterator[None]:
    """The environment in which the package is installed."""
    with installed(site):
        yield


def test_it_is_listed_and_the_broken_one_is_named(site: Path) -> None:
    """In a process of its own, as a user's shell starts one."""
    paths = [str(site), *filter(None, [os.environ.get("PYTHONPATH")])]
    listed = subprocess.run(
        [sys.executable, "-m", "hodge_pipeline.cli.main", "stages", "edges"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert listed.returncode == 0
    assert "ring" in listed.stdout
    assert "[hodge-plugin-example 0.3.0]" in listed.stdout
    assert "broken: stage 'broken'" in listed.stdout
    assert "overlap" in listed.stdout


@pytest.mark.usefixtures("environment")
def test_it_runs_from_a_recipe(short_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    recipe = tmp_path / "ring.yaml"
    recipe.write_text("extends: demo\nedges: {stage: ring, reach: 1}\nfusion: []\nrecording: {level: off}\n")
    sets = [word for change in LIGHT if not change.startswith("edges") for word in ("--set", change)]
    run = ["run", str(recipe), "--source", str(short_sequence), "--out", str(tmp_path / "run"), *sets]
    ran = hodge(*run)
    assert ran.returncode == 0, ran.stderr
    rows = (tmp_path / "run/edges.csv").read_text().splitlines()[1:]
    assert len(rows) == 8
    assert all(row.split(",")[2] == "ring" for row in rows)


@pytest.mark.usefixtures("environment")
def test_naming_the_broken_one_is_one_line(tmp_path: Path) -> None:
    recipe = tmp_path / "broken.yaml"
    recipe.write_text("extends: demo\nedges: {stage: broken}\n")
    ran = hodge("run", recipe, "--source", tmp_path, "--out", tmp_path / "run")
    assert ran.returncode == 1
    assert ran.stderr.startswith(
        f"error: {recipe}:2: edges: stage 'broken' of kind 'edges' (hodge-plugin-example 0.3.0)"
    )
    assert ran.stderr.count("\n") == 1


@pytest.mark.usefixtures("environment")
def test_its_schema_leaves_the_broken_one_out() -> None:
    schema = hodge("recipes", "--schema")
    assert schema.returncode == 0
    assert '"ring"' in schema.stdout
    assert '"broken"' not in schema.stdout


def test_ctrl_c_while_a_compiled_module_is_imported_is_no_broken_plugin(monkeypatch: pytest.MonkeyPatch) -> None:
    class Interrupted:
        dist = None

        def load(self) -> None:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as stop:
                raise ImportError("initialization failed") from stop

    monkeypatch.setattr(registry, "_entries", lambda group: {"tsdf": Interrupted()})
    with pytest.raises(KeyboardInterrupt):
        registry.load("fusion", "tsdf")

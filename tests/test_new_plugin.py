"""`hodge new-plugin`: what it writes passes its own test, is found by its entry point, runs, and its errors name it."""

from __future__ import annotations

import inspect
import itertools
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from command import hodge
from hodge_pipeline import registry
from hodge_pipeline.cli.new_plugin import EXAMPLES, plugin_files, write_plugin
from hodge_pipeline.errors import RecipeError, WorkspaceError
from plugin_metadata import installed, write_metadata
from synthetic import LIGHT, short_sequence  # noqa: F401 - a fixture

PAGE = Path(__file__).resolve().parents[1] / "docs" / "writing-a-plugin.md"
KINDS = {"registration": "o3d_icp", "readers": "npz_folder"}
RUFF = ["check", "--select", "E,F,I,UP,B,SIM,D1"], ["format", "--check"]
SMALL = (*LIGHT, "fusion=[]", "recording.level=off", "start.relocalise=false")


def made(folder: Path, name: str, kind: str) -> Path:
    """A new package, with the metadata that pip would write of it beside it."""
    write_plugin(name, kind, folder)
    write_metadata(folder, folder)
    return folder


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A package of each kind."""
    folder = tmp_path_factory.mktemp("new")
    return [made(folder / name, name, kind) for kind, name in KINDS.items()]


def test_they_pass_their_own_tests_and_the_linter(packages: list[Path], tmp_path: Path) -> None:
    for package in packages:
        (path,) = package.glob("test_*.py")
        with installed(package):
            (test,) = (each for name, each in runpy.run_path(str(path)).items() if name.startswith("test_"))
            test(**dict.fromkeys(inspect.signature(test).parameters, tmp_path))
    for package, command in itertools.product(packages, RUFF):
        linted = subprocess.run(
            [sys.executable, "-m", "ruff", *command, "--isolated", "--line-length", "120"],
            cwd=package, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert linted.returncode == 0, linted.stdout


def test_they_are_listed_with_their_packages(packages: list[Path]) -> None:
    with installed(*packages):
        for kind, name in KINDS.items():
            listed = hodge("stages", kind)
            assert f"[hodge-{name.replace('_', '-')} 0.1.0]" in listed.stdout, listed.stderr


def test_a_run_registers_with_it_and_its_error_names_it(
    short_sequence: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    package = made(tmp_path / "package", "o3d_icp", "registration")
    sets = [word for change in (*SMALL, "registration=o3d_icp") for word in ("--set", change)]
    run = ["run", "demo", "--source", str(short_sequence), *sets]
    with installed(package):
        done = hodge(*run, "--set", "executor.workers=0", "--out", tmp_path / "good")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("verdict")

    module = package / "hodge_o3d_icp.py"
    module.write_text(module.read_text().replace("        steps = 0\n", '        raise ValueError("no\\nluck")\n'))
    line = module.read_text().splitlines().index('        raise ValueError("no\\nluck")') + 1
    # in a worker, whose errors come back without frames
    with installed(package):
        done = hodge(*run, "--set", "executor.workers=1", "--out", tmp_path / "bad", "--quiet")
    assert done.returncode == 1
    said = f"stage o3d_icp (hodge-o3d-icp 0.1.0) raised ValueError: no luck, at hodge_o3d_icp.py:{line}"
    assert done.stderr == f"error: {said}\n"


def test_a_reader_opens_its_format_and_its_error_names_it(tmp_path: Path) -> None:
    package = made(tmp_path / "package", "npz_folder", "readers")
    data = tmp_path / "data"
    data.mkdir()
    np.savez(data / "0.npz", points=np.random.default_rng(0).uniform(0, 2, (100, 3)))
    with installed(package):
        done = hodge("inspect", data, "--reader", "npz_folder")
    assert done.returncode == 0 and re.search(r"^frames +1$", done.stdout, re.M), done.stdout + done.stderr
    module = package / "hodge_npz_folder.py"
    module.write_text(module.read_text().replace("        frames = tuple(", "        frames = 1 / 0, *("))
    with installed(package):
        done = hodge("inspect", data, "--reader", "npz_folder")
    assert done.returncode == 1
    assert done.stderr.startswith("error: stage npz_folder (hodge-npz-folder 0.1.0) raised ZeroDivisionError: division")
    assert done.stderr.count("\n") == 1


def test_an_error_of_ours_is_no_plugins() -> None:
    try:
        registry.load("registration", "gicp")().prepare(None)
    except AttributeError as error:
        assert registry.plugin_error(error) is None


@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [("My-ICP", "registration", "is no name of a stage"), ("mine", "solvers", "no template of kind 'solvers'")],
)
def test_a_name_that_is_none_is_one_line(name: str, kind: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match=message):
        write_plugin(name, kind, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_nothing_is_written_over(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="is there already"):
        write_plugin("mine", "readers", tmp_path)


@pytest.mark.parametrize(("name", "kind"), [("o3d_icp", "registration"), ("npz_folder", "readers")])
def test_the_page_shows_what_it_writes(name: str, kind: str) -> None:
    assert kind in EXAMPLES
    page = PAGE.read_text("utf-8")
    for file, text in plugin_files(name, kind):
        shown = kind == "registration" and file != "README.md" or file.startswith("hodge_")
        assert not shown or f"\n{text}```" in page, file

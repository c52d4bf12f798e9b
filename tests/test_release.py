"""What a release has: one version everywhere, workflows that run what is there, an sdist that tests itself."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

REPOSITORY = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))
WORKFLOWS = sorted((REPOSITORY / ".github" / "workflows").glob("*.yml"))
MAKEFILE = (REPOSITORY / "Makefile").read_text("utf-8")
TARGETS = set(re.findall(r"^([a-z-]+):", MAKEFILE, re.M))
QUICK = "tests/test_yaml_and_recipes.py", "tests/test_python_versions.py"


def test_the_citation_is_of_this_version() -> None:
    citation = YAML(typ="safe").load(REPOSITORY / "CITATION.cff")
    project = PYPROJECT["project"]
    assert (citation["title"], citation["version"]) == (project["name"], project["version"])
    assert citation["license"] == project["license"] and citation["authors"] and citation["cff-version"] == "1.2.0"


def test_there_is_a_workflow_for_each_job() -> None:
    assert [path.stem for path in WORKFLOWS] == ["lint", "site", "tests", "wheel"]


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_runs_targets_that_are_there(path: Path) -> None:
    assert path.read_text("utf-8").startswith("# Not run yet")
    workflow = YAML(typ="safe").load(path)
    assert set(workflow) == {"name", "on", "permissions", "jobs"}
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert set(job) == {"runs-on", "timeout-minutes", "steps"}
        assert all(
            set(step) <= {"uses", "with", "run"} and ("uses" in step) != ("run" in step) for step in job["steps"]
        )
        runs = [step["run"].split() for step in job["steps"] if "run" in step]
        assert runs and all(words[0] == "make" and set(words[1:]) <= TARGETS for words in runs)
        (python,) = [step["with"]["python-version"] for step in job["steps"] if "setup-python" in step.get("uses", "")]
        assert python == PYPROJECT["project"]["requires-python"].removeprefix(">=")


def test_the_map_names_every_room() -> None:
    page = (REPOSITORY / "CONTRIBUTING.md").read_text("utf-8")
    rooms = [path.name for path in (REPOSITORY / "hodge_pipeline").iterdir() if (path / "__init__.py").is_file()]
    assert [room for room in rooms if f"{room}`" not in page and room not in ("executors", "demo", "recipe")] == []
    for target in re.findall(r"\]\(([^)#:]+)\)", page):
        assert (REPOSITORY / target).exists(), target


def test_every_dependency_is_explained() -> None:
    page = (REPOSITORY / "docs" / "dependencies.md").read_text("utf-8")
    project = PYPROJECT["project"]
    names = [re.split(r"[<>=\[]", each)[0] for each in project["dependencies"]]
    missing = [name for name in (*names, *project["optional-dependencies"]) if f"| `{name}` |" not in page]
    assert missing == []


def test_the_sdist_passes_its_tests_from_an_empty_folder(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", str(tmp_path), str(REPOSITORY)]
    subprocess.run(build, check=True, capture_output=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        packed.extractall(tmp_path, filter="data")
    folder = tmp_path / archive.name.removesuffix(".tar.gz")
    for name in ("recipes/demo.yaml", "docs/README.md", "tests/conftest.py", "LICENSE", "CHANGELOG.md", "Makefile"):
        assert (folder / name).is_file(), name
    assert not [name for name in ("build", "runs", ".venv", ".ci", "shared") if (folder / name).exists()]
    here = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path and REPOSITORY.name not in path]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(folder / "adapters"), *here])}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *QUICK]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    where = "import hodge_pipeline, hodge_adapters; print(hodge_pipeline.__file__, hodge_adapters.__file__)"
    found = subprocess.run([sys.executable, "-c", where], cwd=folder, env=environment, capture_output=True, text=True)
    assert found.stdout.count(str(folder)) == 2

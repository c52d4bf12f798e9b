"""The wheel, installed in an environment of its own outside the checkout: it finds its recipes and runs the demo."""

import os
import subprocess
import sys
import textwrap
import venv
import zipfile
from dataclasses import asdict
from pathlib import Path

import pytest

from synthetic import LIGHT, SHORT

REPOSITORY = Path(__file__).resolve().parents[1]
ALONE = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
"""What is on it would be imported before the wheel."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(REPOSITORY)]
    subprocess.run(build, check=True, capture_output=True)
    (path,) = out.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def hodge(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of the wheel. The libraries are those of this environment; the project's own code is the wheel's."""
    home = tmp_path_factory.mktemp("clean")
    venv.create(home, with_pip=False)
    python = home / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", str(wheel)]
    subprocess.run(install, check=True, capture_output=True, env=ALONE)
    (site,) = home.glob("lib/python*/site-packages")
    # as plain paths their own .pth files are not read, so the checkout's editable install stays out
    libraries = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (site / "libraries.pth").write_text("".join(f"{path}\n" for path in libraries))
    where = subprocess.run(
        [python, "-c", "import hodge_pipeline as p, hodge_adapters as a; print(p.__file__, a.__file__)"],
        check=True, capture_output=True, text=True, cwd=home, env=ALONE,
    ).stdout  # fmt: skip
    assert where.count(str(site)) == 2
    return home / "bin" / "hodge"


def test_the_wheel_holds_both_packages_and_the_recipes(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {"hodge_pipeline/recipes/demo.yaml", "hodge_pipeline/py.typed", "hodge_adapters/tum/reader.py"} <= names
    assert "hodge_pipeline/cli/plugin_template/registration.py.j2" in names
    assert not [name for name in names if name.startswith(("tests/", "adapters/", "benchmarks/"))]


def test_it_finds_its_recipes_and_stages(hodge: Path, tmp_path: Path) -> None:
    def output(*arguments: str) -> str:
        return subprocess.run(
            [hodge, *arguments], check=True, capture_output=True, text=True, cwd=tmp_path, env=ALONE
        ).stdout

    assert "seven_scenes" in output("recipes")
    broken = [line for line in output("stages").splitlines() if "broken" in line]
    assert not [line for line in broken if "hodge-paper" not in line]  # its source is the checkout's, which is not seen


def test_it_runs_the_demo(hodge: Path, tmp_path: Path) -> None:
    """A shorter one."""
    script = textwrap.dedent(f"""
        import hodge_pipeline.demo.sequence as sequence
        from hodge_pipeline.cli.entry import main

        default = sequence.DemoOptions
        sequence.DemoOptions = lambda: default(**{asdict(SHORT)!r})
        main()
    """)
    light = [*LIGHT, "fusion=[{stage: cloud, voxel_m: 0.05}]", "recording.level=summary"]
    command = ["demo", "--out", "run", *(word for change in light for word in ("--set", change))]
    environment = {**ALONE, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(
        [hodge.with_name("python"), "-c", script, *command],
        capture_output=True, text=True, cwd=tmp_path, check=False, env=environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run/recording.rrd").stat().st_size > 10_000
    assert done.stdout.startswith("verdict")

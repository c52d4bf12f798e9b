"""The command line as a user types it."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from command import hodge
from fresh_process import run_fresh
from hodge_pipeline.cli import entry
from synthetic import LIGHT, short_sequence  # noqa: F401 - fixtures

SETS = [word for change in ("fusion=[]", "recording.level=off", *LIGHT) for word in ("--set", change)]


def test_help_opens_with_examples_and_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom hodge_pipeline.cli.main import app\n"
        "try:\n    app(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'scipy', 'open3d', 'rerun', 'pydantic', 'matplotlib', 'cv2'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "hodge run seven_scenes --source" in done.stdout
    assert done.stdout.index("Examples") < done.stdout.index("Commands")


def test_a_pose_graph_is_judged_without_what_draws(tmp_path: Path) -> None:
    """Their import takes as long as the rest of the commands."""
    (tmp_path / "graph.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 0 1 0 0 1 0 1\n")
    code = (
        "import sys\nfrom hodge_pipeline.cli.main import app\nfor command in ('solve', 'diagnose'):\n    try:\n"
        f"        app([command, {str(tmp_path / 'graph.g2o')!r}])\n    except SystemExit as end:\n"
        "        assert not end.code\n"
        "heavy = {'open3d', 'rerun', 'matplotlib'} & set(sys.modules)\nassert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_usual_short_options_and_a_source_in_the_wrong_place() -> None:
    assert hodge("-h").stdout == hodge("--help").stdout and hodge("run", "-h").returncode == 0
    assert "may be repeated" in hodge("run", "--help").stdout and "--install-completion" in hodge("-h").stdout
    stray = hodge("run", "tum", "some/folder", "-o", "x")
    assert stray.returncode == 2 and "'some/folder': use --source" in stray.stderr
    assert "STRAY" not in hodge("run", "-h").stdout.upper()


def test_ctrl_c_before_the_command_has_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "hodge_pipeline.cli.main", raising=False)
    monkeypatch.setattr("importlib._bootstrap_external.SourceFileLoader.exec_module", stop)
    with pytest.raises(SystemExit) as ended:
        entry.main()
    assert ended.value.code == 130


def test_stages_and_recipes_are_listed() -> None:
    stages, recipes = hodge("stages"), hodge("recipes")
    for name in ("tum", "overlap", "gicp", "poisson", "tsdf", "local"):
        assert name in stages.stdout
    assert {line.split()[0] for line in recipes.stdout.splitlines()} >= {"demo", "seven_scenes", "tum"}
    options = hodge("stages", "edges").stdout
    assert "min_iou = 0.5" in options
    assert "builders must be given: the edge builders" in options


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["run", "sevenscenes", "--source", ".", "--out", "x"], 1, "did you mean 'seven_scenes'"),
        (["run", "demo", "--source", ".", "--set", "edges.stage=overlp", "--out", "x"], 1, "did you mean 'overlap'"),
        (["run", "demo", "--source", ".", "--set", "seed=a", "--out", "x"], 1, "--set seed=a: seed: input should be"),
        (["run", "demo", "--out", "x"], 1, "--source"),
        (["run", "demo", "--source", "nowhere", "--out", "{tmp}/x"], 1, "nowhere"),
        (["inspect", "nowhere"], 1, "no such file or folder"),
        (["stages", "edge"], 1, "did you mean 'edges'"),
        (["view", "nowhere"], 1, "no recording here"),
        (["view", "{graph}"], 1, "no Rerun recording (.rrd): name a run folder"),
        (["view", "{tmp}"], 1, "no run folder: name the folder that `hodge run … --out` wrote"),
        (["run", "demo", "--source", ".", "--set", "solver=hodgee", "--out", "x"], 1, "hodgee: solver: no stage"),
        (["inspect", "{graph}", "--reader", "tmu"], 1, "did you mean 'tum'"),
        (["solve", "{graph}", "--out", "{tmp}"], 1, "is a folder: give the name of a file in it"),
        (["solve", "{graph}", "--out", "."], 1, "such as solved.g2o"),
        (["solve", "{graph}", "--out", "/proc/x.g2o"], 1, "/proc/x.g2o: cannot be written"),
        (["convert", "{graph}", "{graph}/x.g2o"], 1, "cannot be written (Not a directory): is its folder there?"),
        (["run", "demo"], 2, "--out"),
        (["fly"], 2, "No such command"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], code: int, message: str, tmp_path: Path) -> None:
    graph = tmp_path / "graph.g2o"
    graph.write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    done = hodge(*(argument.format(tmp=tmp_path, graph=graph) for argument in arguments))
    assert done.returncode == code, done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    if code == 1:
        assert [line for line in done.stderr.splitlines() if not line.startswith("solve: done")] == [
            done.stderr.splitlines()[-1]
        ]
        assert done.stderr.splitlines()[-1].startswith("error: ")


def test_a_run_that_never_began_does_not_hold_its_folder(tmp_path: Path) -> None:
    missing, out = tmp_path / "nowhere", tmp_path / "run"
    assert hodge("run", "tum", "--source", missing, "--out", out).returncode == 1
    other = hodge("run", "seven_scenes", "--source", missing, "--out", out)
    assert "nowhere" in other.stderr and "another recipe" not in other.stderr


def test_version_and_the_schema_of_both_kinds_of_recipe() -> None:
    assert hodge("--version").stdout.startswith("hodge-pipeline 0.")
    run, model = (json.loads(hodge("recipes", *name, "--schema").stdout) for name in ((), ("colmap_refine",)))
    assert "outer_iterations" in run["properties"] and "model" not in run["properties"]
    assert "model" in model["properties"] and "outer_iterations" not in model["properties"]


def test_a_run_prints_a_summary_or_json_or_nothing(short_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    run = ["run", "tum", "--source", short_sequence, "--out", tmp_path / "run", *SETS]
    first = hodge(*run)
    assert first.returncode == 0, first.stderr
    assert "verdict" in first.stdout
    assert "\x1b[" not in first.stdout + first.stderr
    assert json.loads(hodge(*run, "--json").stdout)["source"]["frames"] == 8
    quiet = hodge(*run, "--quiet")
    assert (quiet.stdout, quiet.stderr) == ("", "")


def test_scans_of_which_no_two_are_joined_end_with_3_and_a_single_one_with_0(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    run = ["run", "scans", "--source", tmp_path / "scans", "--out", tmp_path / "run", "--overwrite", "--quiet"]
    run += [*SETS[:4], "--set", "executor.workers=0"]
    wall = np.random.default_rng(0).uniform(0, 2, (500, 3)) * [1, 1, 0] + [0, 0, 1]
    for name, code in (("a", 0), ("b", 3)):
        np.savetxt(tmp_path / "scans" / f"{name}.xyz", wall)
        done = hodge(*run)
        assert done.returncode == code, done.stderr
    assert "error: no two of 2 scans are joined: " in done.stderr
    again = hodge("solve", tmp_path / "run", "--quiet")
    assert again.returncode == 3 and f"are joined: {tmp_path / 'run' / 'report.html'} says why" in again.stderr


def test_inspect_says_what_a_folder_is(short_sequence: Path) -> None:  # noqa: F811
    facts = json.loads(hodge("inspect", short_sequence, "--json").stdout)
    assert facts["formats"][0]["reader"] == "tum"
    assert facts["frames"] == 8
    assert 0.3 < facts["depth range in metres"][0] < facts["depth range in metres"][1] < 10
    text = hodge("inspect", short_sequence).stdout
    assert "80x60" in text


def test_inspect_and_convert_take_a_reader_and_its_options(short_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    facts = json.loads(hodge("inspect", short_sequence, "--reader", "tum", "--set", "every=4", "--json").stdout)
    assert facts["frames"] == 2
    as_in_a_recipe = hodge("inspect", short_sequence, "--set", "source.reader.every=4").stdout
    assert "--set source.reader.every=4 --out" in as_in_a_recipe
    wrong = hodge("inspect", short_sequence, "--set", "evry=4")
    assert wrong.returncode == 1 and "unknown option (did you mean 'every'?)" in wrong.stderr
    assert (
        "no stage 'tmu' of kind 'readers' (did you mean 'tum'?)"
        in hodge("inspect", short_sequence, "--reader", "tmu").stderr
    )
    made = hodge("convert", short_sequence, tmp_path / "out.tum", "--set", 'truth=""')
    assert made.returncode == 1 and "no poses to write" in made.stderr


def on_a_full_disk(command: list[str]) -> None:
    """The command where no file may be larger than 60 kB."""
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
    sys.argv[1:] = command
    entry.main()


def test_a_full_disk_is_one_line_and_keeps_what_was_finished(short_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    command = ["run", "tum", "--source", str(short_sequence), "--out", str(tmp_path / "run"), *SETS, "--quiet"]
    done = run_fresh(on_a_full_disk, command)
    assert done.returncode == 1, done.stderr
    assert "make room" in done.stderr
    again = hodge(*command)
    assert again.returncode == 0, again.stderr

"""What comes from strangers: recipes and run folders reach no cluster, execute nothing and write nowhere else."""

from __future__ import annotations

import os
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hodge_pipeline
from hodge_pipeline.cli.main import app
from hodge_pipeline.errors import RecipeError, WorkerError, WorkspaceError
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.refine.model_options import load_model_refinement
from hodge_pipeline.registration.global_pairs import describe_clouds
from hodge_pipeline.registration.global_registrars import FpfhConsensus
from hodge_pipeline.report.run_files import write_poses
from hodge_pipeline.run_folder import Run
from hodge_pipeline.store import yaml_file
from hodge_pipeline.types import Frame, Source
from hodge_pipeline.uses.recipe_run import solve_again
from synthetic import LIGHT, short_sequence  # noqa: F401 - a fixture

SMALL = (*LIGHT, "fusion=[]", "recording.level=off")
LOCAL = "executor:\n  stage: local\n  workers: 0\n  retries: 2\n"


class Stranger:
    """Somebody who waits for connections and hangs up on each: `calls` counts them."""

    def __init__(self, server: socket.socket) -> None:
        self.address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        self.calls, self._server = 0, server
        threading.Thread(target=self._answer, daemon=True).start()

    def _answer(self) -> None:
        with suppress(OSError):  # the port is closed: the test has ended
            while True:
                connection = self._server.accept()[0]
                self.calls += 1
                connection.close()


@pytest.fixture
def stranger() -> Iterator[Stranger]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield Stranger(server)
        server.shutdown(socket.SHUT_RDWR)


@pytest.fixture(scope="module")
def made(short_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:  # noqa: F811
    return hodge_pipeline.run(load_recipe("demo", SMALL, short_sequence), tmp_path_factory.mktemp("runs") / "short")


@pytest.fixture
def run_folder(made: Run, tmp_path: Path) -> Path:
    """A finished run that the test may change."""
    return Path(shutil.copytree(made.folder, tmp_path / "run"))


def one_line_of(*arguments: object, environment: dict[str, str] | None = None) -> str:
    """What a command that the user's input stops says."""
    done = CliRunner().invoke(app, [*map(str, arguments)], env=environment)
    assert isinstance(done.exception, (RecipeError, WorkerError)), done.output
    assert done.exception.exit_code == 1
    assert "\n" not in str(done.exception)
    return str(done.exception)


def test_a_recipe_reaches_no_cluster(tmp_path: Path, stranger: Stranger) -> None:
    path = tmp_path / "theirs.yaml"
    path.write_text(f'extends: demo\nexecutor:\n  stage: dask\n  address: "{stranger.address}"\n')
    (tmp_path / "child.yaml").write_text("extends: theirs.yaml\nseed: 3\n")
    for name in (path, tmp_path / "child.yaml"):
        said = one_line_of("run", name, "--source", tmp_path, "--out", tmp_path / "out")
        assert said.startswith(f"{path}:4: executor.address: ")
        assert "--dask ADDRESS" in said
    assert not stranger.calls


def test_nor_does_one_that_refines_a_model(tmp_path: Path, stranger: Stranger) -> None:
    path = tmp_path / "theirs.yaml"
    path.write_text(f'extends: colmap_refine\nexecutor: {{stage: dask, address: "{stranger.address}"}}\n')
    with pytest.raises(RecipeError, match=r"theirs.yaml:2: executor.address: .*--dask ADDRESS"):
        load_model_refinement(str(path))
    assert not stranger.calls


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("executor=dask", "executor"),
        ("executor.stage=dask", "executor.stage"),
        ("executor.address=tcp://h:8786", "executor.address"),
        ("executor={stage: dask, address: 'tcp://h:8786'}", "executor.address"),
        ("executor={stage: dask, workers: 2}", "executor.stage"),
    ],
)
def test_set_says_what_to_give_instead(change: str, key: str) -> None:
    with pytest.raises(RecipeError) as refused:
        load_recipe("demo", [change])
    assert str(refused.value).startswith(f"--set {change}: {key}: ")
    assert "--dask ADDRESS" in str(refused.value)


def names_a_cluster(run_folder: Path, address: str) -> Path:
    """The recipe of a run, which now names a cluster."""
    recipe = run_folder / "recipe.yaml"
    text = recipe.read_text()
    assert LOCAL in text
    theirs = f"executor:\n  stage: dask\n  address: {address}\n  workers: 2\n  retries: 2\n  timeout_s: 5.0\n"
    recipe.write_text(text.replace(LOCAL, theirs))
    return recipe


@pytest.mark.parametrize("command", [["diagnose"], ["record", "--level", "summary"]])
def test_what_only_reads_a_run_leaves_its_cluster_out(run_folder: Path, stranger: Stranger, command: list[str]) -> None:
    names_a_cluster(run_folder, stranger.address)
    done = CliRunner().invoke(app, [*command, str(run_folder)])
    assert done.exit_code == 0, done.output
    assert not stranger.calls


@pytest.mark.parametrize("command", ["solve", "run"])
def test_a_run_folder_reaches_no_cluster(run_folder: Path, stranger: Stranger, command: str) -> None:
    recipe = names_a_cluster(run_folder, stranger.address)
    arguments = ["run", recipe, "--out", run_folder] if command == "run" else [command, run_folder]
    said = one_line_of(*arguments)
    assert said.startswith(f"{recipe}:")
    assert "executor.address: a recipe names no cluster" in said
    assert not stranger.calls


def test_no_stage_of_the_package_takes_an_address() -> None:
    """The line above is for people: without it there is still nothing that a recipe could name."""
    from hodge_pipeline import registry

    for kind in registry.KINDS:
        for name in registry.names(kind):
            assert "address" not in registry.load(kind, name).__pydantic_fields__, (kind, name)
    assert "dask" not in registry.names("executors")


def test_the_command_line_or_the_environment_names_the_cluster(
    short_sequence: Path,  # noqa: F811
    tmp_path: Path,
    stranger: Stranger,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hodge_pipeline.executors.dask.TIMEOUT_S", 3.0)  # the first call is late on a busy machine
    settings = [word for setting in SMALL for word in ("--set", setting)]
    command = ["run", "demo", "--source", short_sequence, *settings]
    for way in ("option", "environment"):
        option = ["--dask", stranger.address] if way == "option" else []
        environment = {"HODGE_DASK_ADDRESS": stranger.address} if way == "environment" else {}
        stranger.calls = 0
        said = one_line_of(*command, *option, "--out", tmp_path / way, environment=environment)
        assert said.startswith(f"no Dask scheduler answers at '{stranger.address}'")
        assert stranger.calls


def test_workers_that_start_elsewhere_find_source_and_run(
    short_sequence: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from distributed import Client, LocalCluster

    monkeypatch.chdir(short_sequence.parent)
    out = os.path.relpath(tmp_path / "run")
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        with Client(cluster) as client:
            client.run(os.chdir, "/")
        recipe = load_recipe("demo", SMALL)
        run = hodge_pipeline.run(recipe, out, source=short_sequence.name, dask=cluster.scheduler_address)
    assert np.isfinite(run.poses).all()


def test_a_run_goes_on_with_or_without_the_cluster(run_folder: Path, made: Run) -> None:
    """The cluster is no part of the recipe: it is not written, and coming or going makes no other run."""
    from distributed import LocalCluster

    before = (run_folder / "recipe.yaml").read_text()
    again = load_recipe(str(run_folder / "recipe.yaml"))
    for stage in ("register_edges-1", "solve_edges-1"):
        shutil.rmtree(run_folder / "stages" / stage)
    one = {"processes": False, "protocol": "tcp", "n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**one) as cluster:
        found = hodge_pipeline.run(again, run_folder, dask=cluster.scheduler_address)
        assert (found.result.world_from_cam == made.result.world_from_cam).all()
        solve_again(run_folder, dask=cluster.scheduler_address)
    assert (run_folder / "recipe.yaml").read_text() == before
    assert "executor" in yaml_file.read(run_folder / "recipe.yaml").data
    shutil.rmtree(run_folder / "stages" / "register_edges-1")
    local = hodge_pipeline.run(again, run_folder)
    assert (local.result.world_from_cam == made.result.world_from_cam).all()


@pytest.mark.parametrize("name", ["log.txt", "stages", "stages/clouds-1", "stages/solve_edges-1/value.npz"])
def test_a_link_in_a_run_folder_is_not_written_through(run_folder: Path, tmp_path: Path, name: str) -> None:
    theirs = run_folder / name
    elsewhere = tmp_path / "elsewhere"
    theirs.rename(elsewhere)
    theirs.symlink_to(elsewhere)
    before = elsewhere.read_bytes() if elsewhere.is_file() else sorted(elsewhere.rglob("*"))
    for again in (
        lambda: solve_again(run_folder),
        lambda: hodge_pipeline.run(str(run_folder / "recipe.yaml"), run_folder),
    ):
        with pytest.raises(WorkspaceError, match=f"{theirs}: is a symbolic link"):
            again()
    assert before == (elsewhere.read_bytes() if elsewhere.is_file() else sorted(elsewhere.rglob("*")))


def test_a_pickle_that_lies_in_a_run_folder_is_not_loaded(tmp_path: Path) -> None:
    """Descriptions of clouds are pickles: those that a stranger left go before the first is made."""
    theirs = tmp_path / "described" / "7.pickle"
    theirs.parent.mkdir()
    theirs.write_bytes(b"theirs")
    with LocalExecutor(workers=0).open() as workers:
        describe_clouds(tmp_path, FpfhConsensus(), np.zeros(0, np.int64), theirs.parent, workers)
    assert not theirs.exists()


def test_sequences_named_by_folders_are_written_into_the_run_folder(tmp_path: Path) -> None:
    """COLMAP's images name them: `rig/left/0001.png`, or anything else."""
    folder = tmp_path / "run"
    (folder / "poses-").mkdir(parents=True)
    names = ("rig/left", "/../../outside")
    frames = tuple(Frame(row, float(row), None, sequence=name) for row, name in enumerate(names))
    write_poses(folder, Source("model", tmp_path, frames), np.tile(np.eye(4), (2, 1, 1)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]
    assert sorted(path.name for path in folder.glob("*.tum")) == ["poses-_.._.._outside.tum", "poses-rig_left.tum"]

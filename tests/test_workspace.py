"""The run folder: whose it is, refusal, and the files in it."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.errors import WorkspaceError, not_written
from hodge_pipeline.store import artifacts, codec
from hodge_pipeline.store.workspace import Workspace
from hodge_pipeline.types import Solution, SolverIteration, ViewGraph
from hodge_pipeline.types.output_files import replacing

RECIPE = {"seed": 0, "edges": {"stage": "overlap", "min_iou": 0.3}}


def begun(folder: Path, recipe: dict[str, object] | None = None) -> None:
    """A run folder in which a step has begun."""
    with Workspace.open(folder, recipe or RECIPE) as workspace:
        (workspace.steps / "clouds-1.part").mkdir()


def test_another_recipe_is_refused_and_says_what_differs(tmp_path: Path) -> None:
    other = {"seed": 0, "edges": {"stage": "overlap", "min_iou": 0.5}}
    begun(tmp_path / "run")
    with pytest.raises(WorkspaceError, match=r"edges.min_iou was 0.3, is 0.5.*--overwrite"):
        Workspace.open(tmp_path / "run", other)
    Workspace.open(tmp_path / "run", other, overwrite=True).close()
    Workspace.open(tmp_path / "run", other).close()


def test_a_run_of_another_version_is_told_the_command_that_mends_it(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    begun(folder)
    Workspace.reopen(folder, RECIPE).close()
    with pytest.raises(WorkspaceError, match=r"another version \(.*pace was None, is 2\)") as refused:
        Workspace.reopen(folder, {**RECIPE, "pace": 2})
    assert f"hodge run {folder / 'recipe.yaml'} --out {folder} --overwrite" in str(refused.value)


def test_the_description_is_the_last_difference_named_and_a_run_that_never_began_holds_nothing(tmp_path: Path) -> None:
    begun(tmp_path / "run", {"description": "one", **RECIPE})
    with pytest.raises(WorkspaceError, match=r"\(seed was 0, is 1\)"):
        Workspace.open(tmp_path / "run", {"description": "two", **RECIPE, "seed": 1})
    with pytest.raises(WorkspaceError, match=r"\(description was"):
        Workspace.open(tmp_path / "run", {"description": "two", **RECIPE})
    Workspace.open(tmp_path / "begun", RECIPE).close()
    Workspace.open(tmp_path / "begun", {**RECIPE, "seed": 1}).close()


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("name", ["thesis.tex", "recipe.yaml"])
def test_a_folder_with_other_things_is_never_taken(tmp_path: Path, name: str, overwrite: bool) -> None:
    (tmp_path / name).write_text("years of work")
    with pytest.raises(WorkspaceError, match="not empty and not a run folder"):
        Workspace.open(tmp_path, RECIPE, overwrite=overwrite)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "years of work")]


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with Workspace.open(tmp_path / "run", RECIPE), pytest.raises(WorkspaceError, match="another run uses"):
        Workspace.open(tmp_path / "run", RECIPE)
    Workspace.open(tmp_path / "run", RECIPE).close()


def test_a_file_in_the_way_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(WorkspaceError, match="cannot be written"):
        Workspace.open(tmp_path / "run", RECIPE)


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "make room, or write elsewhere"),
        (errno.EROFS, "write elsewhere"),
        (errno.ENOENT, "is its folder there?"),
    ],
)
def test_what_cannot_be_written_says_what_to_do(number: int, remedy: str) -> None:
    told = str(not_written(Path("out.g2o"), OSError(number, os.strerror(number))))
    assert told == f"out.g2o: cannot be written ({os.strerror(number)}): {remedy}"


def test_a_name_that_is_not_utf_8_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError, match="not a name in UTF-8"):
        Workspace.open(tmp_path / os.fsdecode(b"run\xff"), RECIPE)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    artifacts.write_json(path, {"a": 1})
    with pytest.raises(OSError, match="no"), replacing(path):
        raise OSError("no")
    assert artifacts.read_json(path) == {"a": 1}
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such files")
def test_no_file_takes_the_place_of_a_device_or_a_pipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root, as in a container, replaced /dev/null and the link /dev/stdout for every program of the machine."""
    pipe, discarded, devices = tmp_path / "pipe", tmp_path / "discarded", tmp_path / "dev"
    os.mkfifo(pipe)
    discarded.symlink_to(os.devnull)
    devices.mkdir()
    (tmp_path / "output").write_text("printed")
    (devices / "stdout").symlink_to(tmp_path / "output")
    monkeypatch.setattr("hodge_pipeline.types.output_files.DEVICES", devices.resolve())
    for path in (pipe, discarded, devices / "stdout"):
        with pytest.raises(OSError, match="a device or pipe"), replacing(path) as file:
            file.write(b"x")
    assert pipe.is_fifo() and discarded.is_symlink() and (devices / "stdout").is_symlink()


def test_numbers_that_json_lacks_become_null(tmp_path: Path) -> None:
    artifacts.write_json(tmp_path / "x.json", {"a": float("nan"), "b": np.array([1.0, np.inf]), "c": np.int64(3)})
    assert artifacts.read_json(tmp_path / "x.json") == {"a": None, "b": [1.0, None], "c": 3}


def test_graph_round_trip(tmp_path: Path) -> None:
    graph = ViewGraph.from_edges(np.array(["a", "b"]), np.array([[0, 1]]), np.eye(4)[None], source="sift")
    artifacts.save(tmp_path / "graph.npz", graph)
    again = artifacts.load(tmp_path / "graph.npz", ViewGraph)
    assert again.vertex_ids.tolist() == ["a", "b"]
    assert again.source.tolist() == ["sift"]
    np.testing.assert_array_equal(again.i_from_j, graph.i_from_j)


def test_solution_round_trip(tmp_path: Path) -> None:
    poses = np.stack([np.eye(4)] * 3)
    step = SolverIteration(poses, 0.5, {"mean_deviation": float("nan"), "step": 1e-9})
    solution = Solution(
        poses, np.zeros(3, np.int64), np.ones(2), (step, step), {"cost": 1.0}, ("one piece",), confirmed=False
    )
    codec.save(tmp_path, solution)
    again = codec.load(tmp_path, Solution)
    np.testing.assert_array_equal(again.history[1].world_from_cam, poses)
    assert again.notes == ("one piece",)
    assert again.confirmed is False
    assert again.history[0].metrics["step"] == 1e-9
    assert np.isnan(again.history[0].metrics["mean_deviation"])


def test_a_second_name_leaves_no_draft_behind(tmp_path: Path) -> None:
    (tmp_path / "one").write_text("bytes")
    for _ in range(2):
        artifacts.link_or_copy(tmp_path / "one", tmp_path / "two")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one", "two"]
    assert (tmp_path / "two").read_text() == "bytes"

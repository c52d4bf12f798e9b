"""`hodge edit`, and `hodge solve` on the run folder: edits, their history, and resume."""

import json
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from command import rows_of
from command import told as hodge
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError, HodgeError, WorkspaceError
from hodge_pipeline.pairs.edits import Edit, History, read_history, write_history
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.rounds.more import Placed
from hodge_pipeline.rounds.one_round import solve_edges
from hodge_pipeline.run_folder import Run
from hodge_pipeline.store.store import stored
from hodge_pipeline.types import ViewGraph
from hodge_pipeline.uses.recipe_run import solve_again
from synthetic import tiny_sequence  # noqa: F401 - a fixture

SMALL = (
    "clouds.voxel_m=0.06", "fusion=[{stage: cloud}]", "executor.workers=0", "recording.level=summary",
    "outer_iterations=1", "acceptance.min_fitness=0.6", "source.reader.every=2",
)  # fmt: skip


def small_recipe(source: Path) -> Recipe:
    return load_recipe("demo", SMALL, source)


@pytest.fixture(scope="module")
def run(tiny_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:  # noqa: F811
    return hodge_pipeline.run(small_recipe(tiny_sequence), tmp_path_factory.mktemp("runs") / "tiny")


def statuses(folder: Path) -> dict[str, str]:
    return {f"{row['i']}-{row['j']}": row["status"] for row in rows_of(folder)}


def test_edits_with_guesses_and_right_pairs_are_read_back(tmp_path: Path) -> None:
    guess = tuple(se3.exp(np.array([0.1, 0, 0, 1.0, 2, 3])).reshape(-1).tolist())
    history = History((Edit(register=("1-9",), right=("2-3",), guesses=(("1-9", guess),)),))
    write_history(tmp_path / "edits.json", history)
    assert read_history(tmp_path / "edits.json") == history
    assert history.switches == {"1-9": "registered", "2-3": "right"} and history.right == history.enabled == ("2-3",)
    assert np.array_equal(history.guesses["1-9"], np.reshape(guess, (4, 4)))
    for bad in (guess[:15], (9.0, *guess[1:])):
        write_history(tmp_path / "edits.json", History((Edit(register=("1-9",), guesses=(("1-9", bad),)),)))
        with pytest.raises(WorkspaceError, match="is not a history of edits"):
            read_history(tmp_path / "edits.json")


def test_a_guess_by_hand_goes_before_that_of_the_poses() -> None:
    poses = se3.exp(np.random.default_rng(0).normal(size=(4, 6)))
    placed = Placed(poses, np.array([0, 0, 1, 1]))
    pairs, by_hand = np.array([[0, 1], [0, 2], [1, 2], [2, 3]]), np.full((4, 4, 4), np.nan)
    by_hand[[1, 3]] = np.eye(4)
    found = placed.guesses(pairs, by_hand)
    assert np.allclose(found[0], se3.inverse(poses[0]) @ poses[1])
    assert np.array_equal(found[[1, 3]], by_hand[[1, 3]]) and np.isnan(found[2]).all()


def test_the_latest_edit_of_a_pair_counts_and_undo_takes_it_back() -> None:
    history = History().added(Edit(disable=("1-2", "3-4"))).added(Edit(enable=("1-2",)))
    assert history.switches == {"1-2": "enabled", "3-4": "disabled"}
    assert history.undo().switches == {"1-2": "disabled", "3-4": "disabled"}
    assert history.undo().undo().switches == {}
    assert [edit.undone for edit in history.undo().undo().edits] == [True, True]
    assert history.undo().added(Edit(disable=("5-6",))).undo().switches == {"1-2": "disabled", "3-4": "disabled"}
    with pytest.raises(GraphError, match="no edit to undo"):
        History().undo()


def test_the_history_survives_its_file(tmp_path: Path) -> None:
    history = History((Edit(("a-b", "c-d")), Edit(enable=("a-b",), undone=True)))
    write_history(tmp_path / "edits.json", history)
    assert read_history(tmp_path / "edits.json") == history
    assert read_history(tmp_path / "elsewhere" / "edits.json") == History()


@pytest.mark.parametrize("text", ["", "[]", '{"edits": 3}', '{"edits": [{"disable": "1-2"}]}', '{"edits": [["1-2"]]}'])
def test_a_damaged_history_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "edits.json").write_text(text)
    with pytest.raises(WorkspaceError, match=r"edits.json: is not a history of edits"):
        read_history(tmp_path / "edits.json")


def test_an_edge_is_taken_out_the_run_resumes_with_it_and_undo_gives_the_old_poses(run: Run) -> None:
    folder, before = run.folder, run.result.world_from_cam
    worst = max((r for r in rows_of(folder) if r["status"] == "used"), key=lambda row: float(row["residual_m"]))
    pair = f"{worst['i']}-{worst['j']}"
    told = hodge("edit", folder, "--disable", f"{worst['j']}-{worst['i']}")
    assert f"disabled   {pair}" in told
    assert f"hodge solve {folder}" in told

    report = json.loads(hodge("solve", folder, "--json"))
    assert statuses(folder)[pair] == "disabled"
    assert any("edited by hand: disabled" in note["text"] for note in report["notes"])
    edited = np.loadtxt(folder / "poses.tum")[:, 1:4]
    assert 1e-6 < np.abs(edited - before[:, :3, 3]).max() < 0.1
    assert len(stored(folder / "stages", solve_edges)) == 2
    assert report["scores"] is None
    recorded = hodge("record", folder)
    assert "evaluation" not in recorded

    assert run.source.path is not None
    resumed = hodge_pipeline.run(small_recipe(run.source.path), folder)
    np.testing.assert_array_equal(resumed.result.world_from_cam[:, :3, 3], edited)
    assert resumed.result.edited
    assert (resumed.result.edges.status == "disabled").sum() == 1
    assert any(pair in str(note) for note in resumed.report.notes)
    assert resumed.report.scores is not None

    told = hodge("edit", folder, "--undo", "--list")
    assert f"undone     disable {pair}" in told and "(undone)" in told
    again = solve_again(folder)
    np.testing.assert_array_equal(again.result.world_from_cam, before)
    assert "disabled" not in statuses(folder).values()
    assert not any("edited" in str(note) for note in again.report.notes)
    assert again.report.scores is not None, "without an edit the report has its scores again"


def test_a_rejected_pair_is_let_in(run: Run) -> None:
    rejected = [pair for pair, status in statuses(run.folder).items() if status == "rejected"]
    assert rejected
    hodge("edit", run.folder, "--enable", rejected[0], "--quiet")
    again = solve_again(run.folder)
    assert again.result.graph.edge_count == run.result.graph.edge_count + 1
    assert (again.result.graph_edges.verdict != "").all()
    assert statuses(run.folder)[rejected[0]] == "used"
    answer = json.loads(hodge("edit", run.folder, "--json"))
    assert answer["switches"] == {rejected[0]: "enabled"}
    hodge("edit", run.folder, "--undo", "--quiet")
    assert solve_again(run.folder).result.graph.edge_count == run.result.graph.edge_count


def test_mistakes_are_one_line(run: Run, tmp_path: Path) -> None:
    for arguments, message in (
        (["edit", run.folder, "--disable", "nothing"], "nothing: no edge joins"),
        (["edit", tmp_path, "--list"], "no finished run"),
        (["edit", run.folder, "--undo", "--disable", "1-2"], "give it alone"),
        (["solve", tmp_path], "no reader knows|no graph|is empty"),
    ):
        with pytest.raises(HodgeError, match=message):
            hodge(*arguments)
    pair = next(iter(statuses(run.folder)))
    with pytest.raises(GraphError, match="at once"):
        hodge("edit", run.folder, "--disable", pair, "--enable", pair)


def test_a_solved_graph_is_edited_in_its_folder(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truth = se3.exp(rng.normal(size=(6, 6)))
    edges = np.array([(i, (i + 1) % 6) for i in range(6)] + [(0, 3), (1, 4), (2, 5)])
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]]
    measured[7] = measured[7] @ se3.exp(np.full(6, 1.0))
    ids = np.arange(10, 16)
    write_g2o(tmp_path / "in.g2o", ViewGraph.from_edges(ids, edges, measured, np.tile(np.eye(6), (9, 1, 1))), truth)
    folder = tmp_path / "run"
    first = json.loads(hodge("solve", tmp_path / "in.g2o", "--run", folder, "--json"))
    assert first["cost_after"] > 0.1
    hodge("edit", folder, "--disable", "14-11")
    edited = json.loads(hodge("solve", folder, "--json"))
    assert edited["cost_after"] < 1e-9
    assert json.loads((folder / "solved.json").read_text())["edges_ignored"] == 1
    hodge("edit", folder, "--undo")
    assert json.loads(hodge("solve", folder, "--json"))["cost_after"] == pytest.approx(first["cost_after"])

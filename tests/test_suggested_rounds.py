"""Suggested pairs registered: by the recipe, round after round, and by hand with `hodge edit --register`."""

import json
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from command import rows_of
from command import told as hodge
from hodge_pipeline.errors import GraphError, WorkspaceError
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.run_folder import Run
from hodge_pipeline.uses.recipe_run import solve_again
from synthetic import tiny_sequence  # noqa: F401 - a fixture

CHAIN = (
    "clouds.voxel_m=0.06", "fusion=[]", "executor.workers=0", "recording.level=off", "evaluation.tables=false",
    "outer_iterations=1", "edges={stage: sequential}",
)  # fmt: skip


def chain(source: Path, *overrides: str) -> Recipe:
    return load_recipe("demo", [*CHAIN, *overrides], source)


@pytest.fixture(scope="module")
def run(tiny_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:  # noqa: F811
    """A chain of frames, no edge of which can be tested."""
    return hodge_pipeline.run(chain(tiny_sequence), tmp_path_factory.mktemp("runs") / "chain")


def test_rounds_of_suggestions_make_a_chain_testable_and_end_by_themselves(run: Run, tmp_path: Path) -> None:
    assert {row["verdict"] for row in rows_of(run.folder)} == {"untestable"}
    assert run.source.path is not None
    recipe = chain(run.source.path, "suggestions={rounds: 9, pairs: 12, min_gain: 0.8}")
    more = hodge_pipeline.run(recipe, tmp_path / "more")
    rows = rows_of(more.folder)
    verdicts = [row["verdict"] for row in rows]
    assert "untestable" not in verdicts and "wrong" not in verdicts and verdicts.count("consistent") > 40
    assert [row["source"] for row in rows].count("sequential") == 23
    suggested = [row for row in rows if row["source"] == "suggested"]
    assert 11 <= len(suggested) == len(rows) - 23
    told = [str(note) for note in more.report.notes if note.kind == "suggested"]
    assert "before it 23 of 23 edges could not be tested" in told[0]
    assert 1 <= len(told) < 9
    errors = {row.name: row.ate_rmse_m for row in more.report.trajectories}
    assert errors["result"] <= errors["round 1"]
    again = hodge_pipeline.run(recipe, tmp_path / "more")
    np.testing.assert_array_equal(again.result.world_from_cam, more.result.world_from_cam)


def test_what_the_table_says_to_register_is_registered(run: Run) -> None:
    folder, before = run.folder, run.result.world_from_cam
    answer = json.loads(hodge("diagnose", folder, "--json"))
    command, solve = answer["commands"]
    pairs = command.split("--register ")[1].split(",")
    assert pairs[0] == "{i}-{j}".format(**answer["register_next"][0])
    assert solve == f"hodge solve {folder}"
    told = hodge(*command.split()[1:])
    assert f"registered {pairs[0]}  (no edge yet)" in told
    hodge("solve", folder)
    rows = {f"{row['i']}-{row['j']}": row for row in rows_of(folder)}
    assert [rows[pair]["source"] for pair in pairs] == ["by_hand"] * len(pairs)
    tested = sum(row["verdict"] == "consistent" for row in rows.values())
    assert tested >= 2 * len(pairs)
    with pytest.raises(GraphError, match="is an edge already"):
        hodge("edit", folder, "--register", pairs[0])
    hodge("edit", folder, "--disable", pairs[0])
    solve_again(folder)
    rows = {f"{row['i']}-{row['j']}": row for row in rows_of(folder)}
    assert rows[pairs[0]]["status"] == "disabled" and rows[pairs[1]]["status"] == "used"
    hodge("edit", folder, "--undo")
    hodge("edit", folder, "--undo")
    np.testing.assert_array_equal(solve_again(folder).result.world_from_cam, before)


def test_a_pair_that_sees_too_little_in_common_is_registered_rejected_and_said(run: Run, tmp_path: Path) -> None:
    assert run.source.path is not None
    strict = hodge_pipeline.run(chain(run.source.path, "acceptance.min_fitness=0.5"), tmp_path / "strict")
    hodge("edit", strict.folder, "--register", "0-12")
    again = solve_again(strict.folder)
    assert [0, 12] in again.result.rejected.pairs.tolist()
    assert any("0-12 was registered and rejected" in str(note) for note in again.report.notes)


def test_two_pieces_are_joined_without_a_guess(run: Run) -> None:
    hodge("edit", run.folder, "--disable", "11-12", "--register", "11-13,10-12")
    again = solve_again(run.folder)
    hodge("edit", run.folder, "--undo")
    solve_again(run.folder)
    ends = again.result.graph.edges.tolist()
    assert [again.result.graph.source[ends.index(pair)] for pair in ([10, 12], [11, 13])] == ["by_hand"] * 2
    assert [part.count for part in again.report.graph.components] == [24]
    errors = {row.name: row.ate_rmse_m for row in again.report.trajectories}
    assert errors["result"] < errors["round 1"] + 0.02


def test_mistakes_are_one_line(run: Run, tmp_path: Path) -> None:
    for pair in ("0-99", "0", "3-3"):
        with pytest.raises(
            GraphError,
            match=rf"{pair}: names no two frames of the graph \(\d+ from .*key frames alone\)",
        ):
            hodge("edit", run.folder, "--register", pair)
    with pytest.raises(GraphError, match="no edge that counts is wrong"):
        hodge("edit", run.folder, "--disable", "wrong")
    (tmp_path / "edges.csv").write_text("i,j,source,status\n0,1,given,used\n")
    with pytest.raises(WorkspaceError, match="is no run folder"):
        hodge("edit", tmp_path, "--register", "0-1")

"""The paper's tables: its figures, the marks, the formats, the peer's poses, where sequences are looked for."""

from __future__ import annotations

import csv
import io
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from benchmarks.paper.__main__ import paper
from benchmarks.paper.picture import draw_comparison
from benchmarks.paper.sequences import find_sequences, peer_poses, recipe_file
from benchmarks.paper.tables import (
    PAPER_SCORES,
    SEQUENCES,
    Measured,
    Results,
    as_csv,
    as_html,
    as_markdown,
    deviation,
    tables,
)
from complex_graphs import random_motions
from hodge_pipeline import registry, se3
from hodge_pipeline.errors import RecipeError, SourceError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.types import Bytes, Camera, Edges, Floats32, Frame

KITCHEN = Measured(
    frames=250, pairs=1732, truth=0.86530, first=0.87421, third=0.87474,
    deviations=(9.3e-11, 8.1e-12, 7.7e-12), step_deviations=(0.259, 4.2e-5, 9.3e-11),
    measured_deviation=14.41, loops=1545,
    wall_s=88.0, cpu_s=95.0, peer=0.8612, ate_m=(0.1056, 0.07),
)  # fmt: skip
RESULTS = Results({"redkitchen": {"distance": KITCHEN}}, {"fire": "not | present"}, "bundlefusion")


def cells(row_of: str, title: str) -> dict[str, str]:
    (table,) = (table for table in tables(RESULTS) if table.title.startswith(title))
    (row,) = (row for row in table.rows if row[0] == row_of)
    return dict(zip(table.header, row, strict=True))


def test_our_figures_stand_beside_the_papers_and_the_best_is_marked() -> None:
    row = cells("redkitchen", "Table 1")
    assert (row["GT, paper"], row["GT, ours"]) == ("0.863", "0.8653")
    assert (row["BF, ours"], row["Hodge 1st, ours"], row["Hodge 3rd, ours"]) == ("0.8612", "0.8742", "0.8747*")
    assert row["pairs"] == "1732"


def test_absent_sequences_keep_the_papers_figures_and_say_why() -> None:
    assert cells("fire", "Table 1")["note"] == "not | present"
    assert cells("fire", "Table 1")["Hodge 1st, paper"] == "0.870*"
    assert cells("office2", "Table 2")["BF, paper"] == "–"
    assert cells("redkitchen", "Table 2")["Hodge 1st, ours"] == "–"
    for kind in ("distance", "iou"):
        assert set(PAPER_SCORES[kind]) <= set(SEQUENCES)


def test_deviations_are_rounded_as_in_the_paper_and_their_size_is_kept() -> None:
    assert [deviation(v) for v in (14.41, 7.28e-2, 4.2e-5, 0.0)] == ["14.41", "7.28e-02", "0.00 (4.2e-05)", "0.00"]
    row = cells("redkitchen", "Table 3")
    assert (row["Hodge 1st, paper"], row["step 1 of Hodge 1st"]) == ("7.28e-02", "2.59e-01")
    assert row["step 2 of Hodge 1st"].startswith("0.00")


def test_hodge_1st_is_the_same_round_in_every_table() -> None:
    """A round ends with its last step: D of the first step beside the score of the whole round is another iteration."""
    assert cells("redkitchen", "Table 3")["Hodge 1st, ours"] == deviation(KITCHEN.step_deviations[-1])
    named = [{name for name in table.header if name.startswith("Hodge 1st")} for table in tables(RESULTS)[:3]]
    assert named[0] == named[1] == named[2]


def test_every_format_holds_every_table() -> None:
    shown = tables(RESULTS)
    markdown, page = as_markdown(shown, "The tables"), as_html(shown, "The tables", {"a < b": "kitchen.png"})
    widths = [line.count("|") - line.count("\\|") for line in markdown.splitlines() if line.startswith("|")]
    expected = [len(table.header) + 1 for table in shown for _ in range(len(table.rows) + 2)]
    assert widths == expected
    assert "a &lt; b" in page and 'src="kitchen.png"' in page

    class Counter(HTMLParser):
        rows = 0

        def handle_starttag(self, tag: str, attrs: object) -> None:
            self.rows += tag == "tr"

    counter = Counter()
    counter.feed(page)
    assert counter.rows == sum(len(table.rows) + 1 for table in shown)
    rows = list(csv.DictReader(io.StringIO(as_csv(shown))))
    (value,) = (
        r["value"] for r in rows if r["row"] == "redkitchen" and r["column"] == "Hodge 3rd, ours" and "1." in r["table"]
    )
    assert float(value) == 0.8747


@pytest.mark.parametrize("kind", ["distance", "iou", "sift"])
def test_the_papers_recipes_reject_no_registered_pair(kind: str) -> None:
    recipe = load_recipe(recipe_file(kind), [], "frames")
    assert recipe.start.relocalise is False and recipe.start.tail is None  # type: ignore[attr-defined]
    count = 3
    poor = Edges.of(np.array([[0, 2], [0, 3], [1, 3]])).put(
        slice(None),
        i_from_j=np.tile(np.eye(4), (count, 1, 1)), information=np.zeros((count, 6, 6)),
        fitness=0.01, rmse_m=1.0, correspondences=1,
    )  # fmt: skip
    assert (recipe.acceptance.reasons(poor) == "").all()


def frames(count: int) -> list[Frame]:
    return [Frame(4 * k, 4.0 * k) for k in range(count)]


def test_bundlefusion_writes_one_file_a_frame_and_minus_infinity_where_lost(tmp_path: Path) -> None:
    poses = random_motions(0, 3)
    folder = tmp_path / "redkitchen"
    folder.mkdir()
    for k in (0, 2):
        np.savetxt(folder / f"frame-{4 * k:06d}.pose.txt", poses[k])
    np.savetxt(folder / "frame-000004.pose.txt", np.full((4, 4), -np.inf))
    found, note = peer_poses(tmp_path, "redkitchen", frames(3))
    np.testing.assert_allclose(found[[0, 2]], poses[[0, 2]])
    assert np.isnan(found[1]).all()
    assert note == "peer: 2 of 3 poses"


def test_a_tum_file_is_associated_by_stamp(tmp_path: Path) -> None:
    poses = random_motions(1, 3)
    rows = np.column_stack([[8.0, 0.0, 4.01], poses[[2, 0, 1], :3, 3], se3.to_quat_xyzw(poses[[2, 0, 1]])])
    np.savetxt(tmp_path / "redkitchen.txt", rows, header="stamp tx ty tz qx qy qz qw")
    found, _ = peer_poses(tmp_path, "redkitchen", frames(4))
    np.testing.assert_allclose(found[:3], poses, atol=1e-6)
    assert np.isnan(found[3]).all()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("frame-000000.pose.txt", "1 0 0", "has 3 numbers"),
        ("frame-000000.pose.txt", "one", "16 numbers"),
        ("frame-000001.pose.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "belongs to a frame"),
        ("redkitchen.txt", "0 1 2 3\n", "rows of 4 numbers"),
        ("redkitchen.txt", "what is this\n", "cannot be read"),
        ("readme.txt", "", "expected frame-000000.pose.txt"),
    ],
)
def test_peer_poses_that_cannot_be_used_say_what_is_wrong(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match=message):
        peer_poses(tmp_path, "redkitchen", frames(2))


def test_sequences_are_found_in_the_real_data_and_thinned(data_dir: Path) -> None:
    found, missing = find_sequences(data_dir, 100)
    names = [sequence.name for sequence in found]
    if "redkitchen" not in names:
        pytest.skip(f"no red kitchen in {data_dir}")
    kitchen = found[names.index("redkitchen")]
    assert (kitchen.reader, kitchen.every, kitchen.folder.name) == ("seven_scenes", 3, "seq-01")
    assert set(names) | set(missing) == set(SEQUENCES)
    assert "stairs" in missing, "twelve frames of its sample are not the sequence"


def test_a_data_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such folder"):
        find_sequences(tmp_path / "nowhere", 250)
    assert find_sequences(tmp_path, 250)[0] == []


def wall() -> Floats32:
    return np.full((60, 80), 2.0, np.float32)


def red() -> Bytes:
    return np.full((60, 80, 3), (200, 0, 0), np.uint8)


def test_the_picture_shows_every_set_of_poses_from_the_same_places(tmp_path: Path) -> None:
    import matplotlib.image

    camera = Camera(80, 60, 70.0, 70.0, 40.0, 30.0)
    views = [Frame(k, float(k), camera, read_depth=wall, read_colour=red) for k in range(6)]
    poses = np.broadcast_to(np.eye(4), (6, 4, 4)).copy()
    poses[:, 0, 3] = np.linspace(0, 0.3, 6)
    lost = poses.copy()
    lost[2] = np.nan
    draw_comparison(tmp_path / "one.png", views, {"GT": poses})
    draw_comparison(tmp_path / "two.png", views, {"GT": poses, "ours": lost})
    one, two = (matplotlib.image.imread(tmp_path / f"{name}.png") for name in ("one", "two"))
    assert two.shape[0] == pytest.approx(2 * one.shape[0], abs=2)
    is_red = two[..., 0] - two[..., 1] > 0.1
    half = len(two) // 2
    assert is_red[:half].sum() > 1000
    assert 0.6 < is_red[half:].sum() / is_red[:half].sum() < 1.0, "one frame of six is missing"


def test_the_command_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    runner = CliRunner()
    app = typer.Typer()
    app.command()(paper)
    empty = runner.invoke(app, ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")])
    assert isinstance(empty.exception, SourceError) and "redkitchen: not present" in str(empty.exception)
    for peer, message in (("bundlefusion", "NAME=DIR"), (f"x={tmp_path / 'none'}", "no such folder")):
        refused = runner.invoke(app, ["--data", str(tmp_path / "data"), "--peer", peer])
        assert isinstance(refused.exception, RecipeError) and message in str(refused.exception)


def test_who_asks_for_the_papers_method_is_told_of_its_plugin() -> None:
    for name in ("paper", "paper_iou"):
        assert "pip install ./benchmarks/paper/method" in registry.suggestion(name, ["poisson"])
    assert registry.suggestion("poison", ["poisson"]) == " (did you mean 'poisson'?)"

"""The report: its page, its numbers and its lines in the terminal, read back."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from hodge_pipeline import se3
from hodge_pipeline.evaluation.cloud_distance import NO_NEIGHBOUR_M
from hodge_pipeline.evaluation.difference import length, percent
from hodge_pipeline.evaluation.scores import GraphScores, ScoreTable
from hodge_pipeline.report.brief import all_notes, brief
from hodge_pipeline.report.contents import (
    EdgeRow,
    Path3D,
    Report,
    Residuals,
    SourceSummary,
    StageRow,
)
from hodge_pipeline.report.plots import _residuals
from hodge_pipeline.report.run_page import document
from hodge_pipeline.report.summary import graph_summary, in_runs, trajectory_rows
from hodge_pipeline.report.suspicions import suspicions
from hodge_pipeline.report.tables import score_tables, stages_table, worst_edges_table
from hodge_pipeline.report.words import next_commands, worst_places
from hodge_pipeline.report.write import as_json, write_report
from hodge_pipeline.types import Edges
from hodge_pipeline.types.notes import Note
from report_data import circle, make_report, read_page, scored


@pytest.fixture(scope="module")
def report() -> Report:
    return make_report()


@pytest.mark.draws
def test_the_page_is_small_well_formed_and_asks_for_nothing(report: Report, tmp_path: Path) -> None:
    page, _ = write_report(tmp_path, report)
    text, addresses = read_page(page)
    assert page.stat().st_size < 3_000_000
    assert len(addresses) == 7
    assert all(address.startswith("data:image/png;base64,") for address in addresses)
    assert not re.search(r"https?://|@import|url\(", page.read_text("utf-8"))
    for expected in ("A <ring> & its loop", "Improved against odometry", "107", "2 pairs were tried twice", "# <ring>"):
        assert expected in text


def test_json_reads_back_with_the_numbers(report: Report, tmp_path: Path) -> None:
    _, numbers = write_report(tmp_path, report)
    found = json.loads(numbers.read_text("utf-8"))
    assert list(found)[:3] == ["format_version", "title", "verdict"]
    assert found["verdict"]["outcome"] == "improved"
    assert found["scores"]["graphs"]["iou"]["poses"]["odometry"]["distance_m"] == pytest.approx(0.02)
    assert found["scores"]["graphs"]["distance"]["edges"] == 3
    assert found["graph"]["edges_by_source"] == {"sequential": 20}
    assert found["worst_edges"][0]["fitness"] is None  # NaN: unknown
    assert found["loops"][0]["mean"] == 0.5
    assert found["stages"][1]["cpu_s"] == 3.5


@pytest.mark.draws
def test_the_same_report_gives_the_same_bytes(report: Report, tmp_path: Path) -> None:
    first, second = ([path.read_bytes() for path in write_report(tmp_path, report)] for _ in range(2))
    assert first == second


def test_an_empty_report_still_says_what_it_is(tmp_path: Path) -> None:
    report = Report("nothing", SourceSummary("tum", "x", 0))
    text, addresses = read_page(write_report(tmp_path, report)[0])
    assert "Not measured" in text
    assert "no true poses" in text
    assert addresses == []
    assert as_json(report)["scores"] is None


def test_frames_that_cannot_be_drawn_are_no_error(report: Report, tmp_path: Path) -> None:
    nowhere = np.full((3, 3), np.nan)
    still = np.zeros((3, 3))
    lost = Residuals("result", np.full(20, np.nan), np.full(20, np.nan))
    pictures = replace(
        report.pictures,
        paths=(Path3D("truth", nowhere), Path3D("result", still)),
        component=np.array([0, 0, 1]),
        residuals=(lost,),
        convergence={"first": (0.0, -1.0)},
    )
    unknown = scored(np.nan, np.nan, np.nan)
    _, addresses = read_page(write_report(tmp_path, replace(report, pictures=pictures, scores=unknown))[0])
    assert len(addresses) == 5


def test_the_first_lines_say_where_it_is_worst_and_what_to_type(report: Report) -> None:
    names = tuple(str(100 + row) for row in range(20))
    truth, before, after = report.pictures.paths
    off = after.positions.copy()
    off[13] += [0.0, 0.3, 0.0]
    pictures = replace(report.pictures, paths=(truth, before, Path3D("result", off)), names=names)
    assert report.graph is not None
    suspect = replace(report.graph, verdicts_in_use={"suspect": 1})
    page = document(replace(report, pictures=pictures, graph=suspect), "runs/a")
    worst, now = page.first
    assert worst.lines[0] == "Frame 113 lies 30.2 cm off the truth, more than any other."
    assert worst.lines[1].startswith("Of the edges that count, 107–108 fits least: it is 5")
    assert list(next_commands(report, "my run"))[1] == "hodge view 'my run' --web"
    assert "hodge view runs/a --web" in now.text and "hodge diagnose runs/a" in now.text
    assert "hodge edit" not in now.text, "nothing is known to be wrong"
    assert "hodge diagnose" not in document(report, "runs/a").first[1].text


def test_what_nobody_measured_has_no_column_and_no_number(report: Report) -> None:
    """A solved pose graph has no fitness, no verdicts, and no memory that was measured."""
    assert worst_edges_table(report).header == ("i", "j", "source", "weight", "off by", "turned by")
    judged = replace(report.worst_edges[0], fitness=0.5, verdict="wrong")
    table = worst_edges_table(replace(report, worst_edges=(judged, *report.worst_edges[1:])))
    assert {"fitness", "verdict"} <= set(table.header) and {len(row) for row in table.rows} == {8}
    solved = replace(report, stages=(StageRow("solve", 1.0, 2.0, float("nan")),))
    assert "nan" not in str(stages_table(solved)) and "time     1.0 s, 2.0 CPU s" in brief(solved, "x")


def test_a_caption_says_what_the_words_of_its_table_mean(report: Report) -> None:
    caption = next(table for table in score_tables(report) if table.title == "Scores").caption
    assert "centroids lie less than 20 cm apart" in caption or "voxels of 10 cm" in caption
    judged = replace(report.worst_edges[0], why="it agrees with the backbone and 9 other loops")
    assert "Backbone: " in worst_edges_table(replace(report, worst_edges=(judged,))).caption
    assert "Backbone: " not in worst_edges_table(report).caption
    figure = Figure()
    _residuals(figure, report)
    told = [text.get_text() for axes in figure.axes for text in axes.get_legend().get_texts()]
    assert "median" in told[0] and all(text.endswith((" cm", "°")) for text in told if "median" in text)


def test_a_refinement_that_is_not_kept_is_not_called_the_result(report: Report) -> None:
    names = tuple(map(str, range(20)))
    shown = replace(report, shows_rejected=True, pictures=replace(report.pictures, names=names))
    assert next(worst_places(shown)).startswith("In the refinement, which is not kept, frame ")
    told = [section.title for section in document(shown, "x").sections if "which is not kept" in section.caption]
    assert told == ["The place that changed most", "Errors and graph", "The scene from four sides"]
    assert next(worst_places(replace(shown, shows_rejected=False))).startswith("Frame ")


def test_the_worst_frame_is_the_one_of_the_largest_error_of_all_frames(report: Report) -> None:
    truth = np.tile(np.eye(4), (6, 1, 1))
    truth[:, 0, 3] = np.arange(6)
    poses = truth.copy()
    poses[4, 1, 3] = 0.3
    (row,) = trajectory_rows({"result": poses}, truth, names=[f"f{number}" for number in range(6)])
    assert row.worst == "f4"
    rows = (row, replace(row, name="before", ate_rmse_m=3.0))
    places = worst_places(replace(report, after="result", trajectories=rows))
    assert next(places) == f"Frame f4 lies {row.ate_max_m:.3g} m off the truth, more than any other.", (
        "in the table's unit"
    )


def test_a_length_has_no_unit_where_none_is_known(report: Report) -> None:
    page = document(replace(report, has_metres=False), "runs/a")
    assert page.first[0].lines[0].endswith("it is 0.5 and 0.2° off the result.") or "0.50" in page.first[0].lines[0]


def test_an_edge_that_fits_exactly_since_no_loop_passes_it_is_not_the_worst(report: Report) -> None:
    exact = EdgeRow("1", "2", "overlap", 0.5, 1.0, 1e-17, 1e-15)
    assert any(
        "1–2 fits least" in place
        for place in worst_places(replace(report, worst_edges=(replace(exact, residual_m=1.0),)))
    )
    assert not any("fits least" in place for place in worst_places(replace(report, worst_edges=(exact,))))


def test_an_ignored_edge_is_not_called_used(report: Report) -> None:
    ignored = EdgeRow("1", "2", "overlap", 0.5, 0.0, 1.0, 20.0)
    assert not any("that the solver used" in str(line) for line in suspicions(replace(report, worst_edges=(ignored,))))


def test_parts_are_listed_largest_first_as_the_source_names_them(report: Report) -> None:
    assert report.pictures.graph is not None
    component = np.array([1, 0, 0, 1, 0] + [0] * 15)
    graph = report.pictures.graph
    parts = graph_summary(Edges.measured(graph), graph.vertex_ids, component).components
    assert [(part.count, part.frames) for part in parts] == [(18, "101–102, 104–119"), (2, "100, 103")]
    assert in_runs(np.arange(0, 60, 2), np.arange(60)).endswith("20, 22, and 18 more")
    assert in_runs(np.zeros(0, np.int64), np.arange(3)) == "none"


def test_relative_motions_are_as_long_as_the_recipe_says(report: Report) -> None:
    truth = circle(6)
    drifting = np.stack([se3.exp(np.array([0, 0, 0, 0.01 * k, 0, 0])) @ pose for k, pose in enumerate(truth)])
    for delta_frames in (1, 3):
        (row,) = trajectory_rows({"result": drifting}, truth, delta_frames=delta_frames)
        assert row.rpe_translation_m == pytest.approx(0.01 * delta_frames, rel=1e-6)
        assert row.rpe_delta_frames == delta_frames
        told = next(t for t in score_tables(replace(report, trajectories=(row,))) if t.title == "Trajectory").caption
        assert ("from each frame to the one 3 frames on" in told) == (delta_frames == 3)
        assert ("from each frame to the next" in told) == (delta_frames == 1)


def test_relative_motions_stop_at_the_end_of_a_sequence() -> None:
    truth = circle(6)
    jumped = truth.copy()
    jumped[3:] = se3.exp(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])) @ jumped[3:]
    sequence = ["a"] * 3 + ["b"] * 3
    (split,) = trajectory_rows({"result": jumped}, truth, sequence=sequence)
    (whole,) = trajectory_rows({"result": jumped}, truth)
    assert split.rpe_translation_m == pytest.approx(0, abs=1e-9)
    assert whole.rpe_translation_m > 0.1
    assert split.ate_rmse_m > 0.1


def test_frames_that_nothing_joins_do_not_flatter_the_error() -> None:
    truth = circle(8)
    poses = truth.copy()
    poses[::2, :3, 3] += 0.1
    component = np.array([0, 0, 0, 0, 0, 0, 1, 2])
    (row,) = trajectory_rows({"result": poses}, truth, component)
    (joined,) = trajectory_rows({"result": poses[:6]}, truth[:6], component[:6])
    assert row.ate_rmse_m == pytest.approx(joined.ate_rmse_m)
    assert (row.frames, row.left_out, row.degenerate) == (6, 2, False)


def test_where_nothing_is_joined_no_error_is_measured(report: Report) -> None:
    """Each frame, aligned by itself, fits its truth to the last bit."""
    (row,) = trajectory_rows({"result": circle(3)}, circle(3), np.arange(3))
    assert (row.frames, row.left_out) == (0, 3) and np.isnan(row.ate_rmse_m)
    paths = tuple(replace(path, positions=report.pictures.paths[0].positions + 1e-16) for path in report.pictures.paths)
    exact = replace(report, pictures=replace(report.pictures, paths=paths, names=tuple("abcdefghijklmnopqrst")))
    assert not any("off the truth" in place for place in worst_places(replace(exact, trajectories=())))


def test_tables_and_terminal_lines(report: Report) -> None:
    scores, trajectory = score_tables(report)
    assert scores.rows[1][:4] == ("odometry", "0.7486", "20.00 mm", "3")
    assert all(len(row) == len(table.header) for table in (scores, trajectory) for row in table.rows)
    assert all_notes(report)[0] == "note     2 pairs were tried twice"


def test_the_terminal_gets_ten_lines_of_80_columns(report: Report) -> None:
    notes = (Note("parts", 3), Note("carried", 7), Note("no decomposition", detail="word " * 60))
    for shown in (report, replace(report, notes=notes)):
        lines = brief(shown, "runs/a")
        assert len(lines) <= 10 and max(map(len, lines)) <= 80
        assert lines[0] == "verdict  Improved against odometry" and lines[1].startswith("  - ATE ")
        assert "time     3.0 s, 4.0 CPU s in the stages, at most 300 MB" in lines
        assert lines[-2:] == ["report   runs/a/report.html", "next     hodge view runs/a --web"]
    assert "  - … and 4 more measures: --verbose" in lines
    assert "look     The viewing graph falls into 3 parts that nothing connects …" in lines, "cut at a clause"
    assert any(line.endswith(" …") for line in lines), "a long note is cut"


def test_numbers_in_words() -> None:
    assert [length(value) for value in (0.0012, 0.0305, 1.303, float("nan"))] == ["1.2 mm", "3.05 cm", "1.3 m", "–"]
    assert [percent(value) for value in (-0.406, 0.1, -0.004, 0.0)] == ["−41 %", "+10 %", "0 %", "0 %"]


def test_what_is_a_large_residual_and_how_many_pairs_may_see_nothing_goes_by_the_scene(report: Report) -> None:
    def said(scale: float, unmatched: int) -> str:
        distances_m = np.full((1, 200), 0.01 * scale)
        distances_m[0, :unmatched] = NO_NEIGHBOUR_M * scale
        pairs = np.stack([np.arange(200), np.arange(1, 201)], axis=1)
        scores = ScoreTable(("result",), "result", (GraphScores("iou", pairs, distances_m, scale),))
        far = replace(report.worst_edges[0], residual_m=0.15, residual_deg=0.0, weight=1.0)
        return "\n".join(map(str, suspicions(replace(report, scores=scores, worst_edges=(far,)))))

    assert "1 edge that the solver used is more than 10 cm" in said(1.0, 0)
    assert "that the solver used are more than" not in said(10.0, 0)
    assert "have no point within" not in said(1.0, 2)
    assert "result: 3 of 200" in said(1.0, 3)

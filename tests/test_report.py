"""The report: its verdict by hand, its page and its numbers read back."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline import se3
from hodge_pipeline.evaluation.cloud_distance import NO_NEIGHBOUR_M
from hodge_pipeline.evaluation.difference import MEASURABLE, length, percent, sign_of
from hodge_pipeline.evaluation.residuals import edge_residuals, with_residuals
from hodge_pipeline.evaluation.scores import GraphScores, ScoreTable
from hodge_pipeline.report.brief import all_notes, brief
from hodge_pipeline.report.contents import (
    EdgeRow,
    LoopRow,
    Path3D,
    Pictures,
    RefinementSummary,
    Report,
    Residuals,
    SourceSummary,
    StageRow,
    TrajectoryRow,
    WrongEdges,
)
from hodge_pipeline.report.run_page import document
from hodge_pipeline.report.summary import graph_summary, in_runs, trajectory_rows, weigh_wrong, worst_edges
from hodge_pipeline.report.tables import score_tables
from hodge_pipeline.report.verdict import judge, suspicions
from hodge_pipeline.report.write import as_json, write_report
from hodge_pipeline.scene import Round
from hodge_pipeline.solvers.maximum_likelihood import MaximumLikelihoodSolver
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.types import Edges, Floats, ViewGraph
from hodge_pipeline.types.notes import Note, Rank

VOID = {"meta", "img", "br"}


def circle(count: int = 20) -> Floats:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    zeros = np.zeros(count)
    turned = se3.exp(np.stack([zeros, zeros, angle, zeros, zeros, zeros], axis=1))
    turned[:, :3, 3] = np.stack([np.cos(angle), np.sin(angle), zeros], axis=1)
    return turned


def shaken(poses: Floats, size: float) -> Floats:
    return poses @ se3.exp(np.random.default_rng(0).normal(scale=size, size=(len(poses), 6)))


def ring(poses: Floats) -> ViewGraph:
    """Each frame with the next, measured exactly, but for one edge that is 0.5 m off."""
    count = len(poses)
    edges = np.array([(k, (k + 1) % count) for k in range(count)])
    i_from_j = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    i_from_j[7, 0, 3] += 0.5
    return ViewGraph.from_edges(np.arange(100, 100 + count), edges, i_from_j, source="sequential")


def scored(*mean_distances_m: float) -> ScoreTable:
    distances_m = np.outer(mean_distances_m, [0.9, 1.0, 1.1])
    pairs = np.array([(0, 1), (1, 2), (2, 3)])
    graphs = (GraphScores("distance", pairs, distances_m), GraphScores("iou", pairs, distances_m))
    return ScoreTable(("truth", "odometry", "result"), "truth", graphs)


@pytest.fixture(scope="module")
def report() -> Report:
    truth = circle()
    sets = {"odometry": shaken(truth, 0.03), "result": shaken(truth, 0.003)}
    graph = ring(truth)
    weights = np.ones(20)
    weights[3] = 0
    edges = with_residuals(Edges.measured(graph), sets["result"], weights)
    rejected = Edges.of([[0, 5]] * 5).put(slice(None), status="rejected", why="fitness below 0.3")
    return Report(
        title="A <ring> & its loop",
        source=SourceSummary(
            "seven_scenes", "data/ring", 20, 20, ("one", "two"), ("1 frame was unreadable: left out",)
        ),
        scores=scored(0.010, 0.020, 0.012),
        trajectories=trajectory_rows(sets, truth),
        loops=(LoopRow("measured", 4, 2.0), LoopRow("step 1", 4, 1e-3)),
        graph=graph_summary(Edges.joined([edges, rejected]), graph.vertex_ids, np.zeros(20, np.int64)),
        worst_edges=worst_edges(edges, graph.vertex_ids, 3),
        stages=(StageRow("read", 1.0, 0.5, 100.0), StageRow("solve", 2.0, 3.5, 300.0)),
        notes=(Note("solver", detail="2 pairs were tried twice"),),
        versions={"hodge-pipeline": "0.1.0"},
        recipe="reader: seven_scenes  # <ring>\n",
        pictures=Pictures(
            paths=tuple(Path3D(name, poses[:, :3, 3]) for name, poses in {"truth": truth, **sets}.items()),
            component=np.zeros(20, np.int64),
            residuals=tuple(Residuals(name, *edge_residuals(graph, poses)) for name, poses in sets.items()),
            graph=graph,
            convergence={"first": (10.0, 2.0, 1.9)},
        ),
    )


class WellFormed(HTMLParser):
    """Fails on an element that is closed out of order; collects text and addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.addresses: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name == "src"]
        self.links += [value or "" for name, value in attrs if name == "href"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def read_page(path: Path) -> tuple[str, list[str]]:
    page = WellFormed()
    page.feed(path.read_text("utf-8"))
    assert not page.open and all(link.startswith("#") for link in page.links)
    return "".join(page.text), page.addresses


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


@pytest.mark.parametrize(
    ("before_m", "after_m", "outcome", "words"),
    [
        (0.020, 0.012, "improved", "fell from 20 mm to 12 mm (−40 %)"),
        (0.010, 0.015, "worse", "rose from 10 mm to 15 mm (+50 %)"),
        (0.010, 0.0101, "unchanged", "hardly changed, from 10 mm to 10.1 mm (+1 %)"),
    ],
)
def test_the_verdict_follows_the_scores(before_m: float, after_m: float, outcome: str, words: str) -> None:
    verdict = judge(Report("r", SourceSummary("tum", "x", 4), scores=scored(0.01, before_m, after_m)))
    assert verdict.outcome == outcome
    assert words in verdict.sentence


def test_errors_that_disagree_are_mixed(report: Report) -> None:
    verdict = judge(replace(report, scores=scored(0.01, 0.01, 0.02)))
    assert verdict.outcome == "mixed"
    best, bad = verdict.headline.split(", but ")
    assert best == "Mixed against odometry: RPE of the rotation 4.43° → 0.443° and 2 more better"
    assert bad.startswith("distance of clouds (near-centroid pairs) 10 mm → 20 mm, distance of clouds (overlapping")
    assert [change.sign for change in verdict.changes] == [-1, -1, 1, 1, 1]


def told(before_m: tuple[float, float], after_m: tuple[float, float], extent_m: float = 4.0) -> Report:
    """A report of ATE and RPE before and after alone, along a path of this extent."""
    rows = tuple(
        TrajectoryRow(name, 20, 0, ate, ate, ate, rpe, 0.2)
        for name, (ate, rpe) in (("odometry", before_m), ("result", after_m))
    )
    path = Path3D("result", np.array([[0.0, 0, 0], [extent_m, 0, 0]]))
    return Report("r", SourceSummary("tum", "x", 20), trajectories=rows, pictures=Pictures(paths=(path,)))


def test_a_measure_that_got_worse_is_named_in_the_headline() -> None:
    verdict = judge(told((0.5, 0.017), (0.4, 0.020)))
    assert verdict.outcome == "mixed"
    assert verdict.headline == "Mixed against odometry: ATE 50 cm → 40 cm, but RPE 17 mm → 20 mm"
    assert "the error of the motion from frame to frame (RPE) rose from 17 mm to 20 mm (+18 %)" in verdict.details


def test_a_largest_error_that_got_worse_is_named_too() -> None:
    report = told((0.5, 0.020), (0.4, 0.017))
    start, result = report.trajectories
    rows = (start, replace(result, ate_max_m=0.7))
    verdict = judge(replace(report, trajectories=rows))
    assert verdict.headline.endswith(", but largest error 50 cm → 70 cm") and verdict.outcome == "mixed"
    refined = RefinementSummary("refined", "Better than the poses given", "clouds lie nearer")
    verdict = judge(replace(report, trajectories=rows, refinement=refined))
    assert verdict.headline == "Better than the poses given, but largest error 50 cm → 70 cm"


def test_a_difference_below_what_was_measured_is_none(tmp_path: Path) -> None:
    report = told((1e-17, 3e-18), (3e-17, 1e-17))
    verdict = judge(report)
    assert verdict.outcome == "unchanged" and verdict.headline == "Unchanged against odometry"
    assert [change.share for change in verdict.changes] == [0, 0, 0]
    assert "(ATE) is unchanged at < 0.004 mm" in verdict.sentence, "a millionth of 4 m"
    page, numbers = write_report(tmp_path, report)
    assert not re.search(r"e-1\d", read_page(page)[0] + verdict.sentence)
    assert json.loads(numbers.read_text("utf-8"))["verdict"]["outcome"] == "unchanged"


def test_what_can_be_measured_goes_by_the_extent_of_the_scene() -> None:
    assert judge(told((2e-6, 1.0), (3e-6, 1.0), extent_m=4.0)).outcome == "unchanged"
    assert judge(told((2e-6, 1.0), (3e-6, 1.0), extent_m=0.4)).outcome == "worse"
    assert judge(told((1e-17, 1.0), (0.003, 1.0))).details.startswith(
        "the error of the trajectory (ATE) rose from < 0.004 mm to 3 mm;"
    ), "no share of nothing"
    assert sign_of(1.0, 1.0 + MEASURABLE, 2 * MEASURABLE) == 0


@pytest.mark.parametrize(
    ("component", "unordered", "headline"),
    [
        ([0] * 12 + [1] * 8, False, "In 2 pieces (12, 8 of 20 frames): improved against odometry"),
        ([0] * 12 + [1] * 3 + [2] * 3 + [3] * 2, False, "In 4 pieces (12, 3, 3, … of 20 frames): improved against"),
        ([0] * 19 + [1], False, "19 of 20 frames joined: improved against odometry"),
        ([0] * 20, False, "Improved against odometry"),
        ([0] * 20, True, "20 of 20 scans joined"),
        (list(range(20)), True, "No two of 20 scans joined: improved against odometry"),
    ],
)
def test_pieces_come_first_in_the_headline(
    report: Report, tmp_path: Path, component: list[int], unordered: bool, headline: str
) -> None:
    drawn = report.pictures.graph
    assert drawn is not None
    graph = graph_summary(Edges.measured(drawn), drawn.vertex_ids, np.array(component))
    source = replace(report.source, unordered=unordered, kind="scans" if unordered else "frames")
    shown = replace(report, graph=graph, source=source)
    verdict = judge(shown)
    assert verdict.headline.startswith(headline) and verdict.outcome == "improved"
    several = "pieces" in headline
    assert (verdict.pieces > 1) == several and verdict.mark == ("mixed" if several else "improved")
    page, numbers = write_report(tmp_path, shown)
    assert headline in read_page(page)[0]
    assert json.loads(numbers.read_text("utf-8"))["verdict"]["sentence"].startswith(headline)
    assert headline in " ".join(line.strip() for line in brief(shown, "runs/a")), "the terminal says the same"


def test_a_refinement_whose_error_against_the_truth_rose_is_mixed() -> None:
    refinement = RefinementSummary("refined", "Better than the poses given", "edge chi2 2 -> 1")
    verdict = judge(replace(told((0.5, 0.017), (0.6, 0.017)), refinement=refinement))
    assert verdict.outcome == "mixed"
    assert verdict.headline == "Better than the poses given, but ATE 50 cm → 60 cm, largest error 50 cm → 60 cm"


def test_the_worst_edge_is_the_wrong_one(report: Report) -> None:
    worst = report.worst_edges[0]
    assert (worst.i, worst.j, worst.source) == ("107", "108", "sequential")
    assert worst.residual_m == pytest.approx(0.5, abs=0.02)
    sizes = [edge.residual_m * 100 + edge.residual_deg for edge in report.worst_edges]
    assert sizes == sorted(sizes, reverse=True)


def test_what_to_distrust_is_said(report: Report) -> None:
    #  0–…–9   10–…–18   19
    component = np.array([0] * 10 + [1] * 9 + [2])
    assert report.pictures.graph is not None
    edges = Edges.measured(report.pictures.graph).put(slice(None), weight=np.array([0.0] * 2 + [1.0] * 18))
    summary = graph_summary(edges, report.pictures.graph.vertex_ids, component)
    said = "\n".join(map(str, suspicions(replace(report, graph=summary, scores=scored(0.01, 0.1, 0.01)))))
    for expected in (
        "2 pairs were tried twice",
        "falls into 3 parts",
        "1 of 20 frames have no edge",
        "ignored 2 of 20 edges",
        "At least 1 edges",
        "odometry: 2 of 3 near-centroid pairs have no point within 10 cm",
    ):
        assert expected in said


@pytest.mark.parametrize(
    ("shift_m", "spread", "said"), [(None, 1.0, False), (0.009, 1.0, False), (0.33, 1.0, True), (0.33, 100.0, False)]
)
def test_a_result_that_has_not_settled_is_not_to_be_trusted(shift_m: float | None, spread: float, said: bool) -> None:
    path = Path3D("result", np.array([[0.0, 0, 0], [4, 0, 0], [4, 4, 0]]) * spread)
    report = Report("r", SourceSummary("tum", "x", 3), last_shift_m=shift_m, pictures=Pictures(paths=(path,)))
    lines = [str(note) for note in suspicions(report)]
    assert ("not to be trusted" in "".join(lines)) == said
    if said:
        assert "33 cm" in lines[0]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (WrongEdges(0), []),
        (WrongEdges(11, "5 at frame 12", 0.0018), ["11 of the edges used are judged wrong, 5 at frame 12; without them "
          "no pose moves by more than 1.8 mm: nothing to do."]),
        (WrongEdges(2, "3–9", 0.12), ["2 of the edges used are judged wrong, 3–9; without them poses move by up to "
          "12 cm: hodge diagnose shows them."]),
        (WrongEdges(2, "3–9", 0.0, 1), ["2 of the edges used are judged wrong, 3–9; without them the scene falls into "
          "1 more pieces: hodge diagnose shows them."]),
    ],
)  # fmt: skip
def test_wrong_edges_are_weighed_by_what_they_do(report: Report, wrong: WrongEdges, said: list[str]) -> None:
    notes = [note for note in suspicions(replace(report, wrong_edges=wrong)) if note.kind in ("wrong", "harmless")]
    assert [str(note) for note in notes] == said
    assert all((note.rank == Rank.LOOK) == (note.kind == "wrong") for note in notes)


def test_what_wrong_edges_do_is_solved_for(tmp_path: Path) -> None:
    """A ring with one edge half a metre off that counts fully: without it the poses are exact again."""
    truth = circle()
    graph = ring(truth)
    solver = MaximumLikelihoodSolver()
    solution = solver.solve(graph, truth)
    edges = with_residuals(Edges.measured(graph), solution.world_from_cam, solution.weights)
    verdicts = np.full(20, "consistent", dtype="<U12")
    last = Round(edges.put(slice(None), verdict=verdicts), graph.vertex_ids, solution.world_from_cam, solution)
    step = Step(tmp_path, no_progress, lambda *notes: None)
    assert weigh_wrong(last, solver, step=step) == WrongEdges(0)
    verdicts[7] = "wrong"
    last = replace(last, edges=edges.put(slice(None), verdict=verdicts))
    found = weigh_wrong(last, solver, step=step)
    assert (found.count, found.frames, found.pieces_more) == (1, "107–108", 0)
    assert found.moved_m > 0.05, "as far as the edge had bent the ring"
    verdicts[12] = "wrong"
    found = weigh_wrong(replace(last, edges=edges.put(slice(None), verdict=verdicts)), solver, step=step)
    assert (found.count, found.pieces_more) == (2, 1)


def test_clouds_that_fit_better_than_at_the_truth_are_explained(report: Report) -> None:
    better = replace(report, scores=scored(0.010, 0.020, 0.009))
    assert [note.kind for note in suspicions(better)].count("above truth") == 1
    assert "above truth" not in [note.kind for note in suspicions(report)]


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
    assert "hodge view runs/a --web" in now.text and "hodge diagnose runs/a" in now.text
    assert "hodge edit" not in now.text, "nothing is known to be wrong"
    assert "hodge diagnose" not in document(report, "runs/a").first[1].text


def test_a_length_has_no_unit_where_none_is_known(report: Report) -> None:
    page = document(replace(report, has_metres=False), "runs/a")
    assert page.first[0].lines[0].endswith("it is 0.5 and 0.2° off the result.") or "0.50" in page.first[0].lines[0]


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


def test_tables_and_terminal_lines(report: Report) -> None:
    scores, trajectory = score_tables(report)
    assert scores.rows[1][:4] == ("odometry", "0.7486", "20.00 mm", "3")
    assert all(len(row) == len(table.header) for table in (scores, trajectory) for row in table.rows)
    assert all_notes(report)[0] == "note     2 pairs were tried twice"


def test_the_terminal_gets_ten_lines_of_80_columns(report: Report) -> None:
    notes = (Note("parts", 3), Note("carried", 7), Note("scale", detail="word " * 60))
    for shown in (report, replace(report, notes=notes)):
        lines = brief(shown, "runs/a")
        assert len(lines) <= 10 and max(map(len, lines)) <= 80
        assert lines[0] == "verdict  Improved against odometry" and lines[1].startswith("  - distance of clouds")
        assert "time     3.0 s, 4.0 CPU s, at most 300 MB" in lines
        assert lines[-2:] == ["report   runs/a/report.html", "next     hodge view runs/a --web"]
    assert "  - … and 4 more measures: --verbose" in lines
    assert any(line.startswith("look     The viewing graph falls into 3 parts") for line in lines), "doubt comes first"
    assert any(line.endswith(" …") for line in lines), "a long note is cut"


def test_numbers_in_words() -> None:
    assert [length(value) for value in (0.0012, 0.0305, 1.303, float("nan"))] == ["1.2 mm", "3.05 cm", "1.3 m", "–"]
    assert [percent(value) for value in (-0.406, 0.1)] == ["−41 %", "+10 %"]


def test_what_is_a_large_residual_and_how_many_pairs_may_see_nothing_goes_by_the_scene(report: Report) -> None:
    def said(scale: float, unmatched: int) -> str:
        distances_m = np.full((1, 200), 0.01 * scale)
        distances_m[0, :unmatched] = NO_NEIGHBOUR_M * scale
        pairs = np.stack([np.arange(200), np.arange(1, 201)], axis=1)
        scores = ScoreTable(("result",), "result", (GraphScores("iou", pairs, distances_m, scale),))
        far = replace(report.worst_edges[0], residual_m=0.15, residual_deg=0.0, weight=1.0)
        return "\n".join(map(str, suspicions(replace(report, scores=scores, worst_edges=(far,)))))

    assert "1 edges that the solver used are more than 10 cm" in said(1.0, 0)
    assert "that the solver used are more than" not in said(10.0, 0)
    assert "have no point within" not in said(1.0, 2)
    assert "result: 3 of 200" in said(1.0, 3)

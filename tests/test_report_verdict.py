"""The verdict of a report and what it tells to distrust, by hand."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hodge_pipeline.evaluation.difference import MEASURABLE, Change, sign_of
from hodge_pipeline.evaluation.residuals import with_residuals
from hodge_pipeline.refine.guard import Decision, Measure
from hodge_pipeline.refine.reprojection_cost import ReprojectionCost
from hodge_pipeline.report.brief import brief
from hodge_pipeline.report.contents import (
    Path3D,
    Pictures,
    RefinementSummary,
    Report,
    SourceSummary,
    WrongEdges,
)
from hodge_pipeline.report.refined import summary
from hodge_pipeline.report.summary import graph_summary, unheld, weigh_wrong
from hodge_pipeline.report.suspicions import suspicions
from hodge_pipeline.report.verdict import judge
from hodge_pipeline.report.write import write_report
from hodge_pipeline.scene import Round
from hodge_pipeline.solvers.maximum_likelihood import MaximumLikelihoodSolver
from hodge_pipeline.stages import Step, no_progress
from hodge_pipeline.types import Edges
from hodge_pipeline.types.notes import Note, Rank
from report_data import circle, make_report, read_page, ring, scored, told


@pytest.fixture(scope="module")
def report() -> Report:
    return make_report()


@pytest.mark.parametrize(
    ("before_m", "after_m", "outcome", "words"),
    [
        (0.020, 0.012, "improved", "fell from 20 mm to 12 mm (−40 %)"),
        (0.010, 0.015, "worse", "rose from 10 mm to 15 mm (+50 %)"),
        (0.010, 0.0101, "unchanged", "hardly changed, from 10.0 mm to 10.1 mm (+1 %)"),
    ],
)
def test_the_verdict_follows_the_scores(before_m: float, after_m: float, outcome: str, words: str) -> None:
    verdict = judge(Report("r", SourceSummary("tum", "x", 4), scores=scored(0.01, before_m, after_m)))
    assert verdict.outcome == outcome
    assert words in verdict.sentence


@pytest.mark.parametrize(("share", "says"), [(0.5, False), (0.75, True), (1.0, True)])
def test_where_nothing_confirms_most_edges_the_first_line_says_so(report: Report, share: float, says: bool) -> None:
    assert report.graph is not None
    graph = replace(report.graph, edges=4, verdicts={"untestable": int(4 * share)})
    verdict = judge(replace(report, graph=graph))
    assert verdict.headline.startswith(f"Nothing confirms {int(4 * share)} of 4 edges: ") == says
    assert verdict.mark == ("mixed" if says else "improved")


def test_errors_that_disagree_are_mixed(report: Report) -> None:
    verdict = judge(replace(report, scores=scored(0.01, 0.01, 0.02)))
    assert verdict.outcome == "mixed"
    best, bad = verdict.headline.split(", but ")
    assert best == "Mixed against odometry: RPE of the rotation 4.43° → 0.44° and 2 more better"
    assert bad.startswith("distance of clouds (near-centroid pairs) 10 mm → 20 mm, distance of clouds (overlapping")
    assert [change.sign for change in verdict.changes] == [1, 1, 1, -1, -1]


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
    assert verdict.headline == "Better than the poses given (ATE 50 cm → 40 cm), but largest error 50 cm → 70 cm"


def test_tracks_that_contradict_each_other_are_said_first() -> None:
    good = ReprojectionCost(0.9, 0.5, 4.0, 1000, 0, 0, 0.0, (), (), np.ones(1000, bool))
    assert not good.doubt
    decision = Decision("refined", "mean error 67 -> 24.1 px", doubt=replace(good, px=24.1, cap_px=60.0).doubt)
    verdict = judge(replace(told((0.5, 0.020), (0.4, 0.017)), refinement=summary(decision)))
    assert verdict.headline.startswith("In doubt, since tracks contradict each other by 24.1 px")
    assert verdict.headline.endswith(": better than the poses given") and verdict.is_doubtful


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
        ([0] * 12 + [1] * 5 + [2, 3, 4], False, "In 2 pieces (12, 5 of 20 frames; 3 alone): improved against"),
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
    guessed = judge(replace(shown, notes=(*shown.notes, Note("left apart"))))
    assert ("a guess joins" in guessed.headline) != several
    page, numbers = write_report(tmp_path, shown)
    assert headline in read_page(page)[0]
    assert json.loads(numbers.read_text("utf-8"))["verdict"]["sentence"].startswith(headline)
    assert headline in " ".join(line.strip() for line in brief(shown, "runs/a")), "the terminal says the same"


def test_a_path_in_doubt_says_so_first(report: Report) -> None:
    """Whatever fits better: clouds of an object that was followed fit each other."""
    verdict = judge(replace(report, notes=(Note("camera or object", 9, "20 frames, 1–9"),)))
    assert verdict.headline == "In doubt, since images contradict the camera's motion: improved against odometry"
    doubts = (*report.notes, Note("camera or object", 10, "1–9, 12"), Note("depth unit", detail="its steps"))
    headline = judge(replace(report, notes=doubts)).headline
    reasons = "depth is probably not in metres and images contradict the camera's motion"
    assert headline == f"In doubt, since {reasons}: improved against odometry"
    assert verdict.mark == "mixed"
    doubt = Note("reader's doubt", detail="a camera of focal length 525 is assumed")
    verdict = judge(replace(report, notes=(doubt,)))
    assert verdict.headline.startswith("In doubt, since the camera is assumed and images do not confirm it: improved")
    verdict = judge(
        replace(report, notes=(Note("focal length", detail="574 pixels (568 to 590) better than its 644"),))
    )
    assert verdict.headline.startswith("In doubt, since images contradict the camera's focal length: improved")
    doubts = (Note("scan unit", detail="points reach 120,000"), Note("left apart"))
    verdict = judge(replace(report, notes=doubts, wrong_edges=WrongEdges(2, "3–9", 0.12)))
    reasons = "its unit seems not to be the metre and a guess joins what tracking left apart"
    assert verdict.headline.startswith(f"In doubt, since {reasons} and edges that it uses are judged wrong: improved")
    assert judge(replace(report, wrong_edges=WrongEdges(2, "3–9", 0.0))).headline.startswith("Improved")


def test_lost_frames_and_missing_images_come_first_where_they_are_most(report: Report) -> None:
    """20 frames: what fits better is said of the few that are left."""
    headlines = [
        judge(replace(report, notes=(Note("tracking lost", lost, "0–9"), *report.notes))).headline for lost in (10, 11)
    ]
    assert headlines[0].startswith("Improved against")
    assert headlines[1] == "Tracking was lost at 11 of 20 frames: improved against odometry"
    unread = replace(report, notes=(Note("images unread", 11, "(0–10)"), *report.notes))
    assert judge(unread).headline.startswith("11 of 20 frames have images that cannot be read: improved")
    missing = replace(
        report, notes=(Note("tracking lost", 20, "0–19"), Note("images missing", 980, "997 listed images"))
    )
    assert judge(missing).headline.startswith("980 of 997 listed images are missing: tracking was lost at 20 of 20")
    assert judge(missing).mark == "mixed"


def test_a_doubt_of_the_input_comes_before_what_follows_from_it(report: Report) -> None:
    """Two notes have room in ten lines."""
    notes = (
        Note("unheld", 9, "10 steps"),
        Note("camera or object", 9, "20 frames"),
        Note("depth range", detail="0.161 m"),
    )
    (first, *_) = [line for line in brief(replace(report, notes=notes), "runs/a") if line.startswith("look")]
    assert first.removeprefix("look").strip().startswith("0.161 m: is the depth scale right")


@pytest.mark.parametrize(
    ("scale", "noise_m", "told"), [(5.0, 0.002, "5"), (0.2, 0.01, "0.2"), (1.05, 0.0, ""), (5.0, 1.0, "")]
)
def test_depth_in_another_unit_than_the_truth_comes_first(
    report: Report, scale: float, noise_m: float, told: str
) -> None:
    """Where the size explains the error: a path of noise has no scale."""
    true = circle()[:, :3, 3]
    found = true / scale + np.random.default_rng(0).normal(0, noise_m, true.shape)
    pictures = Pictures((Path3D("truth", true), Path3D("result", found)), np.zeros(20, np.int64))
    shown = replace(report, pictures=pictures)
    assert judge(shown).headline.startswith("In another scale than the truth: ") == bool(told)
    notes = [str(note) for note in suspicions(shown) if note.kind == "other scale"]
    assert [f"The true path is {told} times" in note for note in notes] == [True] * bool(told)


def test_a_camera_that_truly_stayed_on_the_spot_has_no_scale(report: Report) -> None:
    """As on a tripod that turns: the result is 4 mm off, the truth next to nothing."""
    found, rounding = np.random.default_rng(0).normal(0, 0.004, (2, 20, 3))
    paths = Path3D("truth", 1e-7 * (found / 3 + rounding)), Path3D("result", found)
    shown = replace(report, pictures=Pictures(paths, np.zeros(20, np.int64)))
    assert not [note for note in suspicions(shown) if note.kind == "other scale"]


@pytest.mark.parametrize(
    ("held", "verdict", "doubted"),
    [("wall", "untestable", True), ("wall", "consistent", False), ("corner", "untestable", False)],
)
def test_a_path_along_a_bare_wall_is_in_doubt(held: str, verdict: str, doubted: bool) -> None:
    """The wall holds the distance to it alone; other edges over a step would hold it all the same."""
    edges = Edges.measured(ring(circle())).put(slice(None), verdict=verdict)
    information = np.diag([1e4, 1e4, 1e4, 1.0, 1.0, 1e6] if held == "wall" else [1e4] * 6)
    edges = edges.put(slice(None), information=information)
    notes = unheld(edges, np.arange(20), 0.02)
    assert [note.kind for note in notes] == ["unheld"] * doubted
    verdict_of = judge(Report("r", SourceSummary("tum", "x", 20), notes=notes))
    assert verdict_of.headline.startswith("In doubt, since what frames share lets them slide: ") == doubted


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
        "1 of 20 frames (119) has no edge",
        "ignored 2 of 20 edges",
        "At least 1 edge ",
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


def test_scans_that_fit_in_several_ways_are_told_first(report: Report) -> None:
    drawn = report.pictures.graph
    assert drawn is not None
    graph = graph_summary(Edges.measured(drawn), drawn.vertex_ids, np.arange(20))
    source = replace(report.source, unordered=True, kind="scans")
    verdict = judge(replace(report, graph=graph, source=source, notes=(Note("ambiguous", 9, "190"),)))
    assert verdict.headline.startswith(
        "No two of 20 scans joined, and 9 of 190 pairs fit in several ways (take scans in"
    )
    verdict = judge(replace(report, graph=graph, source=source, notes=(Note("none joined", detail="do this"),)))
    assert verdict.headline.startswith("No two of 20 scans joined (do this)")


@pytest.mark.parametrize(
    ("before", "after", "told"),
    [
        (0.0691, 0.00968, "6.91 cm → 0.97 cm"),
        (0.0183, 0.00672, "18.3 mm → 6.7 mm"),
        (0.998, 0.7, "99.8 cm → 70.0 cm"),
        (0.05, 0.07, "5 cm → 7 cm"),
        (0.9, 0.0009, "90.0 cm → 0.09 cm"),
        (np.inf, 0.05, "– → 5 cm"),
    ],
)
def test_the_two_numbers_of_a_change_have_digits_alike(before: float, after: float, told: str) -> None:
    assert Change("", "ATE", before, after, 1e-7).briefly == f"ATE {told}"
    assert str(Measure("score", 0.9812, 1.0)) == "score 0.981 → 1.000"
    assert str(Measure("images off", 3, 0)) == "images off 3 → 0"

import math
from dataclasses import replace

from typer.testing import CliRunner

from hodge_pipeline.cli.main import app
from hodge_pipeline.refine.guard import Change, Measure, decide
from hodge_pipeline.refine.verdict import chi2_measure

BETTER = Measure("held-out distance", 0.010, 0.009)
WORSE = Measure("held-out score", 0.90, 0.88, better="higher")
MOVED = Change(0.01, 0.5, 0.001, 0.05)
STILL = Change(0.0005, 0.01, 0.001, 0.05)


def test_a_better_result_is_kept():
    decision = decide([BETTER], MOVED)
    assert decision.outcome == "refined" and not decision.keeps_input and decision.exit_code == 0


def test_one_worse_measure_gives_the_input_back_with_exit_code_3():
    decision = decide([BETTER, WORSE], MOVED)
    assert decision.outcome == "worse" and decision.keeps_input and decision.exit_code == 3
    assert "held-out score 0.9 -> 0.88" in decision.reason and "distance" not in decision.reason


def test_force_writes_a_worse_result():
    decision = decide([WORSE], MOVED, force=True)
    assert decision.outcome == "forced" and not decision.keeps_input and decision.exit_code == 0


def test_a_change_below_its_uncertainty_gives_the_input_back_without_complaint():
    decision = decide([BETTER], STILL)
    assert decision.outcome == "optimal" and decision.keeps_input and decision.exit_code == 0


def test_what_was_held_out_counts_before_a_large_uncertainty():
    held_out = replace(WORSE, before=0.72, after=0.83, tolerance=0.02, is_held_out=True)
    assert decide([held_out], STILL).outcome == "refined"
    assert decide([replace(held_out, after=0.73)], STILL).outcome == "optimal"
    assert decide([WORSE], STILL).outcome == "worse"


def test_a_measure_within_its_tolerance_is_not_worse_and_a_lost_one_is():
    assert not Measure("x", 1.0, 1.05, tolerance=0.1).is_worse
    assert Measure("x", 1.0, 1.2, tolerance=0.1).is_worse
    assert Measure("x", 1.0, math.nan).is_worse
    assert not Measure("x", math.nan, 1.0).is_worse


def test_chi2_may_grow_by_a_fiftieth():
    assert not chi2_measure(200.0, 203.9).is_worse
    assert chi2_measure(200.0, 204.1).is_worse


def test_an_uncertainty_that_is_unknown_never_calls_a_change_insignificant():
    assert Change(1e-9, 1e-9, math.nan, math.nan).is_significant


def test_the_help_sends_a_graph_file_to_solve():
    found = CliRunner().invoke(app, ["refine", "--help"])
    assert found.exit_code == 0 and "hodge solve" in found.output and "trajectory" in found.output


def test_a_change_is_told_in_millimetres_and_degrees():
    told = str(Change(0.0125, 0.25, 0.004, 0.5))
    assert told == "poses moved by 12.5 mm and 0.25° (RMS), known to 4 mm and 0.5°"

"""The measure of a probability, and right graphs in which nothing is blamed."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.reliability import classes, expected_calibration_error
from benchmarks.simulated_edges import simulated
from hodge_pipeline.diagnosis.diagnosis import diagnose


def test_the_calibration_error_of_a_little_table_by_hand() -> None:
    probability = np.array([0.9, 0.9, 0.9, 0.9, 0.25, 0.25, np.nan])
    right = np.array([True, True, True, False, False, False, True])
    assert classes(probability, right) == [(2, 0.25, 0.0), (4, pytest.approx(0.9), 0.75)]
    assert expected_calibration_error(probability, right) == pytest.approx((2 * 0.25 + 4 * 0.15) / 6)


@pytest.mark.parametrize("seed", [3, 9, 21, 25, 93, 103])
def test_no_right_edge_of_a_graph_without_a_planted_one_is_blamed(seed: int) -> None:
    """The last three hold an error of 14 to 27 standard deviations, which may be blamed."""
    _, graph, right = simulated(seed, wrong=0.0)
    assert not (~diagnose(graph).kept & right).any()


@pytest.mark.parametrize("seed", [0, 1, 6, 9])
def test_the_probability_is_one_on_graphs_that_no_constant_was_chosen_on(seed: int) -> None:
    _, graph, right = simulated(seed, wrong=0.3)
    assert expected_calibration_error(diagnose(graph).probability, right) < 0.05

"""Odometry whose turns err for long in one way, as a gyroscope drifts, by far more than is stated."""

import numpy as np
import pytest

from benchmarks.biased_worlds import drifting_cases
from benchmarks.wrong_loops import odometry, position_error, right_alone
from hodge_pipeline.diagnosis.diagnosis import diagnose


@pytest.mark.parametrize(
    "name",
    [
        # by stated errors most loops were refused, a shared mistake, and a right step was called wrong
        "walk, 1.0 rad by a bias over 200 steps, 0% wrong",
        "walk, 0.5 rad by a bias over 50 steps, 80% wrong",
        # nothing was confirmed
        "walk, 2.0 rad by a bias over 200 steps, 0% wrong",
        "flight, 2.0 rad by a bias over 8 steps, 50% wrong",
    ],
)
def test_a_drift_of_turns_is_no_break_and_no_mistake(name: str) -> None:
    case = next(case for case in drifting_cases(1) if case.name == name)
    found, bare = diagnose(case.graph), odometry(case.graph)
    np.testing.assert_array_equal(found.kept, case.right)
    error = position_error(found.world_from_cam[:, :3, 3], case.places)
    assert error < 1.2 * right_alone(case)
    assert error < 0.25 * position_error(bare[:, :3, 3], case.places)

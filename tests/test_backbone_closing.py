"""Rings that close at one place, among wrong loops: what one right loop says alone, chance says too."""

import numpy as np
import pytest

from benchmarks.closing_worlds import closing_cases
from benchmarks.wrong_loops import odometry, position_error, right_alone
from hodge_pipeline.diagnosis.diagnosis import diagnose


@pytest.mark.parametrize(
    "name",
    [
        "ring of 200, 26 right, 500 wrong groups, turns stated × 8.0",
        "ring of 400, 26 right, 500 wrong still, turns stated × 8.0",
        # a bias that wrong loops over few steps told turned the path three times more
        "ring of 400, 26 right, 500 wrong local groups, turns stated × 8.0",
    ],
)
def test_a_ring_closes_where_its_loops_agree(name: str) -> None:
    case = next(case for case in closing_cases(1) if case.name == name)
    found = diagnose(case.graph)
    np.testing.assert_array_equal(found.kept, case.right)
    error = position_error(found.world_from_cam[:, :3, 3], case.places)
    assert error < 1.2 * right_alone(case)
    assert error < 0.5 * position_error(odometry(case.graph)[:, :3, 3], case.places)

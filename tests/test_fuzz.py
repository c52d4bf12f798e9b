"""Two hundred damaged inputs for each reader; `make fuzz` runs two thousand."""

from __future__ import annotations

from pathlib import Path

import pytest

from fuzz_readers import TARGETS, fuzz

CASES = 200


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_is_read_soundly_or_refused(name: str, tmp_path: Path) -> None:
    outcomes = fuzz(name, CASES, tmp_path)
    assert sum(outcomes.values()) == CASES and (TARGETS[name].refused or outcomes["read"] < CASES)

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.association import nearest_pairs


@given(
    depth=st.lists(st.integers(0, 400), unique=True, max_size=40).map(sorted),
    colour=st.lists(st.integers(0, 400), unique=True, max_size=40).map(sorted),
)
@settings(deadline=None)
def test_pairs_are_near_unique_and_none_is_missed(depth: list[int], colour: list[int]) -> None:
    depth_s, colour_s = np.array(depth) / 100, np.array(colour) / 100
    pairs = nearest_pairs(depth_s, colour_s, 0.0201)
    found = [(row, column) for row, column in enumerate(pairs.tolist()) if column >= 0]
    assert len({column for _, column in found}) == len(found)
    assert all(abs(depth[row] - colour[column]) <= 2 for row, column in found)
    # A pair left over on both sides would be one that the greedy choice should have made.
    free_depth = {row for row, column in enumerate(pairs) if column < 0}
    free_colour = set(range(len(colour))) - {column for _, column in found}
    assert not any(abs(depth[row] - colour[column]) <= 2 for row in free_depth for column in free_colour)


def test_the_nearer_depth_gets_the_colour_image() -> None:
    assert nearest_pairs(np.array([1.0, 1.01]), np.array([1.012]), 0.02).tolist() == [-1, 0]

"""The budget: what it keeps, that it is deterministic, and that it makes stiffer graphs than overlap alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_pipeline.pairs.combined import spread, thinning_order
from hodge_pipeline.types import Edges


def candidates(pairs: np.ndarray, overlap: np.ndarray) -> Edges:
    return replace(Edges.of(pairs, "overlap"), overlap=overlap)


def loop_candidates(count: int = 120) -> Edges:
    """Two laps of a circle: a frame overlaps with those near it in the circle, in both laps."""
    i, j = np.triu_indices(count, 1)
    turn = 4 * np.pi / count * (j - i)
    overlap = 1 - np.abs((turn + np.pi) % (2 * np.pi) - np.pi) / 0.8
    keep = overlap > 0.2
    return candidates(np.stack([i, j], axis=1)[keep], overlap[keep])


def mean_resistance(pairs: np.ndarray, count: int) -> float:
    """The mean effective resistance between two vertices: proportional to the mean variance of a relative pose."""
    laplacian = np.zeros((count, count))
    np.add.at(laplacian, (pairs[:, 0], pairs[:, 1]), -1.0)
    laplacian += laplacian.T
    np.fill_diagonal(laplacian, -laplacian.sum(axis=1))
    return float(2 * (1 / np.linalg.eigvalsh(laplacian)[1:]).sum() / (count - 1))


def is_step(pairs: np.ndarray) -> np.ndarray:
    return np.asarray(pairs[:, 1] - pairs[:, 0] == 1)


def test_a_budget_that_suffices_changes_nothing() -> None:
    given_pairs = loop_candidates()
    assert spread(given_pairs, 120, 1e6, is_step(given_pairs.pairs)) is given_pairs


def test_what_is_always_kept_may_exceed_the_budget() -> None:
    given_pairs = loop_candidates()
    kept = spread(given_pairs, 120, 0.1, is_step(given_pairs.pairs))
    assert len(kept.pairs) == 119 and is_step(kept.pairs).all()


@given(seed=st.integers(0, 999), per_frame=st.floats(0.5, 6))
@settings(max_examples=30, deadline=None)
def test_kept_pairs_are_a_sorted_subset_of_the_right_size(seed: int, per_frame: float) -> None:
    rng = np.random.default_rng(seed)
    pairs = np.unique(np.sort(rng.integers(0, 40, (300, 2)), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    overlap = np.where(rng.random(len(pairs)) < 0.3, np.nan, rng.random(len(pairs)))
    always = rng.random(len(pairs)) < 0.1
    kept = spread(candidates(pairs, overlap), 40, per_frame, always)
    rows = {tuple(pair): row for row, pair in enumerate(pairs)}
    chosen = [rows[tuple(pair)] for pair in kept.pairs]
    assert chosen == sorted(set(chosen))
    assert len(chosen) == min(len(pairs), max(int(per_frame * 40), always.sum()))
    assert set(np.flatnonzero(always)) <= set(chosen)
    np.testing.assert_array_equal(kept.overlap, overlap[chosen])


def test_neighbouring_duplicates_wait_for_the_second_round() -> None:
    # a block of pairs around (10, 200), and one lone pair of little overlap: two places for all of them
    block = np.array([(i, j) for i in range(8, 12) for j in range(200, 204)])
    pairs = np.concatenate([block, [[70, 90]]])
    overlap = np.concatenate([np.linspace(0.8, 0.9, 16), [0.31]])
    kept = spread(candidates(pairs, overlap), 250, 2 / 250, np.zeros(17, bool))
    assert [tuple(pair) for pair in kept.pairs] == [(11, 203), (70, 90)]


def test_thinning_order_starts_with_the_best_and_is_a_permutation() -> None:
    given_pairs = loop_candidates()
    order = thinning_order(given_pairs.pairs, given_pairs.overlap)
    assert sorted(order) == list(range(len(given_pairs.pairs)))
    assert given_pairs.overlap[order[0]] == given_pairs.overlap.max()


@pytest.mark.parametrize(("per_frame", "share"), [(2, 0.5), (3, 0.7), (6, 0.8)])
def test_the_spread_is_stiffer_than_the_best_overlaps(per_frame: int, share: float) -> None:
    everything = loop_candidates()
    always = is_step(everything.pairs)
    kept = spread(everything, 120, per_frame, always)
    optional = np.flatnonzero(~always)
    best = optional[np.argsort(-everything.overlap[optional], kind="stable")[: len(kept.pairs) - always.sum()]]
    by_overlap = everything.pairs[np.concatenate([np.flatnonzero(always), best])]
    assert len(by_overlap) == len(kept.pairs) == 120 * per_frame
    assert mean_resistance(kept.pairs, 120) < share * mean_resistance(by_overlap, 120)
    degrees = np.bincount(kept.pairs.ravel(), minlength=120)
    assert degrees.min() >= per_frame

"""How frames follow key frames: those that were not found lie where their neighbours do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hodge_pipeline.scene import KeyFrames


def followed(found: list[bool]) -> KeyFrames:
    """Six frames a metre apart, each second of which is a key frame; those that are not found hang on a wrong pose."""
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = np.where(found, np.arange(6), 99.0)
    key, rows = np.array([0, 0, 1, 1, 2, 2]), np.array([0, 2, 4])
    part, zeros, times = np.array([0, 0, 1, 1, 2, 2]), np.zeros(6, np.int64), np.arange(6.0)
    return KeyFrames(rows, poses, poses[rows], part, times, np.array(found), times, zeros, key)


@pytest.mark.parametrize(
    ("found", "x", "of"),
    [
        ([True] * 6, [0, 1, 2, 3, 4, 5], [7, 7, 8, 8, 9, 9]),
        ([False, False, True, True, True, True], [0, 1, 2, 3, 4, 5], [8, 8, 8, 8, 9, 9]),
        ([False] * 5 + [True], [5, 5, 5, 5, 5, 5], [9, 9, 9, 9, 9, 9]),
        ([False, True, False, True, True, True], [1, 1, 2, 3, 4, 5], [7, 7, 7, 8, 9, 9]),
        ([True, True, False, False, True, True], [0, 1, 2, 3, 4, 5], [7, 7, 7, 7, 9, 9]),
        ([True, True, True, True, False, False], [0, 1, 2, 3, 4, 5], [7, 7, 8, 8, 8, 8]),
    ],
)
def test_frames_that_were_not_found_follow_their_neighbours(found: list[bool], x: list[float], of: list[int]) -> None:
    frames = followed(found)
    np.testing.assert_allclose(frames.expand(frames.world_from_key)[:, 0, 3], x)
    assert frames.of_frames(np.array([7, 8, 9])).tolist() == of


def test_frames_none_of_which_was_found_stay_with_their_key_frames() -> None:
    frames = replace(followed([True] * 6), found=np.zeros(6, bool))
    assert frames.of_frames(np.array([7, 8, 9])).tolist() == [7, 7, 8, 8, 9, 9]


def test_frames_lost_at_an_end_are_carried_on_ten_steps_at_most() -> None:
    poses, found = np.tile(np.eye(4), (30, 1, 1)), np.arange(30) < 10
    poses[:, 0, 3] = np.where(found, 2 * np.arange(30), 99.0)
    zeros, times = np.zeros(30, np.int64), np.arange(30.0)
    frames = KeyFrames(np.array([0, 9]), poses, poses[[0, 9]], zeros, times, found, times, zeros, zeros)
    expected = 2 * np.minimum(np.arange(30), 19)
    np.testing.assert_allclose(frames.expand(frames.world_from_key)[:, 0, 3], expected, atol=1e-9)

    poses[:8, 1, 3] = 50.0  # another part, whose place is a guess
    parts = replace(frames, first=poses, world_from_key=poses[[0, 9]], part=(np.arange(30) >= 8).astype(np.int64))
    after = parts.expand(parts.world_from_key)[8:]
    np.testing.assert_allclose(after[:, :2, 3], np.stack([expected[8:], 0 * expected[8:]], axis=1), atol=1e-9)

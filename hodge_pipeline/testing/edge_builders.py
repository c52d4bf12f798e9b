"""The contract of edge builders, one named property after the other."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hodge_pipeline.stages import EdgeBuilder
from hodge_pipeline.testing.stage import Contract, room, without_points
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame
from hodge_pipeline.types.edges import CANDIDATE

EMPTY_ROWS = (3, 7)


def _proposed(builder: EdgeBuilder, frames: Sequence[Frame], clouds: CloudSet, poses: Floats) -> Edges:
    """What it proposes, after asserting that it is a table of candidates and that nothing given was changed."""
    before = pickle.dumps((poses, clouds.points, clouds.offsets))
    edges = builder.propose(frames, clouds, poses)
    assert pickle.dumps((poses, clouds.points, clouds.offsets)) == before, "it changes the poses or clouds it is given"
    assert isinstance(edges, Edges), f"propose gives a {type(edges).__name__}: make it by Edges.proposed(pairs, why)"
    pairs = edges.pairs
    assert pairs.dtype == np.int64 and pairs.shape == (len(edges), 2), f"pairs are {pairs.dtype} {pairs.shape}"
    assert not len(pairs) or (pairs.min() >= 0 and pairs.max() < len(frames)), "a pair has no frame: give rows"
    assert (pairs[:, 0] < pairs[:, 1]).all(), "a pair is not i < j: make the table by Edges.proposed"
    assert len(np.unique(pairs, axis=0)) == len(pairs), "a pair is proposed twice"
    assert (np.lexsort((pairs[:, 1], pairs[:, 0])) == np.arange(len(pairs))).all(), "pairs are not sorted"
    assert (edges.status == CANDIDATE).all() and np.isnan(edges.i_from_j).all(), "a proposed pair is only a candidate"
    assert (edges.proposed_by != "").all(), "a pair without a reason in `proposed_by`"
    assert (np.isnan(edges.overlap) | ((edges.overlap >= 0) & (edges.overlap <= 1))).all(), "overlap is not in [0, 1]"
    return edges


def _proposes_pairs(builder: EdgeBuilder) -> None:
    scene = room()
    edges = _proposed(builder, scene.frames, scene.clouds, scene.world_from_cam)
    assert len(edges), "it proposes no pair of a room of which all frames see the same wall"


def _repeats_itself(builder: EdgeBuilder) -> None:
    scene = room()
    copies = tuple(replace(frame) for frame in scene.frames)  # no memory of the very same frames may help
    one, two = (_proposed(builder, frames, scene.clouds, scene.world_from_cam) for frames in (scene.frames, copies))
    assert pickle.dumps(one) == pickle.dumps(two), "the same frames give other pairs when asked again"


def _passes_over_empty_frames(builder: EdgeBuilder) -> None:
    scene = room()
    clouds = without_points(scene.clouds, EMPTY_ROWS)
    edges = _proposed(builder, scene.frames, clouds, scene.world_from_cam)
    assert not np.isin(edges.pairs, EMPTY_ROWS).any(), "a frame without points is in a pair"


def _knows_frames_by_their_rows(builder: EdgeBuilder) -> None:
    scene = room()
    named = tuple(replace(frame, frame_id=f"image {900 - row}") for row, frame in enumerate(scene.frames))
    one, two = (_proposed(builder, frames, scene.clouds, scene.world_from_cam) for frames in (scene.frames, named))
    assert np.array_equal(one.pairs, two.pairs), "frames that are named otherwise give other pairs"


def _needs_no_truth(builder: EdgeBuilder) -> None:
    scene = room()
    blind = tuple(replace(frame, world_from_cam=None) for frame in scene.frames)
    one, two = (_proposed(builder, frames, scene.clouds, scene.world_from_cam) for frames in (scene.frames, blind))
    assert np.array_equal(one.pairs, two.pairs), "it looks at the frames' own poses, which are there to compare with"


def _proposes_nothing_of_one_frame(builder: EdgeBuilder) -> None:
    scene = room()
    for count in (0, 1):
        clouds = CloudSet.from_clouds(list(scene.clouds)[:count])
        edges = _proposed(builder, scene.frames[:count], clouds, scene.world_from_cam[:count])
        assert not len(edges), f"{count} frames give {len(edges)} pairs"


check_edge_builder = Contract(
    EdgeBuilder,
    {
        "candidates": _proposes_pairs,
        "the same pairs again": _repeats_itself,
        "frames without points": _passes_over_empty_frames,
        "rows, not names": _knows_frames_by_their_rows,
        "no look at the truth": _needs_no_truth,
        "one frame": _proposes_nothing_of_one_frame,
    },
)
"""Checks an edge builder on a small room."""

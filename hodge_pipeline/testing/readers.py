"""The contract of readers, and of what they give."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import FrameReader, Sniff
from hodge_pipeline.testing.stage import check_stage
from hodge_pipeline.types import Camera, EncodedImage, Frame, PointCloud, Positions, Source, Trajectory, ViewGraph
from hodge_pipeline.types.arrays import evenly

MAX_PICKLED_FRAME_BYTES = 1 << 14
"""A lazy frame is paths and numbers; anything larger holds an image."""


def check_reader(reader: FrameReader, path: Path, max_decoded: int = 3) -> Source:
    """What the reader opens at a path of its format, after checking it against the contract of `FrameReader`.

    The path must hold good data. Frames are checked in full, their images for `max_decoded` evenly spaced ones.
    Raises `AssertionError` that says what does not hold.
    """
    check_stage(reader)
    _check_sniff(reader, path)
    source, again = reader.open(path), reader.open(path)
    assert isinstance(source, Source), f"open gives a {type(source).__name__}, not a Source"
    parts = source.trajectory, source.graph, source.positions
    has_content = len(source.frames) or any(part is not None for part in parts)
    assert has_content, "neither frames, nor a trajectory, nor a graph, nor positions: raise SourceError instead"
    assert source.files, "no files: a run could not see that its input changed"
    absent = [file for file in source.files if not file.is_file()]
    assert not absent, f"files that are not there: {absent[:3]}"
    assert (source.name, source.notes, source.files) == (again.name, again.notes, again.files), "opened twice, differs"
    check_frames(source.frames, again.frames, max_decoded)
    if source.trajectory is not None:
        check_trajectory(source.trajectory)
    if source.graph is not None:
        check_view_graph(source.graph)
    if source.positions is not None:
        check_positions(source.positions)
    return source


def check_frames(frames: Sequence[Frame], again: Sequence[Frame], max_decoded: int = 3) -> None:
    """Assert that frames are lazy, re-readable, picklable, finite, and the same when opened again."""
    assert len(frames) == len(again), f"opened twice: {len(frames)} and {len(again)} frames"
    assert len({frame.frame_id for frame in frames}) == len(frames), "frame ids are not unique"
    for frame, other in zip(frames, again, strict=True):
        _check_frame(frame)
        assert (frame.frame_id, frame.stamp_s, frame.camera) == (other.frame_id, other.stamp_s, other.camera), (
            f"frame {frame.frame_id}: opened twice, differs"
        )
        _assert_same(frame.world_from_cam, other.world_from_cam, f"frame {frame.frame_id}: world_from_cam opened twice")
    for sequence in {frame.sequence for frame in frames}:
        stamps = [frame.stamp_s for frame in frames if frame.sequence == sequence]
        assert (np.diff(stamps) > 0).all(), f"sequence {sequence!r}: stamps do not ascend"
    for row in evenly(len(frames), max_decoded):
        _check_images(frames[int(row)])


def check_trajectory(trajectory: Trajectory) -> None:
    """Assert finite poses on finite stamps that ascend."""
    stamps, poses = trajectory.stamps_s, trajectory.world_from_cam
    assert stamps.dtype == np.float64 and poses.dtype == np.float64, "a trajectory is float64"
    assert poses.shape == (len(stamps), 4, 4), f"{len(stamps)} stamps but poses {poses.shape}"
    assert np.isfinite(stamps).all() and (np.diff(stamps) > 0).all(), "stamps are not finite, or do not ascend"
    assert se3.is_motion(poses, 1e-6).all(), "a pose of the trajectory is not a rigid motion"


def check_positions(positions: Positions) -> None:
    """Assert columns of one length, finite points, positive covariances, and a name or a stamp for each."""
    count = len(positions)
    columns = (positions.points, positions.covariances, positions.names, positions.stamps_s)
    assert all(len(column) == count for column in columns), f"columns of {[len(c) for c in columns]}"
    assert np.isfinite(positions.points).all(), "a position is not finite"
    assert ((positions.names != "") | np.isfinite(positions.stamps_s)).all(), "a position without name and stamp"
    known = positions.covariances[np.isfinite(positions.covariances).all(axis=(1, 2))]
    assert (np.linalg.eigvalsh(known) > 0).all(), "a covariance is not positive"


def check_view_graph(graph: ViewGraph) -> None:
    """Assert columns of one length, edges between vertices that exist, finite motions, symmetric information."""
    count = graph.edge_count
    columns = (graph.i_from_j, graph.information, graph.fitness, graph.rmse_m, graph.source, graph.correspondences)
    assert all(len(column) == count for column in columns), f"columns of {[len(c) for c in columns]} for {count} edges"
    assert len(np.unique(graph.vertex_ids)) == graph.vertex_count, "vertex ids are not unique"
    assert graph.edges.shape == (count, 2) and graph.edges.dtype == np.int64, "edges are int64 (E, 2)"
    assert not count or (graph.edges.min() >= 0 and graph.edges.max() < graph.vertex_count), "an edge has no vertex"
    assert se3.is_motion(graph.i_from_j, 1e-6).all(), "an edge is not a rigid motion"
    scale = np.abs(graph.information).max(axis=(1, 2), initial=0.0, keepdims=True)
    skew = np.abs(graph.information - np.swapaxes(graph.information, 1, 2))
    assert np.isfinite(graph.information).all() and (skew <= 1e-9 * scale).all(), "information is not symmetric"


def _check_sniff(reader: FrameReader, path: Path) -> None:
    nowhere = path / "a folder that is not there"
    for place in (path, nowhere):
        sniff = reader.sniff(place)
        assert isinstance(sniff, Sniff) and 0 <= sniff.confidence <= 1 and sniff.reason, f"sniff gives {sniff}"
    assert reader.sniff(path).confidence > reader.sniff(nowhere).confidence, "no surer of its format than of nothing"
    try:
        reader.open(nowhere)
    except SourceError as error:
        assert str(nowhere) in str(error), f"the error does not name the path: {error}"
        return
    raise AssertionError("a path that is not there must raise SourceError")


def _check_frame(frame: Frame) -> None:
    name = f"frame {frame.frame_id}"
    assert isinstance(frame.frame_id, (int, str)), f"{name}: the id is a {type(frame.frame_id).__name__}"
    assert isinstance(frame.stamp_s, float) and np.isfinite(frame.stamp_s), f"{name}: stamp {frame.stamp_s!r}"
    assert frame.read_depth is None or frame.camera is not None, f"{name}: depth without a camera"
    size = len(pickle.dumps(frame))
    assert size < MAX_PICKLED_FRAME_BYTES, f"{name}: pickles to {size} bytes: it holds what should be read lazily"
    pose = frame.world_from_cam
    if pose is not None:
        assert pose.shape == (4, 4) and pose.dtype == np.float64, f"{name}: the pose is {pose.dtype} {pose.shape}"
        assert se3.is_motion(pose, 1e-6), f"{name}: the pose is not a rigid motion"


def _check_images(frame: Frame) -> None:
    name = f"frame {frame.frame_id}"
    if frame.read_depth is not None and frame.camera is not None:
        depth = _read_twice(frame.read_depth, f"{name}: depth")
        _assert_image(depth, frame.camera, np.float32, f"{name}: depth", ())
        assert np.isfinite(depth).all() and (depth >= 0).all(), f"{name}: depth is finite metres, 0 for none"
    if frame.read_colour is not None:
        colour = _read_twice(frame.read_colour, f"{name}: colour")
        if frame.camera is not None:
            _assert_image(colour, frame.camera, np.uint8, f"{name}: colour", (3,))
    if frame.read_points is not None:
        cloud = _read_twice(frame.read_points, f"{name}: points")
        points = cloud.points_in_cam
        assert points.dtype == np.float32 and points.shape == (len(cloud), 3), f"{name}: points are float32 (N, 3)"
        assert np.isfinite(points).all(), f"{name}: a point is not finite"
    for encoded in filter(None, (frame.encoded_depth, frame.encoded_colour)):
        image = _read_twice(encoded, f"{name}: encoded image")
        assert isinstance(image, EncodedImage) and image.contents, f"{name}: an encoded image is empty"


def _assert_image(image: Any, camera: Camera, dtype: type, what: str, channels: tuple[int, ...]) -> None:
    expected = (camera.height, camera.width, *channels)
    assert image.dtype == dtype and image.shape == expected, f"{what} is {image.dtype} {image.shape}, not {expected}"


def _read_twice(read: Callable[[], Any], what: str) -> Any:
    """What it reads, after asserting that a pickled copy reads the same."""
    first, second = read(), pickle.loads(pickle.dumps(read))()
    assert first is not second or isinstance(first, EncodedImage), f"{what}: kept in memory, not read again"
    if isinstance(first, PointCloud):
        _assert_same(first.points_in_cam, second.points_in_cam, f"{what} read twice")
    elif isinstance(first, EncodedImage):
        assert first == second, f"{what} read twice differs"
    else:
        _assert_same(first, second, f"{what} read twice")
    return first


def _assert_same(first: Any, second: Any, what: str) -> None:
    same = first is second if first is None or second is None else np.array_equal(first, second, equal_nan=True)
    assert same, f"{what}: differs"

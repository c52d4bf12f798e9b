"""The contract of writers and of rewriters, one named property after the other."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import HodgeError, SourceError
from hodge_pipeline.scene import own_trajectory
from hodge_pipeline.stages import FrameReader, PoseRewriter, Writer
from hodge_pipeline.testing.stage import Contract, raises, room
from hodge_pipeline.types import Floats, Source, Trajectory, ViewGraph

READ_BACK = 1e-5
"""What numbers may lose in a file of single precision or six digits."""


@dataclass(frozen=True)
class _Case:
    writer: Writer
    name: str
    reader: FrameReader | None = None


def whole_source() -> Source:
    """A source with everything: frames with depth, points and poses, a trajectory, a graph over the frames."""
    scene = room()
    frames = tuple(
        replace(frame, read_points=partial(scene.clouds.__getitem__, row)) for row, frame in enumerate(scene.frames)
    )
    poses = scene.world_from_cam
    rows = np.arange(len(poses) - 1)
    edges = np.stack([rows, rows + 1], axis=1)
    graph = ViewGraph.from_edges(np.arange(len(poses)), edges, se3.inverse(poses[:-1]) @ poses[1:])
    stamps = np.arange(len(poses), dtype=float)
    return Source("room", Path("room"), frames, Trajectory(stamps, poses), graph)


@cache
def _sources() -> dict[str, Source]:
    whole = whole_source()
    return {
        "everything": whole,
        "a trajectory": replace(whole, frames=(), graph=None),
        "a graph": replace(whole, frames=(), trajectory=None),
        "frames": replace(whole, trajectory=None, graph=None),
    }


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def _contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _writes_or_refuses(case: _Case) -> None:
    done = []
    for what, source in _sources().items():
        with _folder() as folder:
            refused = raises(SourceError, partial(case.writer.write, folder / case.name, source))
            left = _contents(folder)
            if refused is None:
                assert (folder / case.name).exists(), f"{what}: nothing is at the path, and no SourceError says why"
                done.append(what)
            else:
                assert "room" in refused, f"{what}: the error does not name the source: {refused}"
                assert not left, f"{what}: refused, but {sorted(left)} are left behind"
    assert done, "it writes none of a trajectory, a graph and frames"


def _writes_the_same_again(case: _Case) -> None:
    with _folder() as one, _folder() as two:
        for folder in (one, two):
            case.writer.write(folder / case.name, _sources()["everything"])
        assert _contents(one) == _contents(two), "the same source gives other bytes when written again"


def _replaces_what_is_there(case: _Case) -> None:
    with _folder() as folder, _folder() as fresh:
        source = _sources()["everything"]
        shorter = replace(source, frames=source.frames[:3], trajectory=_first(source, 3), graph=None)
        for given in (shorter, source):
            with suppress(SourceError):
                case.writer.write(folder / case.name, given)
        case.writer.write(fresh / case.name, source)
        assert _contents(folder) == _contents(fresh), "written over a smaller one it leaves something else than afresh"


def _first(source: Source, count: int) -> Trajectory:
    assert source.trajectory is not None
    return Trajectory(source.trajectory.stamps_s[:count], source.trajectory.world_from_cam[:count])


def _tells_where_it_cannot_write(case: _Case) -> None:
    with _folder() as folder:
        (folder / "file").write_text("in the way")
        path = folder / "file" / case.name
        message = raises(HodgeError, partial(case.writer.write, path, _sources()["everything"]))
        assert message is not None, "a path below a file must raise one of hodge_pipeline.errors"
        assert str(folder / "file") in message, f"the error does not name the path: {message}"


def _is_read_back(case: _Case) -> None:
    if case.reader is None:
        return
    with _folder() as folder:
        source = _sources()["everything"]
        case.writer.write(folder / case.name, source)
        _assert_same(case.reader.open(folder / case.name), source)


def _assert_same(read: Source, written: Source) -> None:
    """Of what a format holds, that it is what was written."""
    assert written.trajectory is not None and written.graph is not None
    poses = written.trajectory.world_from_cam
    own = [frame.world_from_cam for frame in read.frames if frame.world_from_cam is not None]
    if read.graph is not None and read.graph.edge_count:
        _assert_near(read.graph.i_from_j, written.graph.i_from_j, "edges")
    elif read.trajectory is not None and len(read.trajectory):
        _assert_near(read.trajectory.world_from_cam, poses, "poses of the trajectory")
    elif own:
        _assert_near(np.array(own), poses, "poses of the frames")
    else:
        points = sum(len(frame.read_points()) for frame in read.frames if frame.read_points)
        total = sum(len(frame.read_points()) for frame in written.frames if frame.read_points)
        assert points == total, f"{total} points written, {points} read back"


def _assert_near(read: Floats, written: Floats, what: str) -> None:
    assert len(read) == len(written), f"{len(written)} {what} written, {len(read)} read back"
    off = np.abs(read - written).max()
    assert off <= READ_BACK, f"{what} are off by {off:.2g} when read back"


check_writer = Contract(
    Writer,
    {
        "written or refused": _writes_or_refuses,
        "the same bytes again": _writes_the_same_again,
        "replaced": _replaces_what_is_there,
        "no place to write": _tells_where_it_cannot_write,
        "read back": _is_read_back,
    },
    _Case,
)
"""Checks a writer on a small source: `check_writer(writer, name, reader)`, the name being what a file or folder of its
format may be called; what is written is read back by `reader`, where one is given."""


@dataclass(frozen=True)
class _Rewriting:
    rewriter: PoseRewriter
    original: Path
    reader: FrameReader


def _poses_of(source: Source) -> Trajectory:
    found = own_trajectory(source)
    assert found is not None, "the original has no poses"
    return found


def _writes_the_new_poses(case: _Rewriting) -> None:
    before = _poses_of(case.reader.open(case.original))
    moved = Trajectory(before.stamps_s, before.world_from_cam @ se3.exp(np.array([0.1, 0.2, -0.1, 1.0, 2.0, 3.0])))
    with _folder() as folder:
        path = case.rewriter.rewrite(folder, case.original, moved)
        assert path.exists() and path.parent == folder, f"the path that it gives, {path.name}, is not in the folder"
        assert path.name.partition(".")[0] == "refined", f"the file is called {path.name}, not refined.<suffix>"
        after = _poses_of(case.reader.open(path))
    _assert_near(after.world_from_cam, moved.world_from_cam, "poses")
    assert np.array_equal(after.stamps_s, before.stamps_s), "stamps are others when read back"


def _copies_every_byte(case: _Rewriting) -> None:
    with _folder() as folder:
        path = case.rewriter.copy(folder, case.original)
        copied, original = (_bytes(place) for place in (path, case.original))
        assert copied and all(contents in original for contents in copied), "the copy is not the original's bytes"


def _leaves_the_original(case: _Rewriting) -> None:
    before = _bytes(case.original)
    with _folder() as folder:
        case.rewriter.rewrite(folder, case.original, _poses_of(case.reader.open(case.original)))
    assert _bytes(case.original) == before, "it changes the original"


def _bytes(path: Path) -> list[bytes]:
    return list(_contents(path).values()) if path.is_dir() else [path.read_bytes()]


check_rewriter = Contract(
    PoseRewriter,
    {
        "new poses": _writes_the_new_poses,
        "copy": _copies_every_byte,
        "original": _leaves_the_original,
    },
    _Rewriting,
)
"""Checks a rewriter on a file of poses: `check_rewriter(rewriter, path, reader)`."""

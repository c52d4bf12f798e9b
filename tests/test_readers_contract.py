"""The contract check itself: each reader here breaks one promise, and the check must say which."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline.stages import Sniff
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Camera, Source, Trajectory
from readers_data import seven_scenes_sequence

CALLS = count()


def ones(camera: Camera, dtype: str = "float32") -> np.ndarray:
    return np.ones((camera.height, camera.width), dtype)


def never_the_same(camera: Camera) -> np.ndarray:
    return ones(camera) * next(CALLS)


def not_finite(camera: Camera) -> np.ndarray:
    return ones(camera) * np.nan


@dataclass(frozen=True)
class Broken:
    """A reader of 7-Scenes whose result is spoiled in one way."""

    how: str = ""

    def sniff(self, path: Path) -> Sniff:
        return Sniff(2.0, "very sure") if self.how == "sniff" else SevenScenesReader().sniff(path)

    def open(self, path: Path) -> Source:
        if self.how == "accepts anything" and not path.exists():
            return Source("nothing", path)
        source = SevenScenesReader().open(path)
        first = source.frames[0]
        camera = first.camera
        changes = {
            "float64": {"read_depth": partial(ones, camera, "float64")},
            "nan": {"read_depth": partial(not_finite, camera)},
            "size": {"camera": replace(camera, width=camera.width + 1)},
            "changes": {"read_depth": partial(never_the_same, camera)},
            "keeps": {"read_depth": partial(np.asarray, np.ones((100, 100), np.float32))},
            "pose": {"world_from_cam": np.diag([1.0, 1, 2, 1])},
            "id": {"frame_id": source.frames[1].frame_id},
            "stamp": {"stamp_s": 1e9},
        }
        if self.how in changes:
            return replace(source, frames=(replace(first, **changes[self.how]), *source.frames[1:]))
        if self.how == "notes":
            return replace(source, notes=(str(next(CALLS)),))
        if self.how == "trajectory":
            return replace(source, trajectory=Trajectory(np.array([1.0, 1.0]), np.array([np.eye(4)] * 2)))
        return replace(source, files=()) if self.how == "files" else source


@dataclass
class Loose:
    """A good reader, but not frozen."""

    every: int = 1

    def sniff(self, path: Path) -> Sniff:
        return SevenScenesReader().sniff(path)

    def open(self, path: Path) -> Source:
        return SevenScenesReader(every=self.every).open(path)


def test_a_good_reader_passes(tmp_path: Path) -> None:
    assert len(check_reader(Broken(), seven_scenes_sequence(tmp_path / "seq-01")).frames) == 3


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("sniff", "sniff gives"),
        ("accepts anything", "must raise SourceError"),
        ("float64", "depth is float64"),
        ("nan", "finite metres"),
        ("size", r"\(6, 8\), not \(6, 9\)"),
        ("changes", "read twice: differs"),
        ("keeps", "read lazily"),
        ("pose", "not a rigid motion"),
        ("id", "not unique"),
        ("stamp", "do not ascend"),
        ("notes", "opened twice, differs"),
        ("trajectory", "do not ascend"),
        ("files", "no files"),
    ],
)
def test_a_broken_promise_is_named(tmp_path: Path, how: str, message: str) -> None:
    path = seven_scenes_sequence(tmp_path / "seq-01")
    with pytest.raises(AssertionError, match=message):
        check_reader(Broken(how), path)


def test_a_reader_that_can_be_changed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="frozen"):
        check_reader(Loose(), seven_scenes_sequence(tmp_path / "seq-01"))

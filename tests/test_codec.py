"""Values that steps leave: they come back as they were, and what a stranger put in their place is refused."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hodge_pipeline.store import codec
from hodge_pipeline.types import CloudSet, Floats
from test_store import ONE, Inner, Made, clouds


@dataclass(frozen=True)
class Value:
    number: float
    inner: Inner | None
    rows: dict[str, Floats]
    image: bytes = b""
    many: tuple[Inner, ...] = ()
    pair: tuple[int, str] = (0, "")


VALUES: list[tuple[Any, Any]] = [
    (Value(np.nan, None, {}), Value),
    (Value(-np.inf, Inner(ONE, None), {"a b": ONE[:0]}, b"\x00\xff", (Inner(ONE, "é", ("x",)),), (1, "q")), Value),
    (ONE.astype(np.int8), Floats),
    (b"", bytes),
    (None, float | None),
    (1.5, float | None),
    (("a", ["b"]), tuple[str, list[str]]),
    (True, bool),
]  # fmt: skip


@pytest.mark.parametrize(("value", "kind"), VALUES, ids=lambda one: type(one).__name__)
def test_values_come_back_as_they_were(tmp_path: Path, value: Any, kind: Any) -> None:
    codec.save(tmp_path, value)
    found = codec.load(tmp_path, kind)
    assert type(found) is type(value)
    np.testing.assert_equal(as_plain(found), as_plain(value))


def as_plain(value: Any) -> Any:
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else value  # type: ignore[arg-type]


def test_clouds_and_paths_lie_in_the_folder(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "file").touch()
    codec.save(tmp_path / "a", Made(clouds(2), tmp_path / "a" / "file"))
    (tmp_path / "a").rename(tmp_path / "b")
    found = codec.load(tmp_path / "b", Made)
    assert found.file == tmp_path / "b" / "file" and found.clouds.folder == tmp_path / "b" / "clouds"
    for name in CloudSet.FILES:
        np.testing.assert_array_equal(getattr(found.clouds, name), getattr(clouds(2), name))


@pytest.mark.parametrize("theirs", ["../outside", "/etc/passwd", "link"])
def test_a_path_outside_its_folder_is_refused(tmp_path: Path, theirs: str) -> None:
    folder = tmp_path / "step"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    for kind in (Path, CloudSet):
        (folder / "value.json").write_text(json.dumps(theirs if kind is Path else {"clouds": theirs}))
        with pytest.raises(ValueError, match="names a path outside its folder"):
            codec.load(folder, kind)


def test_a_path_elsewhere_and_an_unknown_type_are_not_stored(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="not in the subpath"):
        codec.save(tmp_path, Path("/etc/passwd"))
    for value in (object(), {"a": {1, 2}}, np.array([object()])):
        with pytest.raises(TypeError, match="cannot be stored"):
            codec.save(tmp_path, value)


class Pickled:
    """What would write a file if it were unpickled."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path(self.path),)


def test_a_pickle_in_an_array_file_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "value.npz", array=np.array([Pickled(str(tmp_path / "ran"))], dtype=object))
    (tmp_path / "value.json").write_text('{"array": "array"}')
    with pytest.raises(ValueError, match="allow_pickle"):
        codec.load(tmp_path, Floats)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("text", ["", "[]", '{"number": 1}', '{"array": "gone"}', '{"unknown": 1}', "3"])
def test_another_shape_than_the_code_expects_is_a_value_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "value.json").write_text(text)
    with pytest.raises(ValueError):
        codec.load(tmp_path, Value)


def test_a_value_of_another_version_is_told_by_what_it_lacks(tmp_path: Path) -> None:
    (tmp_path / "value.json").write_text('{"number": 1}')
    with pytest.raises(ValueError, match=r"^Value without inner, rows: another version wrote it$"):
        codec.load(tmp_path, Value)

"""Steps that are computed once: named, keyed, saved and loaded in one place."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.stages import Step
from hodge_pipeline.store import artifacts, codec
from hodge_pipeline.store.codec import CLOUDS
from hodge_pipeline.store.cost import Cost, Monitor
from hodge_pipeline.store.log import log
from hodge_pipeline.store.memory import give_back_memory
from hodge_pipeline.store.progress import Nobody, Watcher
from hodge_pipeline.store.workspace import disk_errors
from hodge_pipeline.types import CloudSet
from hodge_pipeline.types.input_files import open_input, read_input_text
from hodge_pipeline.types.notes import Note

T = TypeVar("T")
LIBRARIES = ("hodge-pipeline", "numpy", "scipy", "open3d", "small_gicp", "opencv-python-headless", "pycolmap")
LAYOUT = 4
"""Version of the format of stored steps: raise it when the format changes, so that older ones are computed again."""
RECORD, KEY, INDEX = "step.json", "key.txt", "index.json"
"""Files: record of a finished step (key, hash of each file, notes, cost); key of a begun one; list of a run's steps."""
HASHED_AT_ONCE = 1 << 22
"""Bytes."""
LONG_CPU_S = 10.0
"""CPU seconds of a step after which garbage is collected too: that takes 0.07 s."""


@cache
def versions() -> dict[str, str]:
    """The versions of this package and of the libraries that decide its numbers."""
    found = {}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


class Store:
    """The steps of one run, in `folder`: each is computed once for its inputs and read back afterwards.

    A step's key is a hash of its name, the library versions and the keys of its inputs: the key of an earlier step for
    what that step returned, the contents for anything else. A step is finished when its folder has its final name; the
    hash of every file is kept with the key, and a step whose files have changed since is computed again, and reported.
    """

    def __init__(self, folder: Path, watcher: Watcher | None = None) -> None:
        self.folder, self.notes = folder, list[Note]()
        self.watcher = watcher or Nobody()
        self._monitor, self._counts = Monitor(), Counter[str]()
        self._keys: dict[int, tuple[Callable[[], object], str]] = {}
        self._index: list[dict[str, Any]] = []

    def step(
        self, function: Callable[..., T], *inputs: Any, title: str, total: int = 1, name: str = "", **resources: Any
    ) -> T:
        """What the function returns, computed or read back: see `stages.Steps`, and `codec` for what can be stored."""
        name = self._numbered(name or function.__name__)
        key = self.key([name, LAYOUT, versions(), inputs])
        path, kind = self.folder / name, get_type_hints(function)["return"]
        if self._is_whole(path, key):
            log.info("%s: already done", title)
        else:
            cost = self._compute(path, key, title, total, partial(function, *inputs, **resources))
            self._give_back_memory(cost.cpu_s >= LONG_CPU_S)
        self.note(*(Note(**note) for note in _unsealed(path / RECORD)["notes"]))
        value: T = codec.load(path, kind)
        self.remember(value, key)
        self._listed(name, function.__name__, title)
        return value

    def key(self, value: Any) -> str:
        """The key of an input: of the step that made it, else of its contents."""
        known = self._keys.get(id(value))
        return known[1] if known is not None and known[0]() is value else _hash(self._content(value))

    def remember(self, value: object, key: str) -> None:
        """Let `value`, this very object, stand for `key` wherever it is an input, as long as somebody holds it."""
        if value is not None and not isinstance(value, (bool, int, float, str)):
            self._keys[id(value)] = (_reference(value), key)

    def note(self, *notes: Note) -> None:
        """Tell the user, the log and the report, once; a finished step tells its notes again in every later run."""
        for note in notes:
            if note not in self.notes:
                self.notes.append(note)
                self.watcher.note(note)
                log.warning(note)

    def costs(self) -> list[dict[str, Any]]:
        """Title, wall_s, cpu_s and peak_mb of each step so far, whenever it was computed; those of one title added."""
        found: dict[str, dict[str, Any]] = {}
        for entry in self._index:
            own = _unsealed(self.folder / entry["name"] / RECORD)["cost"]
            sums = found.pop(entry["title"], {"title": entry["title"], **vars(Cost())})
            added = {part: sums[part] + own[part] for part in ("wall_s", "cpu_s")}
            found[entry["title"]] = {**sums, **added, "peak_mb": max(sums["peak_mb"], own["peak_mb"])}
        return list(found.values())

    def _numbered(self, name: str) -> str:
        self._counts[name] += 1
        return f"{name}-{self._counts[name]}"

    def _content(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            if value.dtype.hasobject:
                raise TypeError("an array of objects has no key: let the store remember what holds it")
            return [str(value.dtype), list(value.shape), hashlib.sha256(value.tobytes()).hexdigest()]
        if isinstance(value, CloudSet):
            return {name: self.key(getattr(value, name)) for name in CloudSet.FILES}
        if isinstance(value, bytes):
            return hashlib.sha256(value).hexdigest()
        if isinstance(value, Path):
            return file_facts(value) if value.is_file() else str(value)
        if isinstance(value, Mapping):
            return {str(name): self.key(item) for name, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [self.key(item) for item in value]
        if dataclasses.is_dataclass(value):
            fields = {one.name: self.key(getattr(value, one.name)) for one in dataclasses.fields(value)}
            return [type(value).__qualname__, fields]
        return value

    def _is_whole(self, path: Path, key: str) -> bool:
        """Whether the step is finished under this key and each of its files is as it was written."""
        if not path.exists():
            return False
        try:
            record = _unsealed(path / RECORD)
            if record["key"] != key:
                return False
            _check_files(path, record["files"])
        except (OSError, ValueError) as error:
            self.note(Note("damaged step", detail=f"{path.name}: {error}"))
            return False
        return True

    def _compute(self, path: Path, key: str, title: str, total: int, function: Callable[..., Any]) -> Cost:
        part = path.with_name(f"{path.name}.part")
        notes: dict[Note, None] = {}
        log.info("%s: begins", title)
        with self._monitor.measure() as cost, disk_errors(part), self.watcher.stage(title, total) as advance:
            if _text(part / KEY) != key:
                shutil.rmtree(part, ignore_errors=True)
                part.mkdir(parents=True)
                artifacts.write_text(part / KEY, key)
            codec.save(part, function(step=Step(part, advance, lambda *told: notes.update(dict.fromkeys(told)))))
        with disk_errors(part):
            (part / KEY).unlink()
            files = {
                str(file.relative_to(part)): file_facts(file) for file in sorted(part.rglob("*")) if file.is_file()
            }
            facts = {"key": key, "title": title, "files": files, "notes": [vars(note) for note in notes]}
            _seal(part / RECORD, {**facts, "versions": versions(), "cost": vars(cost)})
            _commit(part, path)
        log.info("%s: %.1f s wall, %.1f s CPU, %.0f MB", title, cost.wall_s, cost.cpu_s, cost.peak_mb)
        return cost

    def _give_back_memory(self, was_long: bool) -> None:
        """Unmap clouds and return freed memory, so that the next step is not charged with it."""
        for reference, _ in self._keys.values():
            value = reference()
            if isinstance(value, CloudSet):
                value.forget()
        give_back_memory(cycles=was_long)

    def _listed(self, name: str, function: str, title: str) -> None:
        """Keep the list of the steps so far, in order, without those that another run of this folder left."""
        self._index.append({"name": name, "function": function, "title": title})
        _seal(self.folder / INDEX, {"steps": self._index})


def stored(folder: Path, function: Callable[..., T]) -> list[T]:
    """What every call of a step's function returned in the latest run, in order, as far as it came; `folder` as a
    `Store`'s. Nothing is computed, and no version or source is asked for.

    Raises `WorkspaceError` where a file has changed since it was written.
    """
    kind = get_type_hints(function)["return"]
    return [_checked(path, files, lambda path: codec.load(path, kind)) for path, files in _steps(folder, function)]


def stored_clouds(folder: Path) -> list[CloudSet]:
    """The clouds that steps of the latest run made, in order, whichever step it was: see `stored`."""
    with_clouds = ((path, files) for path, files in _steps(folder) if f"{CLOUDS}/offsets.npy" in files)
    return [_checked(path, files, lambda path: CloudSet.open(path / CLOUDS)) for path, files in with_clouds]


def _checked(path: Path, files: Mapping[str, list[Any]], load: Callable[[Path], T]) -> T:
    """What a step's folder holds, if its files are as they were written."""
    try:
        _check_files(path, files)
        return load(path)
    except (OSError, ValueError) as error:
        raise _damaged(path, error) from error


def _steps(folder: Path, function: Callable[..., Any] | None = None) -> Iterator[tuple[Path, Mapping[str, list[Any]]]]:
    """Folder and files of each step of the latest run, or of this function's calls alone."""
    if not (folder / INDEX).exists():
        return
    path = folder / INDEX
    try:
        for entry in _unsealed(path)["steps"]:
            if function is None or function.__name__ == entry["function"]:
                path = folder / entry["name"]
                yield path, _unsealed(path / RECORD)["files"]
    except (OSError, ValueError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> WorkspaceError:
    return WorkspaceError(f"{path}: {error}: the same hodge run computes it again")


def _check_files(path: Path, files: Mapping[str, list[Any]]) -> None:
    """Raise `ValueError` where a file of a step is not as it was written."""
    for name, known in files.items():
        if not (path / name).is_file():
            raise ValueError(f"{name} is gone")
        if file_facts(path / name) != known:
            raise ValueError(f"{name} has changed since it was written")


def _seal(path: Path, content: dict[str, Any]) -> None:
    """Write JSON with a hash of itself."""
    content = json.loads(artifacts.json_text(content))
    artifacts.write_json(path, {**content, "seal": _hash(content)})


def _unsealed(path: Path) -> dict[str, Any]:
    """What `_seal` wrote. Raises `ValueError` where it has changed since, `OSError` where it cannot be read."""
    try:
        content: dict[str, Any] = artifacts.read_json(path)
        seal = content.pop("seal")
    except FileNotFoundError as error:
        raise ValueError(f"{path.name} is gone") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path.name} has changed since it was written") from error
    if _hash(content) != seal:
        raise ValueError(f"{path.name} has changed since it was written")
    return content


def file_facts(path: Path) -> list[Any]:
    """Size and SHA-256 of a file."""
    total, size = hashlib.sha256(), 0
    with open_input(path) as stream:
        while block := stream.read(HASHED_AT_ONCE):
            total.update(block)
            size += len(block)
    return [size, total.hexdigest()]


def _commit(part: Path, path: Path) -> None:
    """Give a finished step its name, once all of its bytes are on the disk."""
    for file in (*part.rglob("*"), part):
        handle = os.open(file, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    shutil.rmtree(path, ignore_errors=True)
    os.replace(part, path)
    handle = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _text(path: Path) -> str:
    try:
        return read_input_text(path)
    except (OSError, UnicodeDecodeError):
        return ""


def _hash(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=_number).encode()).hexdigest()[:32]


def _reference(value: T) -> Callable[[], T | None]:
    """A weak reference to the value; a strong one where its type allows no weak ones."""
    try:
        return weakref.ref(value)
    except TypeError:
        return lambda: value


def _number(value: Any) -> Any:
    """A numpy scalar as Python's; any other object would have another key in every process."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} has no key: let the store remember what holds it")

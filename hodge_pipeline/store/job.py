"""One run in progress: its stages with their keys, costs, notes and log."""

from __future__ import annotations

import logging
import os
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hodge_pipeline.executors.dask import open_workers
from hodge_pipeline.recipe import binding
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.refine.given_poses import Given
from hodge_pipeline.stages import Advance, Workers, no_progress
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.cost import Cost, Monitor
from hodge_pipeline.store.progress import Watcher
from hodge_pipeline.store.workspace import KEY_FILE, StageFolder, Workspace, key_of
from hodge_pipeline.types import Source

if TYPE_CHECKING:
    from hodge_pipeline.start.key_frames import Tracked

LIBRARIES = ("hodge-pipeline", "numpy", "scipy", "open3d", "small_gicp", "opencv-python-headless", "pycolmap")
RECORDING = "recording"
"""The title of every stage that only records: such a stage is written whether a job computes or not."""
log = logging.getLogger("hodge_pipeline")


class Unfinished(Exception):
    """A stage, named by its title, that a job which does not compute would need; `stale` says why, if it was made."""

    def __init__(self, title: str, stale: str = "") -> None:
        super().__init__(title)
        self.stale = stale


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


@dataclass
class Job:
    """What every step of a run shares. `keys` holds the key of each stage so far, by its name.

    A job that does not compute reads finished stages only: one that is not raises `Unfinished`. Without `scoring` the
    score tables, the slowest part of the end, are left out. `live` is the address of a viewer that is shown the
    recording as it grows, `dask` that of a cluster which works in place of the recipe's executor. `given` are the poses
    that it starts from, where they are not its own odometry; `opened` is the source where it needs no reader; `tracked`
    says how all frames move with the key frames.
    """

    recipe: Recipe
    workspace: Workspace
    watcher: Watcher
    computes: bool = True
    live: str | None = None
    dask: str | None = None
    monitor: Monitor = field(default_factory=Monitor)
    keys: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    scoring: bool = True
    given: Given | None = None
    opened: Source | None = None
    tracked: Tracked | None = None

    def path(self, stage: str) -> Path:
        """Where a stage's artifacts lie."""
        return self.workspace.path(stage)

    def workers(self) -> AbstractContextManager[Workers]:
        """Whoever registers the pairs: the cluster that the caller names, else the recipe's executor."""
        return open_workers(self.recipe.executor, self.dask)

    def note(self, message: str) -> None:
        """Tell the user, the log and the report; a finished stage tells its notes again in every later run."""
        if message not in self.notes:
            self.notes.append(message)
            self.watcher.say(message)
            log.warning(message)

    @contextmanager
    def stage(
        self, name: str, title: str, total: int, options: Any, inputs: tuple[str, ...]
    ) -> Iterator[tuple[StageFolder, Advance]]:
        """One stage: its folder and its progress. Its key is its options, the versions and its inputs' keys."""
        key = key_of(name, binding.unbind(options), versions(), [self.keys[stage] for stage in inputs])
        self.keys[name] = key
        told = len(self.notes)
        if not (self.computes or title == RECORDING or self.workspace.is_finished(name, key)):
            raise Unfinished(title, self._why_stale(name))
        with self.monitor.measure() as cost, self.workspace.stage(name, key) as folder:
            if folder.finished:
                log.info("%s: already done", title)
                for message in folder.info.get("notes", []):
                    self.note(message)
                yield folder, no_progress
            else:
                log.info("%s: begins", title)
                with self.watcher.stage(title, total) as advance:
                    yield folder, advance
        if not folder.finished:
            log.info("%s: %.1f s wall, %.1f s CPU, %.0f MB", title, cost.wall_s, cost.cpu_s, cost.peak_mb)
            facts = {"title": title, "notes": self.notes[told:], "versions": versions(), **vars(cost)}
            self.workspace.note(name, facts)

    def _why_stale(self, name: str) -> str:
        """Why a stage that lies in the folder is not the one that this job wants; empty where there is none."""
        path = self.path(name) / KEY_FILE
        if not path.is_file():
            return ""
        made_with = artifacts.read_json(path).get("versions", {})
        for library, now in versions().items():
            if made_with.get(library, now) != now:
                return f"made with {library} {made_with[library]}, here is {now}"
        computed = [stage for stage in self.keys if not stage.startswith("record")]
        is_first = not any(self.workspace.is_finished(stage, self.keys[stage]) for stage in computed)
        return "made from a source that has changed since" if is_first else ""

    def costs(self) -> list[dict[str, Any]]:
        """Title, wall_s, cpu_s and peak_mb of each stage so far, those finished before it was resumed included.

        Stages of one title, such as the parts of the recording, are one entry.
        """
        found: dict[str, dict[str, Any]] = {}
        for name in self.keys:
            info = artifacts.read_json(self.path(name) / KEY_FILE) if self.path(name).is_dir() else {}
            if "title" in info:
                known = found.pop(info["title"], {"title": info["title"], **vars(Cost())})
                sums = {part: known[part] + info[part] for part in ("wall_s", "cpu_s")}
                found[info["title"]] = {**known, **sums, "peak_mb": max(known["peak_mb"], info["peak_mb"])}
        return list(found.values())


def source_key(source: Source, reader: Any) -> str:
    """The key of an input: the reader's options, and name, size and time of each file."""
    files = []
    for path in source.files:
        status = os.stat(path)
        files.append((str(path), status.st_size, status.st_mtime_ns))
    return key_of("source", binding.unbind(reader), files)


def unnamed_key() -> str:
    """A key that no other run has, for what is in memory and cannot be told from its like."""
    return uuid.uuid4().hex


@contextmanager
def logging_to(path: Path) -> Iterator[None]:
    """Add what the run logs to a file, each line with its time."""
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    except BaseException as error:
        log.error("stopped: %s", error or type(error).__name__)
        raise
    finally:
        log.removeHandler(handler)
        handler.close()

"""The run folder: its recipe, and the lock that one process holds."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.store import artifacts, yaml_file
from hodge_pipeline.types.input_files import read_input
from hodge_pipeline.types.text import command

RECIPE_FILE, EDITS_FILE, LOG_FILE, LOCK_FILE = "recipe.yaml", "edits.json", "log.txt", ".lock"
EDGES_FILE, GRAPH_FILE, SOLVED_FILE = "edges.csv", "graph.g2o", "solved.json"
PAGE_FILE, NUMBERS_FILE, RECORDING_FILE = "report.html", "report.json", "recording.rrd"
"""Files of a run folder; `SOLVED_FILE` is in that of a solved pose-graph file alone."""
_DRAFT = re.compile(r"\.[^.].*\.(csv|g2o|html|json|kitti|npz|ply|rrd|tum|txt|yaml)\.[0-9]+\.draft")
_DRAFT_FOLDER = re.compile(r"\.(recording-|sparse\.)[a-z0-9_]{8}")
"""Names of unfinished files and folders of `output_files` and of the recording."""
RUN, REFINEMENT = "stages", "refinement"
"""The folder of the stages of a run, and of the refinement of a model."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, None)
"""Error numbers when a file cannot be written; None is that of numpy's own short write."""


def identity_of(folder: Path) -> str:
    """A name of the run in a folder that stays the same when it is resumed."""
    return hashlib.sha256(read_input(folder / RECIPE_FILE)).hexdigest()[:32]


def is_run_folder(path: Path) -> bool:
    """Whether a path is what a run left, finished or not."""
    return (path / RECIPE_FILE).is_file() and (path / RUN).is_dir()


class Workspace:
    """One run folder, held by one process at a time.

    Its steps lie in the folder `stages` (see `Store`); everything else is for people. `kind` is what `stages` is
    called: what runs and what refines a model never share a folder.
    """

    def __init__(self, folder: Path, lock: IO[str], kind: str = RUN) -> None:
        self.folder, self.kind = folder, kind
        self._lock = lock

    @classmethod
    def open(
        cls,
        folder: Path,
        recipe: dict[str, Any],
        *,
        overwrite: bool = False,
        refusal: str = "holds a run of another recipe ({change}): --overwrite replaces it",
        kind: str = RUN,
    ) -> Workspace:
        """The run folder for this recipe, made if it is not there.

        Raises `WorkspaceError` where the folder is something else, belongs to another recipe (without `overwrite`;
        `refusal` then says so, with the first `{change}`), holds a symbolic link or is in use.
        """
        if os.path.lexists(folder / RECIPE_FILE):
            _refuse_irregular(folder)
        try:
            str(folder.absolute()).encode()
            folder.mkdir(parents=True, exist_ok=True)
            lock = _open_lock(folder)
        except UnicodeEncodeError as error:
            raise WorkspaceError(f"{folder}: not a name in UTF-8, which recordings need: give another --out") from error
        except OSError as error:
            raise WorkspaceError(f"{folder}: cannot be written ({error.strerror}): give another --out") from error
        try:
            hold(lock, _in_use(folder))
            with disk_errors(folder):
                _remove_drafts(folder)
                _check_kind(folder, kind)
                _check_recipe(folder, recipe, overwrite, refusal, kind)
                (folder / kind).mkdir(exist_ok=True)
        except BaseException:
            lock.close()
            raise
        return cls(folder, lock, kind)

    @classmethod
    def reopen(cls, folder: Path, recipe: dict[str, Any]) -> Workspace:
        """The run folder of a run that is there, by its own recipe.

        Raises `WorkspaceError` as `open` does, and where another version, which knew other options, has made it.
        """
        again = command("hodge", "run", folder / RECIPE_FILE, "--out", folder, "--overwrite")
        refusal = f"was made by another version (the recipe's {{change}}): '{again}' brings it up to date first"
        return cls.open(folder, recipe, refusal=refusal)

    @property
    def steps(self) -> Path:
        """The folder of the steps."""
        return self.folder / self.kind

    def close(self) -> None:
        """Let another process have the folder."""
        self._lock.close()

    def __enter__(self) -> Workspace:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def make_folder(folder: Path, option: str = "--out") -> None:
    """Make a folder where there is none. Raises `WorkspaceError` that names the option which gave it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkspaceError(f"{folder}: cannot be written ({error.strerror}): give another {option}") from error


@contextmanager
def holding(folder: Path) -> Iterator[None]:
    """While the body runs no run uses the folder. Raises `WorkspaceError` where one does already."""
    _refuse_irregular(folder)
    try:
        lock = _open_lock(folder)
    except OSError as error:
        raise WorkspaceError(f"{folder}: cannot be written ({error.strerror}): copy it to where it can be") from error
    with lock:
        hold(lock, _in_use(folder))
        yield


def _refuse_irregular(folder: Path) -> None:
    """Raise `WorkspaceError` for links and special files in a run folder, which may come from a stranger: writing
    through a link would change files elsewhere, and reading a pipe would block.
    """
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            mode = os.lstat(os.path.join(parent, name)).st_mode
            if stat.S_ISLNK(mode):
                raise WorkspaceError(
                    f"{os.path.join(parent, name)}: is a symbolic link, which no run makes, and would be written "
                    "through: remove it, or put what it leads to in its place"
                )
            if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
                raise WorkspaceError(f"{os.path.join(parent, name)}: is no file, and no run makes the like: remove it")


def _remove_drafts(folder: Path) -> None:
    """Remove the unfinished files of a killed process; the lock keeps other writers out."""
    for parent, folders, files in os.walk(folder):
        for name in files:
            if _DRAFT.fullmatch(name):
                os.unlink(os.path.join(parent, name))
        for name in [name for name in folders if _DRAFT_FOLDER.fullmatch(name)]:
            folders.remove(name)
            shutil.rmtree(os.path.join(parent, name), ignore_errors=True)


def _open_lock(folder: Path) -> IO[str]:
    """The open lock file; links are not followed, and a pipe does not block."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    return os.fdopen(os.open(folder / LOCK_FILE, flags, 0o644), "r+")


def _in_use(folder: Path) -> str:
    return f"{folder}: another run uses this folder: wait for it, or name another folder"


def hold(file: IO[str] | int, refusal: str) -> None:
    """Take the lock of an open file, which ends with it. Raises `WorkspaceError` where another process has it."""
    try:
        import fcntl
    except ImportError:  # Windows has no flock: there two runs, or reviews, of one folder are the user's care
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise WorkspaceError(refusal) from error


def _check_kind(folder: Path, kind: str) -> None:
    for other, content in ((RUN, "a run"), (REFINEMENT, "a refined model")):
        if kind != other and (folder / other).is_dir():
            raise WorkspaceError(f"{folder}: holds {content}: give another --out")


def _check_recipe(folder: Path, recipe: dict[str, Any], overwrite: bool, refusal: str, kind: str) -> None:
    """Write the resolved recipe, or refuse a folder that is not this recipe's."""
    path = folder / RECIPE_FILE
    text = yaml_file.dump(recipe)
    if path.exists() and _is_text(path, text):
        return
    if path.exists() and (folder / kind).is_dir():
        is_begun = any((folder / kind).iterdir())  # a run that failed before its first stage may be overwritten
        if not overwrite and is_begun:
            change = _first_change(yaml_file.read(path).data, recipe)
            raise WorkspaceError(f"{folder}: {refusal.replace('{change}', change)}")
    elif any(entry.name != LOCK_FILE for entry in folder.iterdir()):
        with suppress(OSError):
            (folder / LOCK_FILE).unlink()
        raise WorkspaceError(f"{folder}: is not empty and not a run folder: give another --out")
    artifacts.write_text(path, text)


def _is_text(path: Path, text: str) -> bool:
    try:
        return read_input(path) == text.encode()
    except OSError as error:
        raise WorkspaceError(f"{path}: cannot be read ({error.strerror}): remove it, or give another --out") from error


def _first_change(old: Any, new: Any, key: str = "") -> str:
    """Where two recipes first differ, in words."""
    if isinstance(old, dict) and isinstance(new, dict):
        names = [*new, *(name for name in old if name not in new)]
        for name in sorted(names, key=lambda name: bool(not key and name == "description")):
            if old.get(name) != new.get(name):
                return _first_change(old.get(name), new.get(name), f"{key}.{name}" if key else name)
    return f"{key} was {old!r}, is {new!r}" if key else "formatting"


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Raises errors of a full or unwritable disk as `WorkspaceError`, in one line."""
    try:
        yield
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        raise WorkspaceError(
            f"{path}: {error.strerror or error}: what was finished stays; make room and run the same command again"
        ) from error

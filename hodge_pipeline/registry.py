"""Names to stages, by entry points. Listing imports nothing; a broken plugin harms nobody but its own user."""

from __future__ import annotations

import difflib
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from hodge_pipeline import stages
from hodge_pipeline.errors import HodgeError, RecipeError, StageError


@dataclass(frozen=True)
class Kind:
    """One kind of stage: its name in messages, the entry-point group is `hodge_pipeline.<name>`, and its Protocol."""

    name: str
    protocol: type
    summary: str

    @property
    def group(self) -> str:
        """The entry-point group in which a package registers stages of this kind."""
        return f"hodge_pipeline.{self.name}"


KINDS = {
    kind.name: kind
    for kind in (
        Kind("readers", stages.FrameReader, "open a path of one format"),
        Kind("start", stages.Start, "find the first poses"),
        Kind("edges", stages.EdgeBuilder, "propose pairs of frames to register"),
        Kind("registration", stages.Registrar, "register one pair"),
        Kind("global_registration", stages.GlobalRegistrar, "find where one cloud lies in another, with no guess"),
        Kind("executors", stages.Executor, "where pairs are registered"),
        Kind("solvers", stages.ConsistencySolver, "make all poses consistent"),
        Kind("fusion", stages.Fuser, "fuse all frames into one model"),
        Kind("models", stages.ModelReader, "open a model of posed images and tracked points, to be refined"),
        Kind("writers", stages.Writer, "write what another program reads"),
        Kind("rewriters", stages.PoseRewriter, "write refined poses back into the form they came in"),
    )
}


def kind_of(annotation: object) -> Kind | None:
    """The kind whose Protocol this type annotation is, or None."""
    return next((kind for kind in KINDS.values() if kind.protocol is annotation), None)


@cache
def _installed() -> Any:  # its type is another one from Python 3.12 on
    """The entry points of all packages: Python reads them anew each time it is asked for a group."""
    return entry_points()


@cache
def _entries(group: str) -> dict[str, EntryPoint]:
    """Entry points by name; of two with one name, the one of this project wins, else the first by package name."""

    def rank(entry: EntryPoint) -> tuple[bool, str]:
        package = entry.dist.name if entry.dist else ""
        return package == "hodge-pipeline", package

    found: dict[str, EntryPoint] = {}
    for entry in sorted(_installed().select(group=group), key=rank):
        found[entry.name] = entry
    return found


def names(kind: str) -> list[str]:
    """The registered names of one kind, sorted; imports no stage."""
    return sorted(_entries(KINDS[kind].group))


def origin(kind: str, name: str) -> str:
    """The package and version that registered a stage, as `package 1.2.3`."""
    dist = _entries(KINDS[kind].group)[name].dist
    return f"{dist.name} {dist.version}" if dist else "unknown package"


def suggestion(given: str, known: list[str]) -> str:
    """`" (did you mean 'x'?)"`, or the known names where nothing is close."""
    if given.startswith("paper"):
        return " (the paper's own solver and recipes are a plugin: pip install ./benchmarks/paper/method)"
    close = difflib.get_close_matches(given, known, n=1)
    return f" (did you mean '{close[0]}'?)" if close else f" (known: {', '.join(known) or 'none'})"


OURS = "hodge-pipeline "
LIBRARIES = "on Debian or Ubuntu apt-get install libusb-1.0-0 libegl1 libgl1 libx11-6 libgomp1 has what open3d needs"
"""As tools/system-libraries.sh installs them."""


def load(kind: str, name: str) -> Any:
    """The class of a stage. Raises `RecipeError` for an unknown name, or for a plugin that does not import."""
    known = _entries(KINDS[kind].group)
    if name not in known:
        raise RecipeError(f"no stage '{name}' of kind '{kind}'{suggestion(name, sorted(known))}")
    try:
        return known[name].load()
    except Exception as error:  # a plugin can fail in any way
        give_way_to_ctrl_c(error)
        reason = f"{type(error).__name__}: {error}"
        ours = isinstance(error, ImportError) and origin(kind, name).startswith(OURS)
        raise RecipeError(
            f"stage '{name}' of kind '{kind}' ({origin(kind, name)}) does not load: {reason}; "
            f"{LIBRARIES if ours else 'repair or remove it'}"
        ) from error


def give_way_to_ctrl_c(error: BaseException) -> None:
    """Raise the `KeyboardInterrupt` that a compiled module, stopped while it was imported, tells as an ImportError."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, KeyboardInterrupt):
            raise cause
        cause = cause.__cause__ or cause.__context__


def name_of(stage: object) -> str:
    """The registered name of a stage instance, else its `module:Class`."""
    return name_of_class(type(stage))


def name_of_class(cls: type) -> str:
    """The registered name of a stage, else its `module:Class`."""
    path = f"{cls.__module__}:{cls.__qualname__}"
    return next((name for _, name in _registered_as(path)), path)


def _registered_as(path: str) -> Iterator[tuple[str, str]]:
    """Kind and name of each entry point of this `module:Class`."""
    for kind in KINDS.values():
        yield from ((kind.name, name) for name, entry in _entries(kind.group).items() if entry.value == path)


@contextmanager
def plugin_errors() -> Iterator[None]:
    """Raise `plugin_error` in the place of the error that it names. A decorator of tasks, too: a worker's error comes
    back without its frames.
    """
    try:
        yield
    except Exception as error:
        named = plugin_error(error)
        if named is None:
            raise
        raise named from error


def plugin_error(error: Exception) -> StageError | None:
    """The error of one line that stands for what a stage of another package raised; None for any other error."""
    stage = None if isinstance(error, (HodgeError, MemoryError)) else _plugin_in(error)
    if stage is None:
        return None
    where = traceback.extract_tb(error.__traceback__)[-1]
    raised = " ".join(f"{type(error).__name__}: {error}".split())
    return StageError(f"stage {stage} raised {raised}, at {Path(where.filename).name}:{where.lineno}")


def _plugin_in(error: Exception) -> str | None:
    """The innermost stage of another package whose method the error passed through, as `name (package 1.2.3)`."""
    found = None
    for frame, _ in traceback.walk_tb(error.__traceback__):
        found = _plugin_of(type(frame.f_locals.get("self"))) or found
    return found


def _plugin_of(cls: type) -> str | None:
    known = ((name, origin(kind, name)) for kind, name in _registered_as(f"{cls.__module__}:{cls.__qualname__}"))
    return next((f"{name} ({package})" for name, package in known if not package.startswith(OURS)), None)

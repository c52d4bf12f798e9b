"""Errors that a user can mend: each is one line that says what, where, and what to do."""

from __future__ import annotations

from errno import EDQUOT, EILSEQ, ENODATA, ENOSPC
from pathlib import Path


class HodgeError(Exception):
    """Root of every error that the command line prints as one line. `exit_code` is 1: the user's input."""

    exit_code = 1


class RecipeError(HodgeError):
    """A recipe, an override or a stage's option is wrong: names file, line, key and what was expected.

    `keys` is the path of the option, where one is to blame.
    """

    def __init__(self, message: str, keys: tuple[str | int, ...] = ()) -> None:
        super().__init__(message)
        self.keys = keys


class SourceError(HodgeError):
    """The input cannot be read: names the file, the frame or record, and the remedy."""


class CameraError(SourceError):
    """Nothing tells the intrinsics of images of this `size` (width, height): `camera` is to be given to the reader."""

    def __init__(self, message: str, size: tuple[int, int] = (0, 0), camera: str = "[fx,fy,cx,cy]") -> None:
        super().__init__(f"{message}: give those of your camera with --set source.reader.camera={camera}")
        self.size, self.camera = size, camera


class GraphError(HodgeError):
    """A viewing graph, or the numbers in it, cannot be used as given."""


class WorkspaceError(HodgeError):
    """The run folder belongs to another recipe, is in use, or cannot be written."""


class WorkerError(HodgeError):
    """A worker process or cluster was lost more often than its edges may be retried."""


class StageError(HodgeError):
    """A stage of another package raised something else than a `HodgeError`: names stage, package, error and line."""


class CheckError(HodgeError):
    """A result failed its own checks. `exit_code` is 3."""

    exit_code = 3


def not_read(path: Path, error: OSError) -> SourceError:
    """What an input file that cannot be read is told as."""
    if error.errno in (ENODATA, EILSEQ):  # of `types.input_files`: these words say what to do
        return SourceError(f"{path}: {error.strerror}")
    return SourceError(f"{path}: cannot be read ({error.strerror}): restore the file or its permissions")


def not_written(path: Path, error: OSError) -> WorkspaceError:
    """What a file that the system refuses to write is told as."""
    if isinstance(error, (FileNotFoundError, NotADirectoryError)):
        remedy = "is its folder there?"
    else:
        remedy = "make room, or write elsewhere" if error.errno in (ENOSPC, EDQUOT) else "write elsewhere"
    return WorkspaceError(f"{path}: cannot be written ({error.strerror or error}): {remedy}")

"""`hodge convert`: open a path by a reader, write it by a writer."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hodge_pipeline import registry
from hodge_pipeline.cli.guard import shown
from hodge_pipeline.cli.reader_choice import choose_reader
from hodge_pipeline.errors import RecipeError, not_written
from hodge_pipeline.scene import own_trajectory
from hodge_pipeline.stages import Writer
from hodge_pipeline.store.workspace import is_run_folder
from hodge_pipeline.types import Source

BY_NAME = {"transforms.json": "nerfstudio"}
BY_SUFFIX = {
    ".tum": "tum",
    ".txt": "tum",
    ".kitti": "kitti",
    ".g2o": "g2o",
    ".csv": "euroc",
    ".log": "log",
    ".ply": "ply",
    "": "colmap",
}
"""Writers by the ending of the output; no ending is a folder."""


def convert(
    source: Path,
    out: Path,
    *,
    to: str | None = None,
    reader: str | None = None,
    settings: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Read a path with the surest reader, or the one named, and write it, in the format of its name or of `to`.

    A run folder is read as its frames with their final poses, and the clouds of its key frames.

    Prints what was written, what the format lost, and every note of the reader. Raises `RecipeError` where no writer is
    meant by the name, or there is something at `out` that is not to be replaced.
    """
    keep_source(source, out)
    if not overwrite and out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise RecipeError(f"{out}: is there already: give another name, or --overwrite to replace it")
    if is_run_folder(source) and reader is None:
        from hodge_pipeline.run_folder import Run

        opened = Run.load(source).posed_source()
    else:
        opened = choose_reader(source, reader, settings).open(source)
    opened = replace(opened, trajectory=own_trajectory(opened))
    name = to or writer_name(out, opened)
    writer: Writer = registry.load("writers", name)()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise not_written(out, NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))) from error
    except OSError as error:
        raise not_written(out, error) from error
    for note in opened.notes:
        print(f"note: {shown(note)}")
    what, *lost = writer.write(out, opened) or ("",)
    for note in lost:
        print(f"note: {shown(note)}")
    print(f"{out}: written as {name}{what and ': '}{what}")


def writer_name(out: Path, source: Source) -> str:
    """The writer by an output's name; `.json` is Open3D's pose graph or trajectory. Raises `RecipeError` for others."""
    known = registry.names("writers")
    if out.name in BY_NAME:
        return BY_NAME[out.name]
    if out.suffix == ".json":
        return "open3d_trajectory" if source.graph is None else "open3d_pose_graph"
    name = BY_SUFFIX.get(out.suffix.lower(), out.suffix[1:])
    if name not in known:
        raise RecipeError(f"{out}: no writer for '{out.suffix}': name one with --to ({', '.join(known)})")
    return name


def keep_source(source: Path, out: Path) -> None:
    """Raise `RecipeError` where the result would be written over what is read, not every line of which may come back,
    or into its folder.
    """
    if not out.exists() or not source.exists():
        return
    if out.samefile(source):
        raise RecipeError(f"{out}: is what is read: give another path for the result")
    if out.is_dir() and out.resolve() in source.resolve().parents:
        raise RecipeError(f"{out}: holds what is read: give the name of a file or of a folder in it")


def check_result(out: Path) -> None:
    """Raise `RecipeError` where no file can be written at a path, before the time for its contents is spent."""
    if out.is_dir():
        raise RecipeError(f"--out {out}: is a folder: give the name of a file in it, such as {out / 'solved.g2o'}")
    if not out.parent.is_dir():
        raise RecipeError(f"--out {out}: there is no folder {out.parent}: make it first")

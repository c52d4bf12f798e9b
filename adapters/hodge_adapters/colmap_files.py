"""Where the parts of a COLMAP project lie: the model, its images, its depth, its database."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from hodge_adapters import colmap_binary, colmap_text
from hodge_adapters.colmap_records import Model, check_model, no_points
from hodge_adapters.colmap_rigs import posed_by_rigs, rig_files
from hodge_pipeline.errors import SourceError

MODEL_PLACES = ("", "sparse", "sparse/0", "0", "colmap/sparse/0", "colmap", "dense/sparse", "dense/0/sparse")
PARENTS = 3
LOOKED_AT = 60
MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")
_DIGITS = re.compile(r"(\d+)")


def find_model(path: Path) -> Path | None:
    """The folder with the cameras and images of a model: the path itself, or its usual places below."""
    return next((path / place for place in MODEL_PLACES if model_ending(path / place)), None)


def part_of_model(path: Path) -> str:
    """What to give instead of a file of COLMAP's, empty for any other."""
    if path.suffix == ".db" and path.is_file():
        return "a database of COLMAP's has matches, no poses: give the folder of a model, with --database for this one"
    if path.stem in MODEL_FILES and path.suffix in (".bin", ".txt") and model_ending(path.parent):
        return f"one file of a COLMAP model: give its folder {path.parent}"
    return ""


def no_model(path: Path) -> SourceError:
    """The error for a path without a model: what to give instead where a part of one is named, or one lies below."""
    if not path.exists():
        return SourceError(f"{path}: no such file or folder")
    advice = part_of_model(path) or "no COLMAP model: give the folder with cameras.bin and images.bin, or .txt"
    for place in ("*", "*/*", "*/*/*") if path.is_dir() else ():
        below = sorted({found.parent for found in islice(path.glob(f"{place}/cameras.*"), LOOKED_AT)})
        models = [folder for folder in below if model_ending(folder)]
        if models:
            return SourceError(f"{path}: no COLMAP model itself, but holds some below: give {models[0]}")
    return SourceError(f"{path}: {advice}")


def model_ending(folder: Path) -> str | None:
    """`.bin` or `.txt` where the folder holds a model; COLMAP itself prefers the binary one."""
    for ending in (".bin", ".txt"):
        if all((folder / f"{name}{ending}").is_file() for name in ("cameras", "images")):
            return ending
    return None


def find_folder(model: Path, given: str, usual: Sequence[str]) -> Path | None:
    """The folder of an option: a path of its own, or relative to the model; `auto` looks beside and above the model."""
    if given == "none":
        return None
    if given != "auto":
        found = next((place for place in (model / given, Path(given)) if place.is_dir()), None)
        if found is None:
            raise SourceError(f"{model / given}: no such folder: give one that is there, or auto")
        return found
    above = [model, *model.absolute().parents[:PARENTS]]
    return next((place / name for place in above for name in usual if (place / name).is_dir()), None)


def find_database(model: Path) -> Path | None:
    """The database beside or above the model."""
    above = [model, *model.absolute().parents[:PARENTS]]
    return next((place / "database.db" for place in above if (place / "database.db").is_file()), None)


def load_model(folder: Path, tracks: bool) -> Model:
    """The model of a folder, checked; images in natural order of their names (2 before 10).

    Without `tracks` observations and points are not read. Raises `SourceError` with file and record.
    """
    ending = model_ending(folder)
    read = colmap_text if ending == ".txt" else colmap_binary
    paths = [folder / f"{name}{ending}" for name in ("cameras", "images", "points3D")]
    has_points = tracks and paths[2].is_file()
    cameras = read.read_cameras(paths[0])
    images = sorted(read.read_images(paths[1], has_points), key=lambda image: natural(image.name))
    points = read.read_points(paths[2]) if has_points else no_points()
    rigs, notes = rig_files(folder, ending or ".bin"), list[str]()
    if rigs:
        images = posed_by_rigs(images, rigs, notes)
    files = (*(paths if has_points else paths[:2]), *rigs)
    model = Model(cameras, images, points, files, tuple(notes))
    check_model(model, folder)
    return model


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """A sort key that takes digits for numbers."""
    parts = (part for part in _DIGITS.split(name) if part)
    return tuple((0, int(part[:18]), part) if part.isascii() and part.isdecimal() else (1, 0, part) for part in parts)


def parent_of(name: str) -> str:
    """The folder part of an image's name: cameras of a rig have one each."""
    return os.path.dirname(name)


def find_models(path: Path) -> list[Path]:
    """The folders of all models of one scene: the path itself, or `0`, `1`, … in it or in its `sparse`."""
    if model_ending(path):
        return [path]
    for place in (path, path / "sparse"):
        numbered = sorted((folder for folder in _folders(place) if folder.name.isdecimal()), key=lambda f: int(f.name))
        found = [folder for folder in numbered if model_ending(folder)]
        if found:
            return found
    single = find_model(path)
    return [single] if single else []


def largest_model(folders: Sequence[Path]) -> tuple[Path, str]:
    """The model with most images, and a line that names all of them, empty for one alone. Raises `SourceError`."""
    if len(folders) == 1:
        return folders[0], ""
    counts = [_image_count(folder) for folder in folders]
    named = ", ".join(f"{folder.name} ({count} images)" for folder, count in zip(folders, counts, strict=True))
    return folders[counts.index(max(counts))], f"{len(folders)} models in {folders[0].parent}: {named}"


def _image_count(folder: Path) -> int:
    ending = model_ending(folder)
    read = colmap_text if ending == ".txt" else colmap_binary
    return len(read.read_images(folder / f"images{ending}", False))


def _folders(path: Path) -> list[Path]:
    return [entry for entry in path.iterdir() if entry.is_dir()] if path.is_dir() else []

"""Where the parts of a COLMAP project lie: the model, its images, its depth, its database."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from hodge_adapters.colmap.check import image_count
from hodge_adapters.json_files import read_json
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types.text import counted

MODEL_PLACES = ("", "sparse", "sparse/0", "0", "colmap/sparse/0", "colmap", "dense/sparse", "dense/0/sparse")
PARENTS = 3
"""Folders above a model in which what belongs to it is looked for: `project/sparse/0` has it in `project`, and a folder
more is left for a model that was put deeper."""
LOOKED_AT, NAMED = 60, 3
"""Models below a folder without one that are looked at, of each depth, and told."""
IMAGE_FOLDERS = ("images", "image", "rgb", "color")
ENDINGS = (".bin", ".txt")
MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")


def find_model(path: Path) -> Path | None:
    """The folder with the cameras and images of a model: the path itself, or its usual places below."""
    return next((path / place for place in MODEL_PLACES if model_ending(path / place)), None)


def part_of_model(path: Path) -> str:
    """What to give instead of a file of COLMAP's, or of a model that lacks one; empty for any other."""
    if path.suffix == ".db" and path.is_file():
        return "a database of COLMAP's has matches, no poses: give the folder of a model, with --database for this one"
    if path.stem in MODEL_FILES and path.suffix in ENDINGS and model_ending(path.parent):
        return f"one file of a COLMAP model: give its folder {path.parent}"
    return next(filter(None, (_lacking(path / place) for place in MODEL_PLACES)), "")


def _lacking(folder: Path) -> str:
    """What a folder with points and either cameras or images lacks to be a model; empty for any other."""
    for ending in ENDINGS:
        there = {name: (folder / f"{name}{ending}").is_file() for name in ("cameras", "images", "points3D")}
        if there["points3D"] and there["cameras"] != there["images"]:
            (name,) = (name for name, is_there in there.items() if not is_there)
            return f"a COLMAP model without {folder / name}{ending}: copy that file too"
    return ""


def no_model(path: Path) -> SourceError:
    """The error for a path without a model: what to give instead where a part of one is named, or one lies below."""
    if not path.exists():
        return SourceError(f"{path}: no such file or folder")
    advice = part_of_model(path) or "no COLMAP model: give the folder with cameras.bin and images.bin, or .txt"
    places = ("*", "*/*", "*/*/*") if path.is_dir() else ()
    below = (found for place in places for found in islice(path.glob(f"{place}/cameras.*"), LOOKED_AT))
    models = [str(folder) for folder in dict.fromkeys(found.parent for found in below) if model_ending(folder)]
    if models:
        more = "" if len(models) <= NAMED else " and others"
        given = ", ".join(sorted(models)[:NAMED])
        return SourceError(f"{path}: no COLMAP model itself, but holds some below: give {given}{more}")
    return SourceError(f"{path}: {advice}")


def model_ending(folder: Path) -> str | None:
    """`.bin` or `.txt` where the folder holds a model; COLMAP itself prefers the binary one."""
    return next(iter(_endings(folder)), None)


def unread_text(folder: Path) -> tuple[str, ...]:
    """A note where a model lies there as text as well, which may be another one."""
    return ("the binary model is read, not the text files beside it",) if len(_endings(folder)) > 1 else ()


def _endings(folder: Path) -> list[str]:
    names = "cameras", "images"
    return [ending for ending in ENDINGS if all((folder / f"{name}{ending}").is_file() for name in names)]


def find_folder(model: Path, given: str, usual: Sequence[str]) -> Path | None:
    """The folder of an option: a path of its own, or relative to the model; `auto` looks beside and above the model."""
    if given == "none":
        return None
    if given != "auto":
        found = next((place for place in (model / given, Path(given)) if place.is_dir()), None)
        if found is None:
            raise SourceError(f"{model / given}: no such folder: give one that is there, or auto")
        return found
    return next((place / name for place in _above(model) for name in usual if (place / name).is_dir()), None)


def find_database(model: Path) -> Path | None:
    """The database beside or above the model, or above the one that it was refined from."""
    places = [*_above(model), *_above_original(model)]
    return next((place / "database.db" for place in places if (place / "database.db").is_file()), None)


def find_images(model: Path, given: str) -> Path | None:
    """The folder of the colour images: of a refined model that of the model that it was refined from."""
    found = find_folder(model, given, IMAGE_FOLDERS)
    places = _above_original(model) if found is None and given == "auto" else []
    return found or next((place / name for place in places for name in IMAGE_FOLDERS if (place / name).is_dir()), None)


def by_report(model: Path, found: Path | None) -> list[str]:
    """A note where a folder or a database lies not beside or above a model but where its `report.json` points."""
    if found is None or found.parent in _above(model):
        return []
    return [f"{found}: taken, since the report.json of this model says that it was refined from one near there"]


def _above(model: Path) -> list[Path]:
    return [model, *model.absolute().parents[:PARENTS]]


def _above_original(model: Path) -> list[Path]:
    """The places beside and above the model that this one was refined from, as the report of its folder names it."""
    folder = model.absolute().parent.parent
    if not (folder / "refinement").is_dir():
        return []
    try:
        path = Path(read_json(folder / "report.json")["source"]["path"])
    except (SourceError, KeyError, TypeError):  # the model is whole without its report
        return []
    return _above(path)


def find_models(path: Path) -> list[Path]:
    """The folders of all models of one scene: the path itself, or `0`, `1`, … in it or in its `sparse`."""
    if model_ending(path):
        return [path]
    for place in (path, path / "sparse"):
        below = [entry for entry in place.iterdir() if entry.name.isdecimal()] if place.is_dir() else []
        found = [folder for folder in sorted(below, key=lambda folder: int(folder.name)) if model_ending(folder)]
        if found:
            return found
    single = find_model(path)
    return [single] if single else []


def incomplete_models(path: Path, models: Sequence[Path]) -> list[str]:
    """What each other numbered folder beside these models, which lie below a path, lacks to be one of them."""
    if path in models or not models[0].name.isdecimal():
        return []
    beside = sorted(entry for entry in models[0].parent.iterdir() if entry.name.isdecimal() and entry not in models)
    return list(filter(None, map(_lacking, beside)))


def largest_model(folders: Sequence[Path]) -> tuple[Path, str]:
    """The model with most images, and a line that names all of them, empty for one alone. Raises `SourceError`."""
    if len(folders) == 1:
        return folders[0], ""
    counts = [image_count(folder / f"images{model_ending(folder)}") for folder in folders]
    named = ", ".join(
        f"{folder.name} ({counted(count, 'image')})" for folder, count in zip(folders, counts, strict=True)
    )
    return folders[counts.index(max(counts))], f"{len(folders)} models in {folders[0].parent}: {named}"

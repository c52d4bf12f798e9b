"""Redwood's layout, as Open3D's reconstruction system keeps it: `depth/`, `image/` or `color/`, `trajectory.log`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hodge_adapters.text_rows import listed, names_in
from hodge_adapters.tum.image_lists import StampedImages
from hodge_pipeline.errors import SourceError

COLOUR_FOLDERS = ("image", "images", "color", "rgb")
LOG_FILES = ("trajectory.log", "scene/trajectory.log", "test_scene/trajectory.log")
TUM_FILES = ("depth.txt", "rgb.txt", "groundtruth.txt")
_NUMBER = re.compile(r"\D*(\d+)")
_IMAGES = (".png", ".jpg", ".jpeg")


def is_redwood(folder: Path) -> bool:
    """Whether the folder has a depth and a colour folder, and nothing of a TUM sequence that lost its lists."""
    if any((folder / name).is_file() for name in TUM_FILES):
        return False
    has_colour = any((folder / name).is_dir() for name in COLOUR_FOLDERS)
    return has_colour and (folder / "depth").is_dir()


def list_images(folder: Path, notes: list[str]) -> StampedImages:
    """The images of a folder by the number that their names start with, their stamp; depth without colour is noted."""
    depth = _by_number(folder / "depth", notes)
    if not depth:
        raise SourceError(
            f"{folder / 'depth'}: no numbered PNG in it: give the folder with depth/ and image/ or color/"
        )
    colour_folder = next((folder / name for name in COLOUR_FOLDERS if (folder / name).is_dir()), None)
    colour = _by_number(colour_folder, notes) if colour_folder else {}
    numbers = sorted(depth)
    alone = [number for number in numbers if number not in colour]
    if alone:
        notes.append(f"{len(alone)} frames have no colour image: {listed(alone)}")
    none_s, one_run = np.zeros(len(numbers)), np.zeros(len(numbers), np.int64)
    stamps_s = np.array(numbers, float)
    return StampedImages(stamps_s, [depth[n] for n in numbers], [colour.get(n) for n in numbers], none_s, (), one_run)


def find_log(folder: Path) -> Path | None:
    """The trajectory of a folder, by its usual places."""
    return next((folder / name for name in LOG_FILES if (folder / name).is_file()), None)


def _by_number(folder: Path, notes: list[str]) -> dict[int, Path]:
    names = [name for name in names_in(folder) if name.lower().endswith(_IMAGES)]
    found: dict[int, Path] = {}
    skipped: list[str] = []
    for name in names:
        match = _NUMBER.match(name)
        if match is None or int(match[1]) in found:
            skipped.append(name)
        else:
            found[int(match[1])] = folder / name
    if skipped:
        notes.append(f"{folder.name}: {len(skipped)} images without a number of their own left out: {listed(skipped)}")
    return found

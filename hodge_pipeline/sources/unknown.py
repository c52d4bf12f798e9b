"""What to say of a path that no reader knows: what it nearly is, or which of the paths in it are known."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from hodge_pipeline import registry
from hodge_pipeline.errors import HodgeError, SourceError
from hodge_pipeline.stages import FrameReader
from hodge_pipeline.types import Source
from hodge_pipeline.types.input_files import open_input

LOOKED_AT = 60
"""Paths inside a folder that the readers sniff at, at most: some hundredths of a second."""
IMAGES, AS_PNG = "images are read as PNG or JPEG", "to PNG, depth with all 16 bits"
DEPTH, NAMED = 3, 3
"""Levels of folders that are looked through for something readable, and how many finds are told."""
UNREAD_IMAGES = (".pgm", ".ppm", ".tif", ".tiff", ".bmp", ".exr", ".webp")
READ_IMAGES = (".png", ".jpg", ".jpeg")
UNKNOWN_LAYOUT = (
    "images in a layout that no reader knows: put depth (PNG of 16 bits, millimetres) in depth/ and colour in color/, "
    "both named by one number, 00000.png, …, and `fx fy cx cy` in intrinsics.txt beside them; photographs without "
    "depth need a COLMAP model"
)
PACKED = (".zip", ".7z", ".rar", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".zst")


def unknown(path: Path) -> SourceError:
    """The error for a path that no reader knows, in one line that says what to do."""
    readers = {name: registry.load("readers", name)() for name in _loadable()}
    advice = [sniff.advice for sniff in (reader.sniff(path) for reader in readers.values()) if sniff.advice]
    inside = [] if advice else _inside(path, readers)
    if advice:
        return SourceError(f"{path}: {advice[0]}")
    if inside:
        named = ", ".join(f"{found} ({name})" for found, name in inside[:NAMED])
        more = "" if len(inside) <= NAMED else " and others"
        return SourceError(f"{path}: is no source itself, but holds some: give {named}{more}")
    if problem := _problem(path):
        return SourceError(f"{path}: {problem}")
    remedy = "name one with --reader, in a run with --set source.reader="
    return SourceError(f"{path}: no reader knows this format (readers: {', '.join(readers)}): {remedy}")


def _problem(path: Path) -> str:
    """What is wrong with a path that is empty, packed or unreadable, or has images of another format; else empty."""
    if path.is_file() and not path.stat().st_size:
        return "the file is empty: record or copy it again"
    if path.is_file() and path.suffix.lower() in PACKED:
        return "packed: unpack it first"
    if path.is_file() and path.suffix.lower() in UNREAD_IMAGES:
        return f"{IMAGES}: convert {path.name} {AS_PNG}"
    if not path.is_dir():
        try:
            open_input(path).close()
        except OSError as error:
            return error.strerror or ""
        return ""
    children = _children(path)
    packed = [child.name for child in children if child.suffix.lower() in PACKED]
    if not children:
        return "the folder is empty"
    if packed:
        return f"holds packed files: unpack {packed[0]} first"
    files = [*children, *(file for child in children if child.is_dir() for file in _children(child))]
    image = next((file for file in files if file.suffix.lower() in UNREAD_IMAGES), None)
    if image is not None:
        return f"{IMAGES}: convert {image.relative_to(path)} and its like {AS_PNG}"
    return UNKNOWN_LAYOUT if any(file.suffix.lower() in READ_IMAGES for file in files) else ""


def without_frames(source: Source) -> str:
    """What a source without frames, of which no run can be made, is good for."""
    if source.graph is not None:
        return "a graph of measured edges, which needs no frames: give it to hodge solve or hodge diagnose"
    if source.positions is not None:
        return "known positions alone: give them to a run of the frames they belong to, --set positions.path=FILE"
    return "poses alone: with the frames they belong to hodge refine trajectory makes them better"


def _loadable() -> Iterator[str]:
    for name in registry.names("readers"):
        try:
            registry.load("readers", name)()
        except HodgeError:
            continue
        yield name


def _inside(folder: Path, readers: dict[str, FrameReader]) -> list[tuple[Path, str]]:
    """Paths in the folder that a reader knows, with its name; what lies in one of them is its own."""
    found: list[tuple[Path, str]] = []
    level, left = [folder] if folder.is_dir() else [], LOOKED_AT
    for _ in range(DEPTH):
        deeper = []
        for path in (child for parent in level for child in _children(parent)):
            if left == 0 or len(found) > NAMED:
                return found
            left -= 1
            sniffs = [(reader.sniff(path).confidence, name) for name, reader in readers.items()]
            confidence, name = max(sniffs)
            if confidence > 0:
                found.append((path, name))
            elif path.is_dir() and not path.is_symlink():
                deeper.append(path)
        level = deeper
    return found


def _children(folder: Path) -> list[Path]:
    """Folders first, each by name; none where the folder may not be read."""
    try:
        names = sorted(os.listdir(folder))
    except OSError:
        return []
    return sorted((folder / name for name in names if not name.startswith(".")), key=lambda path: not path.is_dir())

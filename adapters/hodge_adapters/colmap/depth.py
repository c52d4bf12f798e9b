"""Where depth lies beside a COLMAP model, and COLMAP's own depth maps: `width&height&channels&`, then float32."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hodge_adapters.images.headers import MAX_PIXELS
from hodge_adapters.text_rows import inside, reading
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats32
from hodge_pipeline.types.input_files import open_input

MAP_ENDINGS = (".geometric.bin", ".photometric.bin")
_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&(\d{1,3})&")
_DEPTH_NAMES = (("color", "depth"), ("colour", "depth"), ("rgb", "depth"), ("image", "depth"))


def depth_map_size(path: Path) -> tuple[int, int]:
    """(width, height) of a depth map, from its header alone."""
    return _parse_header(path)[0]


def read_depth_map(path: Path, size: tuple[int, int]) -> Floats32:
    """Depth (H, W) in the model's units, 0 where there is none. Raises `SourceError` for a damaged or other size."""
    found, start = _parse_header(path)
    if found != size:
        raise SourceError(
            f"{path}: the depth map is {found[0]}x{found[1]}, the others {size[0]}x{size[1]}: make it again"
        )
    count = found[0] * found[1]
    with open_input(path) as file:
        contents = file.read(start + 4 * count + 1)
    if len(contents) != start + 4 * count:
        raise SourceError(f"{path}: holds not the bytes for {count} pixels: copy it again")
    depth = np.frombuffer(contents, "<f4", count, offset=start).reshape(found[1], found[0])
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0)).astype(np.float32)


def stereo_depth(folder: Path, name: str) -> Path | None:
    """COLMAP's depth map of an image, the geometrically consistent one first."""
    paths = (inside(folder, name + ending) for ending in MAP_ENDINGS)
    return next((path for path in paths if path and path.is_file()), None)


def sensor_depth(folder: Path, name: str, colour: Path | None) -> Path | None:
    """The depth image of a colour image: of the same name as PNG, or with `depth` for `color` in it."""
    pure = Path(name)
    if not pure.name:
        return None
    own = inside(colour, name) if colour else None
    names = [pure.with_suffix(".png"), Path(f"{name}.png")]
    for word, depth in _DEPTH_NAMES:
        if word in pure.name:
            names.append(pure.with_name(pure.name.replace(word, depth)).with_suffix(".png"))
    for candidate in [*names, *(Path(path.name) for path in names)]:
        path = inside(folder, str(candidate))
        if path and path != own and path.is_file():
            return path
    return None


def _parse_header(path: Path) -> tuple[tuple[int, int], int]:
    with reading(path), open_input(path) as file:
        match = _HEADER.match(file.read(32))
    if match is None:
        raise SourceError(f"{path}: no depth map of COLMAP: it begins with no `width&height&1&`; make it again")
    width, height, channels = map(int, match.groups())
    if channels != 1 or not 0 < width * height <= MAX_PIXELS:
        raise SourceError(f"{path}: its header says {width}x{height}, {channels} channels: it is damaged")
    return (width, height), match.end()

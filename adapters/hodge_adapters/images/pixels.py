"""Depth and colour images from untrusted files: size and damage are checked before decoding.

All functions are module-level, so that partials of them pickle by reference and a worker process can call them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hodge_adapters.images.headers import is_complete, parse_header
from hodge_adapters.images.png import decoded
from hodge_adapters.text_rows import reading
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, EncodedImage, Floats32
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.input_files import open_input, read_input

HEADER_BYTES = 1 << 16
"""Where an image's size is looked for: room for the thumbnail that may precede it."""
SAME_SHAPE = 0.01
"""Relative difference of equal aspect ratios: ScanNet's colour, 1296x968, and depth, 640x480, differ by 0.4 %."""
SAMPLES = 5
"""Images by whose headers the common size is told."""
MAX_IMAGE_BYTES = 1 << 29
"""Twice what 64 megapixels of 16-bit depth and their rows' heads take uncompressed."""


def read_depth(
    path: Path,
    *,
    units_per_metre: float,
    no_depth: tuple[int, ...] = (0,),
    size: tuple[int, int] | None = None,
) -> Floats32:
    """Depth (H, W) in float32 metres, 0 where the file holds one of the `no_depth` values.

    `size` is the camera's (width, height). Raises `SourceError` for a missing or damaged file, for one that is not
    single-channel 16 bit, and for one of another size.
    """
    stored = _decoded(path, size, cv2.IMREAD_UNCHANGED)
    if stored.ndim != 2 or stored.dtype != np.uint16:
        kind = f"{stored.dtype} with {1 if stored.ndim == 2 else stored.shape[2]} channel(s)"
        raise SourceError(
            f"{path}: depth must be uint16 with one channel, this is {kind}: a colour image, or a picture of depth? "
            "Export depth as PNG of 16 bits"
        )
    depth_m: Floats32 = stored.astype(np.float32)
    depth_m *= np.float32(1.0 / units_per_metre)
    for value in no_depth:
        if value:
            depth_m[stored == value] = 0.0
    return depth_m


def read_colour(path: Path, *, size: tuple[int, int] | None = None) -> Bytes:
    """Colour (H, W, 3) uint8 RGB, resized to the camera's `size` where it has the same aspect ratio.

    Raises `SourceError` as `read_depth` does.
    """
    stored = _decoded(path, size, cv2.IMREAD_COLOR_RGB, any_scale=True)
    if size is not None and stored.shape[1::-1] != size:
        stored = cv2.resize(stored, size, interpolation=cv2.INTER_AREA)
    return np.asarray(stored, np.uint8)


def resampled_colour(image: Bytes, columns: Floats32, rows: Floats32) -> Bytes:
    """The colour (H, W, 3) at these columns and rows (H, W) of an image, linearly interpolated, black outside it.

    OpenCV interpolates four channels in half the time of three, to the same values.
    """
    four = cv2.cvtColor(image, cv2.COLOR_RGB2RGBA)
    return np.asarray(cv2.cvtColor(cv2.remap(four, columns, rows, cv2.INTER_LINEAR), cv2.COLOR_RGBA2RGB), np.uint8)


def _decoded(path: Path, size: tuple[int, int] | None, how: int, any_scale: bool = False) -> Any:
    stored = decoded(read_whole_image(path, size, any_scale), how)
    if stored is None:
        raise SourceError(f"{path}: the image cannot be decoded: copy it again from its source")
    return stored


def encoded(path: Path, *, units_per_metre: float | None = None) -> EncodedImage:
    """The file's bytes untouched, after the same checks as before decoding; of depth with its units."""
    contents = read_whole_image(path)
    return EncodedImage(contents, parse_header(contents, path).media_type, units_per_metre)


def read_whole_image(path: Path, size: tuple[int, int] | None = None, any_scale: bool = False) -> bytes:
    """The bytes of a PNG or JPEG file that is complete, of this (width, height), or of its shape with `any_scale`, and
    not absurdly large.
    """
    with reading(path):
        contents = read_input(path, MAX_IMAGE_BYTES)
    header = parse_header(contents, path)
    found = header.width, header.height
    if size is not None and found != size and not (any_scale and same_shape(found, size)):
        registered = "record depth registered (aligned) to colour, or " if any_scale else ""
        raise SourceError(
            f"{path}: the image is {header.width}x{header.height}, the camera {size[0]}x{size[1]}: "
            f"{registered}give the intrinsics of this image, or leave the frame out"
        )
    if not is_complete(contents, header):
        raise SourceError(f"{path}: the image is truncated or damaged: copy it again from its source")
    return contents


def same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether images of these (width, height) have the same aspect ratio, to within `SAME_SHAPE`; no side is 0."""
    across, down = one[0] * other[1], one[1] * other[0]
    return across > 0 and abs(across - down) <= SAME_SHAPE * down


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone; raises `SourceError` where there is none."""
    with reading(path), open_input(path) as file:
        header = parse_header(file.read(HEADER_BYTES), path)
    return header.width, header.height


def colour_size(paths: Sequence[Path | None], size: tuple[int, int], notes: list[str]) -> tuple[int, int]:
    """The common (width, height) of the colour images, with a note where it is not `size`, that of depth; `size` where
    none can be read.
    """
    try:
        found = common_size([path for path in paths if path])
    except SourceError:
        return size
    if found != size and same_shape(found, size):
        told = f"{found[0]}x{found[1]} are brought to the {size[0]}x{size[1]} of depth"
        notes.append(f"colour images of {told}, as if registered to it")
    return found


def common_size(paths: Sequence[Path]) -> tuple[int, int]:
    """The (width, height) that most of a few evenly spaced images have, so that one odd image does not set it."""
    sizes: Counter[tuple[int, int]] = Counter()
    problem: SourceError | None = None
    for row in evenly(len(paths), SAMPLES):
        try:
            sizes[image_size(paths[row])] += 1
        except SourceError as error:
            problem = error
    if not sizes:
        raise problem or SourceError("no image to take the size from: give a folder with frames")
    return sizes.most_common(1)[0][0]

"""Depth and colour images in messages: raw, PNG, JPEG and `compressedDepth`, as ROS 2 and Foxglove have them.

Sizes that a message says are held against the bytes it has before anything is allocated. All `read_*` functions are
module-level, so that partials of them pickle by reference.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from hodge_adapters.images.headers import MAX_PIXELS, is_complete, parse_header
from hodge_adapters.mcap.fields import Message, Payload, payload_start, text, whole
from hodge_adapters.mcap.records import Malformed
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bytes, EncodedImage, Floats32

HEAD_BYTES = 1 << 16
"""Of an encoded image, this much is looked at for its size: room for the thumbnail that may precede it."""

DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
Pixels: TypeAlias = NDArray[np.uint8 | np.uint16 | np.float32]

_DEPTH_HEADER = struct.Struct("<iff")
_RVL_SIZE = struct.Struct("<II")
_PNG = b"\x89PNG\r\n\x1a\n"
UNITS_PER_METRE = 1000.0
"""Of 16-bit depth in ROS (REP 118)."""
_RGB = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}

_MAX_NIBBLES = 11
"""Three bits each: 33, the fewest that hold a number of 32."""


@dataclass(frozen=True)
class ImageLayout:
    """How the bytes of an image are to be read.

    `coding` is raw, png, jpeg or rvl; `encoding` the ROS name of a pixel; `step` the bytes of a row of a raw image;
    `skip` the bytes in front of a coded one; `quantisation` the (A, B) of inverse depth `A / (q - B)` in a coded 32FC1.
    """

    coding: str
    encoding: str
    width: int
    height: int
    step: int = 0
    big_endian: bool = False
    skip: int = 0
    quantisation: tuple[float, float] | None = None

    @property
    def is_depth(self) -> bool:
        """Whether a pixel is a depth."""
        return self.encoding in DEPTH_ENCODINGS

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height


def raw_layout(message: Message, length: int) -> ImageLayout:
    """The layout of an Image or RawImage whose data has `length` bytes; raises `Malformed` where it does not fit."""
    encoding, width, height = text(message, "encoding"), whole(message, "width"), whole(message, "height")
    if encoding not in _RGB and encoding not in DEPTH_ENCODINGS:
        raise Malformed(f"pixels of the kind {encoding!r}, which is neither depth nor 8-bit colour")
    pixel_bytes = _RGB[encoding][0] if encoding in _RGB else 4 if encoding == "32FC1" else 2
    step = whole(message, "step") or width * pixel_bytes
    _check_size(width, height)
    if not width * pixel_bytes <= step <= length or step * (height - 1) + width * pixel_bytes > length:
        raise Malformed("an image with fewer bytes than its size needs")
    return ImageLayout("raw", encoding, width, height, step, bool(message.get("is_bigendian", False)))


def compressed_layout(message: Message, contents: bytes) -> ImageLayout:
    """The layout of a CompressedImage message of these bytes; raises `Malformed`."""
    declared = text(message, "format")
    head = payload_start(message, contents, HEAD_BYTES)
    if "compressedDepth" in declared or head[_DEPTH_HEADER.size :].startswith(_PNG):
        return _compressed_depth_layout(declared, head)
    return _coded_layout(head, skip=0)


def read_depth(
    payload: Payload,
    layout: ImageLayout,
    *,
    units_per_metre: float | None = None,
    no_depth: tuple[int, ...] = (0,),
) -> Floats32:
    """Depth (H, W) in float32 metres, 0 where the image holds one of the `no_depth` values, NaN, or nothing positive.

    `units_per_metre`: None: 1000 of 16-bit depth, 1 of floats, also of those that are coded in 16 bits.

    Raises `SourceError` where the bytes are not what the layout says.
    """
    stored = _decoded(payload, layout)
    depth_m: Floats32 = stored.astype(np.float32)
    is_whole = stored.dtype == np.uint16 and layout.quantisation is None
    if layout.quantisation is not None:
        a, b = layout.quantisation
        with np.errstate(divide="ignore", invalid="ignore"):
            depth_m = np.float32(a) / (depth_m - np.float32(b))
        depth_m[stored == 0] = 0.0
    units = units_per_metre or (UNITS_PER_METRE if is_whole else 1.0)
    if units != 1.0:
        depth_m *= np.float32(1.0 / units)
    for value in no_depth if is_whole else ():
        depth_m[stored == value] = 0.0
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0.0
    return depth_m


def read_colour(payload: Payload, layout: ImageLayout) -> Bytes:
    """Colour (H, W, 3) uint8 RGB; raises `SourceError`."""
    stored = _decoded(payload, layout)
    code = _RGB[layout.encoding][1] if layout.coding == "raw" else cv2.COLOR_BGR2RGB
    return np.ascontiguousarray(stored if code is None else cv2.cvtColor(stored, code), np.uint8)


def encoded_image(payload: Payload, layout: ImageLayout, units_per_metre: float | None = None) -> EncodedImage:
    """The PNG or JPEG in a message untouched, after the checks that come before decoding."""
    return EncodedImage(_coded_bytes(payload, layout), f"image/{layout.coding}", units_per_metre)


def _check_size(width: int, height: int) -> None:
    if width <= 0 or height <= 0 or width * height > MAX_PIXELS:
        raise Malformed("an image with no pixels, or with more than 64 million")


def _compressed_depth_layout(declared: str, head: bytes) -> ImageLayout:
    if len(head) < _DEPTH_HEADER.size + _RVL_SIZE.size:
        raise Malformed("an image with fewer bytes than its header needs")
    _, a, b = _DEPTH_HEADER.unpack_from(head)
    is_inverse = declared.startswith("32FC1")
    if is_inverse and not (math.isfinite(a) and math.isfinite(b) and a > 0):
        raise Malformed("an inverse depth image without its two parameters")
    quantisation = (a, b) if is_inverse else None
    if head[_DEPTH_HEADER.size :].startswith(_PNG):
        coded = _coded_layout(head[_DEPTH_HEADER.size :], _DEPTH_HEADER.size)
        if coded.encoding != "16UC1":
            raise Malformed("a depth image that is not 16 bit")
        return ImageLayout("png", "16UC1", *coded.size, skip=coded.skip, quantisation=quantisation)
    if "rvl" not in declared.lower():
        raise Malformed("a compressedDepth image that is neither PNG nor RVL")
    width, height = _RVL_SIZE.unpack_from(head, _DEPTH_HEADER.size)
    _check_size(width, height)
    skip = _DEPTH_HEADER.size + _RVL_SIZE.size
    return ImageLayout("rvl", "16UC1", width, height, skip=skip, quantisation=quantisation)


def _coded_layout(head: bytes, skip: int) -> ImageLayout:
    try:
        header = parse_header(head, Path())
    except SourceError as error:
        raise Malformed("an image that is neither PNG nor JPEG, or has no header") from error
    # Bit depth and colour type follow the size in a PNG: 16 and 0 are 16-bit grey, which only depth cameras give.
    is_depth = header.media_type == "image/png" and head[24:26] == b"\x10\x00"
    coding = header.media_type.removeprefix("image/")
    return ImageLayout(coding, "16UC1" if is_depth else "rgb8", header.width, header.height, skip=skip)


def _decoded(payload: Payload, layout: ImageLayout) -> Pixels:
    if layout.coding == "raw":
        return _raw_pixels(payload, layout)
    if layout.coding == "rvl":
        try:
            contents = payload.read()[layout.skip :]
            return decode_rvl(contents, layout.width * layout.height).reshape(layout.height, layout.width)
        except Malformed as error:
            raise payload.error(str(error)) from error
    flags = cv2.IMREAD_UNCHANGED if layout.is_depth else cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    stored = cv2.imdecode(np.frombuffer(_coded_bytes(payload, layout), np.uint8), flags)
    if stored is None or stored.shape[:2] != (layout.height, layout.width):
        raise payload.error("the image cannot be decoded")
    if layout.is_depth and (stored.ndim != 2 or stored.dtype != np.uint16):
        raise payload.error("a depth image that is not 16 bit")
    return np.asarray(stored)


def _raw_pixels(payload: Payload, layout: ImageLayout) -> Pixels:
    """Pixels (H, W) or (H, W, C), a view of the bytes read; rows may be padded."""
    order = ">" if layout.big_endian else "<"
    kind = {"32FC1": "f4", "16UC1": "u2", "mono16": "u2"}.get(layout.encoding, "u1")
    dtype = np.dtype(kind if kind == "u1" else order + kind)
    channels = 1 if layout.is_depth else _RGB[layout.encoding][0]
    row_bytes = layout.width * channels * dtype.itemsize
    contents = payload.read()
    if len(contents) < layout.step * (layout.height - 1) + row_bytes:
        raise payload.error("an image with fewer bytes than its size needs")
    strides = (layout.step, channels * dtype.itemsize, dtype.itemsize)
    pixels = np.ndarray((layout.height, layout.width, channels), dtype, contents, 0, strides)
    native: Pixels = pixels.astype(dtype.newbyteorder("="), copy=False)
    return native[..., 0] if channels == 1 else native


def _coded_bytes(payload: Payload, layout: ImageLayout) -> bytes:
    contents = payload.read()[layout.skip :]
    try:
        header = parse_header(contents, payload.path)
    except SourceError as error:
        raise payload.error("an image that is neither PNG nor JPEG, or has no header") from error
    if (header.width, header.height) != layout.size or not is_complete(contents, header):
        raise payload.error("the image is truncated or damaged")
    return contents


def decode_rvl(data: bytes, pixels: int) -> NDArray[np.uint16]:
    """The pixels (pixels,) of an RVL code (Wilson, "Fast lossless depth image compression", ISS 2017).

    A stream of nibbles, the highest of each little-endian 32-bit word first. A number is as many nibbles as it needs,
    three bits each, the lowest first, the fourth bit set on all but the last. Numbers come as: zeros, non-zeros, then
    the differences of that many non-zero pixels, again and again. Raises `Malformed` for more or fewer pixels.
    """
    numbers = _numbers(data)
    is_delta, zeros_before = _runs(numbers, pixels)
    zigzag = numbers[is_delta]
    values = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
    if len(values) and not 0 <= values.min() <= values.max() <= 0xFFFF:
        raise Malformed("an RVL code with depths that are not 16 bit")
    out = np.zeros(pixels, np.uint16)
    out[np.arange(len(values)) + zeros_before] = values
    return out


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Every number of the stream, whatever it means."""
    words = np.frombuffer(data[: len(data) // 4 * 4], np.uint8).reshape(-1, 4)[:, ::-1].reshape(-1)
    nibbles = np.stack([words >> 4, words & 15], axis=-1).reshape(-1)
    last = np.flatnonzero(nibbles < 8)
    if not len(last):
        return np.zeros(0, np.int64)
    first = np.concatenate([[0], last[:-1] + 1])
    lengths = last - first + 1
    if lengths.max() > _MAX_NIBBLES:
        raise Malformed("an RVL code with a number of more than 32 bits")
    bits = nibbles & 7
    numbers: NDArray[np.int64] = bits[first].astype(np.int64)
    # The n-th nibble of all numbers at once, of those that have one.
    for nth in range(1, int(lengths.max())):
        longer = np.flatnonzero(lengths > nth)
        numbers[longer] |= bits[first[longer] + nth].astype(np.int64) << (3 * nth)
    return numbers


def _runs(numbers: NDArray[np.int64], pixels: int) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which numbers are differences, and how many zero pixels come before each of those."""
    is_delta = np.zeros(len(numbers), bool)
    counts: list[int] = []
    zeros: list[int] = []
    at, done, total_zeros = 0, 0, 0
    while done < pixels:
        if at + 2 > len(numbers):
            raise Malformed("an RVL code that breaks off")
        zero, nonzero = int(numbers[at]), int(numbers[at + 1])
        at += 2
        done += zero + nonzero
        total_zeros += zero
        if done > pixels or at + nonzero > len(numbers):
            raise Malformed("an RVL code that breaks off or goes past the image")
        is_delta[at : at + nonzero] = True
        counts.append(nonzero)
        zeros.append(total_zeros)
        at += nonzero
    return is_delta, np.repeat(np.array(zeros, np.int64), np.array(counts, np.int64))

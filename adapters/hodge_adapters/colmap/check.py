"""Sizes and counts of a COLMAP model's files: pycolmap believes every count, and a wrong one keeps it busy for ever.

Of a file whose records fill it to the last byte or word, whatever they hold, pycolmap makes a model or an exception.
"""

from __future__ import annotations

import codecs
import mmap
import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.text_rows import read_text, reading, to_floats
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types.input_files import beginning, open_input

REMEDY = "write the model again with `colmap model_converter`"
AS_BINARY = "COLMAP writes {} that are none, and does not read them: give the model as .bin"
MEND = {
    "points3D": AS_BINARY.format("points"), "cameras": "calibrate the camera again",
    "rigs": "calibrate the rig again", "frames": "register the frame again",
}  # fmt: skip
"""What to do with NaN or infinity in a text file, by its stem: a converter does not read them, or writes them again."""
MAX_NAME_BYTES = 4096
"""The longest path that Linux takes."""
MARKS = codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE
_U32, _I32, _U64 = struct.Struct("<I"), struct.Struct("<i"), struct.Struct("<Q")


def check_files(paths: Sequence[Path]) -> None:
    """Raise `SourceError` with file and byte, or line, where one of them ends too early, too late or in mid-record."""
    for path in paths:
        with reading(path):
            if path.suffix == ".txt":
                _check_lines(path)
            else:
                _check_bytes(path)


def check_words(paths: Sequence[Path]) -> None:
    """Raise `SourceError` with file and line of a word in text files that is no number where COLMAP has one."""
    for path in paths:
        if path.stem == "images":
            _check_image_words(path)
            continue
        for line, text in text_lines(path):
            words = text.split()
            if path.stem == "cameras" and words[1] not in _camera_models():
                raise SourceError(f"{path}:{line}: has a camera of the unknown model {words[1][:60]}: {REMEDY}")
            numbers = [word for word in words if word not in _SENSORS and word not in _camera_models()]
            values = to_floats(numbers)
            if values is None:
                raise _fault(path, line, text, "numbers")
            if not np.isfinite(values).all():
                raise _none(path, line, numbers, MEND[path.stem])


def _check_image_words(path: Path) -> None:
    for line, pose, seen in _image_lines(path):
        numbers = pose.split(maxsplit=9)[:9]
        values = to_floats(numbers)
        if values is None:
            raise _fault(path, line, pose, "numbers")
        if not np.isfinite(values).all():
            raise _none(path, line, numbers, "register the image again")
        words = seen.split()
        if words and not np.isfinite(to_floats(words) or np.nan).all():
            raise _none(path, line + 1, words, AS_BINARY.format("features"))


def image_count(path: Path) -> int:
    """How many images the file `images.bin` or `images.txt` says it has. Raises `SourceError`."""
    check_files([path])
    if path.suffix == ".txt":
        return sum(1 for _ in _image_lines(path))
    with open_input(path) as file:
        return int(_U64.unpack(file.read(8))[0])


def names_with_blanks(path: Path) -> dict[int, str]:
    """The whole names of images in `images.txt` by their ids: COLMAP itself reads each up to its first blank."""
    poses = (text.split(maxsplit=9) for _, text, _ in _image_lines(path))
    return {int(float(words[0])): words[9] for words in poses if len(words[9].split()) > 1}


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Each line with its number, without comments and empty ones."""
    for line, raw in enumerate(read_text(path).split("\n"), 1):
        text = raw.strip()
        if text and not text.startswith("#"):
            yield line, text


class _Bytes:
    """Walks a file from front to back; raises `SourceError` with the offset where it ends too early."""

    def __init__(self, path: Path, contents: mmap.mmap | bytes) -> None:
        self.path, self.contents, self.at = path, contents, 0

    def skip(self, size: int) -> None:
        if size > len(self.contents) - self.at:
            raise self.fault("is cut off", self.at)
        self.at += size

    def number(self, layout: struct.Struct) -> int:
        at = self.at
        self.skip(layout.size)
        return int(layout.unpack_from(self.contents, at)[0])

    def count(self, least_bytes: int, layout: struct.Struct = _U64) -> int:
        """The next count of records that have at least so many bytes each."""
        at, count = self.at, self.number(layout)
        if count * least_bytes > len(self.contents) - self.at:
            raise self.fault(f"says {count} records, more than the file has room for", at)
        return count

    def skip_list(self, before: int, record: int) -> None:
        """Past so many bytes, a count, and so many records of this size: in one call, since a model has millions."""
        at = self.at + before
        if at + _U64.size <= len(self.contents):
            end = at + _U64.size + record * _U64.unpack_from(self.contents, at)[0]
            if end <= len(self.contents):
                self.at = end
                return
        self.skip(before)
        self.count(record)

    def name(self) -> None:
        end = self.contents.find(b"\0", self.at, self.at + MAX_NAME_BYTES)
        if end < 0:
            raise self.fault("has a name without end", self.at)
        self.at = end + 1

    def fault(self, what: str, at: int) -> SourceError:
        return SourceError(f"{self.path}: {what}, at byte {at}: copy the file again, or {REMEDY}")


def _check_bytes(path: Path) -> None:
    with open_input(path) as file:
        empty = not os.fstat(file.fileno()).st_size
        contents = b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    walk = _Bytes(path, contents)
    _RECORDS[path.stem](walk)
    if walk.at != len(contents):
        raise walk.fault(f"goes on for {len(contents) - walk.at} bytes after its last record", walk.at)


def _cameras(walk: _Bytes) -> None:
    for _ in range(walk.count(24)):
        walk.skip(4)
        number = walk.number(_I32)
        if number not in _camera_models().values():
            raise walk.fault(f"has a camera of the unknown model {number}", walk.at - 4)
        walk.skip(16 + 8 * len(pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 1, 1, 1).params))


def _images(walk: _Bytes) -> None:
    for _ in range(walk.count(73)):
        walk.skip(64)
        walk.name()
        walk.skip_list(0, 24)


def _points(walk: _Bytes) -> None:
    for _ in range(walk.count(51)):
        walk.skip_list(43, 8)


def _rigs(walk: _Bytes) -> None:
    for _ in range(walk.count(8)):
        walk.skip(4)
        for row in range(walk.count(8, _U32)):
            walk.skip(8)
            if row:  # the first sensor is the rig itself
                walk.skip(1)
                walk.skip(56 if walk.contents[walk.at - 1] else 0)


def _frames(walk: _Bytes) -> None:
    for _ in range(walk.count(68)):
        walk.skip(64)
        walk.skip(16 * walk.count(16, _U32))


_RECORDS: Mapping[str, Callable[[_Bytes], None]] = {
    "cameras": _cameras,
    "images": _images,
    "points3D": _points,
    "rigs": _rigs,
    "frames": _frames,
}
_SENSORS = ("CAMERA", "IMU")


@cache
def _camera_models() -> Mapping[str, int]:
    return {name: int(one) for name, one in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}


def _check_lines(path: Path) -> None:
    if beginning(path, len(codecs.BOM_UTF8)).startswith(MARKS):
        raise SourceError(
            f"{path}:1: begins with a byte-order mark, which COLMAP does not read: save it as UTF-8 without one"
        )
    if path.stem == "images":
        for line, text, observations in _image_lines(path):
            words = text.split(maxsplit=9)
            if len(words) != 10 or to_floats(words[:9]) is None:
                hint = ", with blanks instead of commas" if "," in text else ""
                raise _fault(path, line, text, f"IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME{hint}")
            if len(observations.split()) % 3:
                raise _fault(path, line + 1, observations, "triples of X Y POINT3D_ID")
        return
    is_whole, expected = _LINES[path.stem]
    for line, text in text_lines(path):
        if not is_whole(text.split()):
            raise _fault(path, line, text, expected)


def _image_lines(path: Path) -> Iterator[tuple[int, str, str]]:
    """Number and text of each image's first line, and the line of its observations."""
    numbered = iter(enumerate(read_text(path).split("\n"), 1))
    for line, raw in numbered:
        text = raw.strip()
        if text and not text.startswith("#"):
            yield line, text, next(numbered, (0, ""))[1]


def _is_rig(words: list[str]) -> bool:
    at, sensors = 4, 1
    while at < len(words):
        if words[at] not in _SENSORS or words[at + 2 : at + 3] not in (["0"], ["1"]):
            return False
        at += 10 if words[at + 2] == "1" else 3
        sensors += 1
    return at == len(words) and words[1] == str(sensors) and words[2] in _SENSORS


_LINES: Mapping[str, tuple[Callable[[list[str]], bool], str]] = {
    "cameras": (lambda words: len(words) > 4, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS"),
    "points3D": (
        lambda words: len(words) >= 8 and len(words) % 2 == 0,
        "POINT3D_ID X Y Z R G B ERROR and pairs of IMAGE_ID POINT2D_IDX",
    ),
    "rigs": (
        _is_rig,
        "RIG_ID NUM_SENSORS and so many sensors: SENSOR_TYPE (CAMERA, IMU) SENSOR_ID, after the first "
        "with HAS_POSE and, where that is 1, QW QX QY QZ TX TY TZ",
    ),
    "frames": (
        lambda words: len(words) > 9 and words[9].isdecimal() and len(words) == 10 + 3 * int(words[9][:9]),
        "FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA_IDS and so many triples of SENSOR_TYPE SENSOR_ID DATA_ID",
    ),
}


def _none(path: Path, line: int, words: Sequence[str], remedy: str) -> SourceError:
    word = next(word for word in words if not np.isfinite(to_floats([word]) or np.nan).all())
    return SourceError(f"{path}:{line}: `{word[:60]}`: expected a number: {remedy}")


def _fault(path: Path, line: int, text: str, expected: str) -> SourceError:
    return SourceError(f"{path}:{line}: `{text[:60]}`: expected {expected}: {REMEDY}")

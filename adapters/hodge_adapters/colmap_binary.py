"""COLMAP's binary files. No count in them is believed before the bytes for it are seen to be there."""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from hodge_adapters.colmap_records import (
    CAMERA_MODELS,
    REMEDY,
    CameraRecord,
    ImageRecord,
    Points,
    camera_record,
    no_points,
    world_from_cam,
)
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Ints
from hodge_pipeline.types.input_files import open_input

MAX_NAME_BYTES = 4096
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
_TRACK = np.dtype([("image", "<u4"), ("column", "<u4")])
_NAMES = {number: name for name, (number, _) in CAMERA_MODELS.items()}
_POINT = struct.Struct("<Q3d3Bd")


class Cursor:
    """Reads a file's bytes from front to back; raises `SourceError` with the offset where they end too early."""

    def __init__(self, path: Path, contents: mmap.mmap | bytes) -> None:
        self.path, self.contents, self.at = path, contents, 0

    def take(self, layout: str | struct.Struct) -> tuple[float, ...]:
        """The next numbers, by `struct`."""
        packed = struct.Struct(layout) if isinstance(layout, str) else layout
        return packed.unpack_from(self.contents, self._advance(packed.size))

    def count(self, least_bytes: int) -> int:
        """The next 64-bit count of records that have at least so many bytes each."""
        at = self.at
        count = int(self.take("<Q")[0])
        if count * least_bytes > len(self.contents) - self.at:
            raise self.fault(f"says {count} records, more than the file has room for", at)
        return count

    def array(self, dtype: np.dtype[np.void], count: int) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        """The next records, copied."""
        at = self._advance(dtype.itemsize * count)
        found: np.ndarray[tuple[int], np.dtype[np.void]] = np.frombuffer(self.contents, dtype, count, at).copy()
        return found

    def text(self) -> str:
        """The next text that ends in a zero byte."""
        end = self.contents.find(b"\0", self.at, self.at + MAX_NAME_BYTES)
        if end < 0:
            raise self.fault("has a name without end", self.at)
        start = self.at
        self.at = end + 1
        return bytes(self.contents[start:end]).decode("utf-8", "replace")

    def end(self) -> None:
        """Assert that nothing is left."""
        if self.at != len(self.contents):
            raise self.fault(f"goes on for {len(self.contents) - self.at} bytes after its last record", self.at)

    def fault(self, what: str, at: int) -> SourceError:
        """The complaint, with file and offset."""
        return SourceError(f"{self.path}: {what}, at byte {at}: copy the file again, or {REMEDY}")

    def _advance(self, size: int) -> int:
        at = self.at
        if size > len(self.contents) - at:
            raise self.fault("is cut off", at)
        self.at = at + size
        return at


@contextmanager
def opened(path: Path) -> Iterator[Cursor]:
    """A cursor on the file, mapped into memory. Raises `SourceError` where it cannot be read."""
    try:
        with open_input(path) as file:
            if not os.fstat(file.fileno()).st_size:
                yield Cursor(path, b"")
                return
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as contents:
                yield Cursor(path, contents)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror}): restore the file or its permissions") from error


def read_cameras(path: Path) -> dict[int, CameraRecord]:
    """Cameras by id from `cameras.bin`."""
    cameras: dict[int, CameraRecord] = {}
    with opened(path) as cursor:
        for _ in range(cursor.count(24)):
            camera_id, number, width, height = (int(value) for value in cursor.take("<IiQQ"))
            if number not in _NAMES:
                raise cursor.fault(f"has camera {camera_id} of the unknown model {number}", cursor.at - 20)
            model = _NAMES[number]
            params = cursor.take(f"<{CAMERA_MODELS[model][1]}d")
            cameras[camera_id] = camera_record(str(path), camera_id, model, (width, height), params)
        cursor.end()
    return cameras


def read_images(path: Path, tracks: bool) -> list[ImageRecord]:
    """Posed images from `images.bin`, with their observations where wanted."""
    images: list[ImageRecord] = []
    with opened(path) as cursor:
        for _ in range(cursor.count(73)):
            image_id, *pose, camera_id = cursor.take("<I7dI")
            name = cursor.text()
            found = cursor.array(_OBSERVATION, cursor.count(_OBSERVATION.itemsize))
            if not tracks:
                found = found[:0]
            where = f"{path}: image {int(image_id)} {name!r}"
            if not np.isfinite(found["pixel"]).all():
                raise SourceError(f"{where}: an observation is not finite: {REMEDY}")
            images.append(
                ImageRecord(
                    int(image_id),
                    world_from_cam(where, pose[:4], pose[4:]),
                    int(camera_id),
                    name,
                    found["pixel"].copy(),
                    found["point"].astype(np.int64),
                )
            )
        cursor.end()
    return images


def read_points(path: Path) -> Points:
    """Points and tracks from `points3D.bin`."""
    ids: list[int] = []
    xyz: list[tuple[float, ...]] = []
    tracks = []
    with opened(path) as cursor:
        for _ in range(cursor.count(_POINT.size + 8)):
            point_id, x, y, z, *_ = cursor.take(_POINT)
            ids.append(int(point_id))
            xyz.append((x, y, z))
            tracks.append(cursor.array(_TRACK, cursor.count(_TRACK.itemsize)))
        cursor.end()
    if not ids:
        return no_points()
    offsets: Ints = np.cumsum([0, *map(len, tracks)], dtype=np.int64)
    track = np.concatenate(tracks)
    return Points(
        np.array(ids, np.uint64).astype(np.int64),
        np.array(xyz),
        offsets,
        track["image"].astype(np.int64),
        track["column"].astype(np.int64),
    )

"""COLMAP's text files: one line a camera and a point, two lines an image."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hodge_adapters.colmap_records import (
    REMEDY,
    CameraRecord,
    ImageRecord,
    Points,
    camera_record,
    no_points,
    world_from_cam,
)
from hodge_adapters.text_rows import read_text, to_floats
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Ints

MAX_ID = 1 << 53


def read_cameras(path: Path) -> dict[int, CameraRecord]:
    """Cameras by id from `cameras.txt`."""
    cameras: dict[int, CameraRecord] = {}
    for line, text in lines(path):
        fields = text.split()
        camera_id, *size = whole(path, line, [fields[0], *fields[2:4]]) if len(fields) >= 4 else [0]
        params = to_floats(fields[4:])
        if len(size) < 2 or not params:
            raise fault(path, line, text, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        cameras[camera_id] = camera_record(f"{path}:{line}", camera_id, fields[1], (size[0], size[1]), params)
    return cameras


def read_images(path: Path, tracks: bool) -> list[ImageRecord]:
    """Posed images from `images.txt`, with their observations where wanted."""
    images: list[ImageRecord] = []
    numbered = iter(enumerate(read_text(path).split("\n"), 1))
    for line, raw in numbered:
        text = raw.strip()
        if not text or text.startswith("#"):
            continue
        _, observations = next(numbered, (0, ""))
        images.append(_image(path, line, text, observations if tracks else ""))
    return images


def read_points(path: Path) -> Points:
    """Points and tracks from `points3D.txt`."""
    ids, xyz, tracks = [], [], []
    for line, text in lines(path):
        numbers = _numbers(text)
        if numbers is None or len(numbers) < 8 or len(numbers) % 2:
            raise fault(path, line, text, "POINT3D_ID X Y Z R G B ERROR and pairs of IMAGE_ID POINT2D_IDX")
        ids.append(_id(path, line, numbers[:1])[0])
        xyz.append(numbers[1:4])
        tracks.append(_id(path, line, numbers[8:]).reshape(-1, 2))
    if not ids:
        return no_points()
    offsets: Ints = np.cumsum([0, *map(len, tracks)], dtype=np.int64)
    track = np.concatenate(tracks)
    return Points(np.array(ids, np.int64), np.array(xyz), offsets, track[:, 0].copy(), track[:, 1].copy())


def _image(path: Path, line: int, text: str, observations: str) -> ImageRecord:
    fields = text.split(maxsplit=9)
    pose = to_floats(fields[1:8])
    if len(fields) < 10 or pose is None:
        hint = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        raise fault(path, line, text, hint + (", with blanks instead of commas" if "," in text else ""))
    image_id, camera_id = whole(path, line, [fields[0], fields[8]])
    where = f"{path}:{line}: image {fields[9]!r}"
    numbers = _numbers(observations)
    if numbers is None or len(numbers) % 3 or not np.isfinite(numbers).all():
        raise SourceError(f"{path}:{line + 1}: the observations are no triples of X Y POINT3D_ID: {REMEDY}")
    found = numbers.reshape(-1, 3)
    point_ids = _id(path, line + 1, found[:, 2], least=-1)
    return ImageRecord(
        image_id, world_from_cam(where, pose[:4], pose[4:]), camera_id, fields[9], found[:, :2], point_ids
    )


def lines(path: Path) -> Iterator[tuple[int, str]]:
    """Each line with its number, without comments and empty ones."""
    for line, raw in enumerate(read_text(path).split("\n"), 1):
        text = raw.strip()
        if text and not text.startswith("#"):
            yield line, text


def _numbers(text: str) -> Floats | None:
    try:
        return np.array(text.split(), np.float64)
    except ValueError:
        return None


def _id(path: Path, line: int, values: Floats, least: int = 0) -> Ints:
    whole = np.isfinite(values) & (np.floor(values) == values) & (values >= least) & (values < MAX_ID)
    if not whole.all():
        raise SourceError(f"{path}:{line}: {values[~whole][0]} is no id: {REMEDY}")
    return values.astype(np.int64)


def whole(path: Path, line: int, fields: list[str]) -> list[int]:
    """The fields as whole numbers; raises `SourceError`."""
    if not all(field.isascii() and field.isdecimal() and len(field) < 16 for field in fields):
        raise fault(path, line, " ".join(fields), "whole numbers for ids and sizes")
    return [int(field) for field in fields]


def fault(path: Path, line: int, text: str, expected: str) -> SourceError:
    """The complaint, with file and line."""
    return SourceError(f"{path}:{line}: `{text[:60]}`: expected {expected}: {REMEDY}")

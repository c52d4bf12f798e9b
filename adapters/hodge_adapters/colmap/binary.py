"""The observations and points of pycolmap's models as arrays, by way of COLMAP's binary files.

pycolmap hands each observation and each entry of a track over as an object; a file has all of them in one piece.
"""

from __future__ import annotations

import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import Points
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.input_files import read_input

_U64 = struct.Struct("<Q")
_IMAGE = np.dtype([("image_id", "<u4"), ("pose", "<f8", 7), ("camera_id", "<u4")])
_SEEN = np.dtype([("pixel", "<f8", 2), ("point_id", "<i8")])
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_ENTRY = np.dtype([("image_id", "<u4"), ("column", "<u4")])


def content_arrays(reconstruction: pycolmap.Reconstruction) -> tuple[Mapping[int, tuple[Floats, Ints]], Points]:
    """For each posed image by its id the pixels (N, 2) and the points (N,) of its observations, and all points.

    Raises `OverflowError` where the id of a point is beyond 2^63.
    """
    with tempfile.TemporaryDirectory(prefix="hodge-colmap-") as scratch:
        reconstruction.write_binary(scratch)
        seen = _observations(read_input(Path(scratch) / "images.bin"))
        points = _points(read_input(Path(scratch) / "points3D.bin"))
    if (points.ids < 0).any():
        raise OverflowError("the id of a point is beyond 2^63")
    return seen, points


def _observations(contents: bytes) -> dict[int, tuple[Floats, Ints]]:
    found, at = {}, _U64.size
    for _ in range(_U64.unpack_from(contents)[0]):
        image_id = int(np.frombuffer(contents, _IMAGE, 1, at)["image_id"][0])
        at = contents.index(b"\0", at + _IMAGE.itemsize) + 1
        seen = np.frombuffer(contents, _SEEN, _U64.unpack_from(contents, at)[0], at + _U64.size)
        at += _U64.size + seen.nbytes
        found[image_id] = seen["pixel"].copy(), seen["point_id"].astype(np.int64)
    return found


def _points(contents: bytes) -> Points:
    """The points in the order of their ids, with whole tracks."""
    starts, at = [], _U64.size
    for _ in range(_U64.unpack_from(contents)[0]):
        starts.append(at)
        at += _POINT.itemsize + _ENTRY.itemsize * _U64.unpack_from(contents, at + _POINT.itemsize - _U64.size)[0]
    parts = np.full((len(starts), 2), _POINT.itemsize)
    parts[:, 1] = np.diff([*starts, at]) - _POINT.itemsize
    is_head = np.repeat(np.tile([True, False], len(starts)), parts.ravel())
    body = np.frombuffer(contents, np.uint8)[_U64.size :]
    heads, entries = body[is_head].view(_POINT), body[~is_head].view(_ENTRY)
    order = np.argsort(heads["id"], kind="stable")
    lengths = heads["length"].astype(np.int64)
    before = np.cumsum(lengths) - lengths
    offsets = np.concatenate([[0], np.cumsum(lengths[order])]).astype(np.int64)
    entries = entries[np.repeat(before[order] - offsets[:-1], lengths[order]) + np.arange(len(entries))]
    return Points(
        ids=heads["id"][order].astype(np.int64),
        xyz=heads["xyz"][order],
        offsets=offsets,
        image_ids=entries["image_id"].astype(np.int64),
        columns=entries["column"].astype(np.int64),
    )

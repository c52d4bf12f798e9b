"""The verified pairs in a COLMAP `database.db`, opened read-only. Real ones hold matches, but no relative pose."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hodge_adapters.colmap.edges import Pair, camera_table, positions
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import Model
from hodge_adapters.colmap.relative import Sighting
from hodge_adapters.sqlite_file import DAMAGED, opened_database
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.text import counted

MAX_IMAGE_ID = 2147483647
"""A pair's key is `first · this + second`."""
MAX_KEYPOINT_COLUMNS = 16
USABLE = (2, 3, 4, 5, 6)
"""Calibrated, uncalibrated, planar, panoramic, either of the last two: not degenerate, not a watermark."""
MATRICES = ("F", "E", "H")
TABLES = ("images", "keypoints", "two_view_geometries", "pose_priors")
CAMERA, GEODETIC = 0, 0
"""A type of sensor, and a coordinate system (WGS 84), as the database numbers them."""
MAX_VALUE_BYTES = 1 << 26
"""The keypoints of an image, or the matches of a pair: 64 MiB are 2.8 million keypoints of six columns."""


@contextmanager
def _opened(path: Path, instead: str = "give --database none") -> Iterator[sqlite3.Connection]:
    """The database. Raises `SourceError` for a file that is none, or one that is damaged."""
    try:
        with opened_database(path, TABLES, MAX_VALUE_BYTES) as database:
            yield database
    except DAMAGED as error:
        raise SourceError(f"{path}: not a whole COLMAP database ({error}): make it again, or {instead}") from error


def database_pairs(path: Path, model: Model, min_shared: int, notes: list[str]) -> Iterator[Pair]:
    """Pairs of the model's images with enough verified matches; i is the image with the greater id.

    Raises `SourceError` for a file that is no database of COLMAP, or one that is damaged.
    """
    row_of_name = {image.name: row for row, image in enumerate(model.images)}
    cameras = camera_table(model)
    outside = 0
    with _opened(path, "set edges=covisibility") as database:
        row_of_id = _rows_by_id(database, row_of_name)
        rows = database.execute(
            "SELECT pair_id, rows, config, data, F, E, H FROM two_view_geometries WHERE rows >= ? ORDER BY pair_id",
            (min_shared,),
        )
        for pair_id, count, config, data, *matrices in rows:
            ids = divmod(int(pair_id), MAX_IMAGE_ID)[::-1]
            i, j = (row_of_id.get(image_id) for image_id in ids)
            if i is None or j is None:
                outside += 1
            elif config in USABLE:
                matches = _blob(path, f"pair {pair_id}", data, np.dtype("<u4"), count, 2)
                keys = _keypoints(database, path, ids[0]), _keypoints(database, path, ids[1])
                yield Pair(i, j, _sighting(path, model, cameras, (i, j), keys, matches, config, matrices), "database")
    if outside:
        notes.append(f"{path.name}: {counted(outside, 'pair is|pairs are')} of images that the model does not have")


def database_names(path: Path) -> set[str]:
    """The names of the images in a database. Raises `SourceError` where it is none."""
    with _opened(path) as database:
        return {str(name) for (name,) in database.execute("SELECT name FROM images")}


def has_verified_pairs(path: Path) -> bool:
    """Whether the database has COLMAP's table of verified pairs: old ones hold `inlier_matches` instead.

    Raises `SourceError` where it is no database.
    """
    with _opened(path) as database:
        return _has_table(database, "two_view_geometries")


def _has_table(database: sqlite3.Connection, name: str) -> bool:
    return bool(database.execute("SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ?", (name,)).fetchone())


class Known(NamedTuple):
    """Of one image: `position (3,)` in metres and its `covariance (3, 3)`; `gravity (3,)` in its axes; NaN: unknown.

    The position is latitude, longitude (degrees) and height (metres) where it is `geodetic`.
    """

    position: Floats
    covariance: Floats
    gravity: Floats
    geodetic: bool = False


def noted_priors(path: Path) -> dict[str, Known]:
    """The pose priors of a database by the image's name, as it has them. Raises `SourceError` where it is none."""
    with _opened(path) as database:
        if not _has_table(database, "pose_priors"):
            return {}
        names = dict(database.execute("SELECT image_id, name FROM images"))
        table = database.execute("SELECT * FROM pose_priors")
        columns = [column for column, *_ in table.description]
        rows = [dict(zip(columns, row, strict=True)) for row in table]
        return {names[_image_of(row)]: _prior(row) for row in rows if _image_of(row) in names}


def _image_of(row: Mapping[str, Any]) -> int | None:
    """Of a prior: the image, None where it is of another sensor; databases of before COLMAP 4 name it otherwise."""
    if row.get("corr_sensor_type", CAMERA) != CAMERA:
        return None
    return int(row.get("corr_data_id", row.get("image_id")))


def _prior(row: Mapping[str, Any]) -> Known:
    cells = []
    for column, count in (("position", 3), ("position_covariance", 9), ("gravity", 3)):
        data = row.get(column)
        whole = isinstance(data, bytes) and len(data) == 8 * count
        cells.append(np.frombuffer(data, "<f8").copy() if whole and data is not None else np.full(count, np.nan))
    position, covariance, gravity = cells
    return Known(position, covariance.reshape(3, 3), gravity, row.get("coordinate_system") == GEODETIC)


def database_matches(path: Path, row_of_name: Mapping[str, int]) -> Iterator[tuple[int, int, Ints]]:
    """Rows i and j of two images by name, and the keypoints (M, 2) of i and of j that are verified to match."""
    with _opened(path) as database:
        row_of_id = _rows_by_id(database, row_of_name)
        rows = database.execute(
            "SELECT pair_id, rows, config, data FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
        )
        for pair_id, count, config, data in rows:
            first, second = (row_of_id.get(image_id) for image_id in divmod(int(pair_id), MAX_IMAGE_ID))
            if first is not None and second is not None and config in USABLE:
                matches = _blob(path, f"pair {pair_id}", data, np.dtype("<u4"), count, 2)
                yield first, second, matches.astype(np.int64)


def _rows_by_id(database: sqlite3.Connection, row_of_name: Mapping[str, int]) -> dict[int, int]:
    names = database.execute("SELECT image_id, name FROM images")
    return {int(image_id): row_of_name[name] for image_id, name in names if name in row_of_name}


def _sighting(
    path: Path,
    model: Model,
    cameras: Any,
    rows: tuple[int, int],
    keys: tuple[Floats, Floats],
    matches: Any,
    config: int,
    matrices: list[bytes | None],
) -> Sighting:
    columns_j, columns_i = matches[:, 0].astype(np.int64), matches[:, 1].astype(np.int64)
    if len(matches) and (columns_i.max() >= len(keys[0]) or columns_j.max() >= len(keys[1])):
        raise SourceError(f"{path}: a match names a keypoint that is not there: make the database again")
    image_i, image_j = model.images[rows[0]], model.images[rows[1]]
    xyz = np.full((len(matches), 3), np.nan)
    if len(image_j.point_ids) == len(keys[1]):
        xyz = positions(model, image_j.point_ids[columns_j])
    pixels_i, pixels_j = keys[0][columns_i], keys[1][columns_j]
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration(config)
    rows_of_match = np.arange(len(matches), dtype=np.uint32)
    geometry.inlier_matches = np.column_stack([rows_of_match, rows_of_match])
    for name, blob in zip(MATRICES, matrices, strict=True):
        if blob is not None and len(blob) == 72:
            setattr(geometry, name, np.frombuffer(blob, "<f8").reshape(3, 3))
    return Sighting(cameras[image_i.camera_id], cameras[image_j.camera_id], pixels_i, pixels_j, xyz, geometry)


def _keypoints(database: sqlite3.Connection, path: Path, image_id: int) -> Floats:
    found = database.execute("SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (image_id,)).fetchone()
    if found is None:
        return np.zeros((0, 2))
    rows, columns, data = found
    if not 2 <= columns <= MAX_KEYPOINT_COLUMNS:
        raise SourceError(f"{path}: image {image_id} has keypoints of {columns} columns: make the database again")
    keys = np.asarray(_blob(path, f"image {image_id}", data, np.dtype("<f4"), rows, columns)[:, :2], np.float64)
    if not np.isfinite(keys).all():
        raise SourceError(f"{path}: image {image_id} has a keypoint that is not finite: make the database again")
    return keys


def _blob(path: Path, what: str, data: bytes | None, dtype: np.dtype[Any], rows: int, columns: int) -> Any:
    if data is None or not isinstance(data, bytes) or len(data) != rows * columns * dtype.itemsize:
        raise SourceError(f"{path}: {what} says {rows} rows, its data has another size: make the database again")
    return np.frombuffer(data, dtype).reshape(rows, columns)

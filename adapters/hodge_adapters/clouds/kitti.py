"""LiDAR scans in `.bin` files of float32 columns (KITTI, nuScenes), and the poses that lie beside them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hodge_adapters.clouds.columns import points_of_columns, seconds_after_first
from hodge_adapters.text_rows import read_rows, reading, to_floats
from hodge_adapters.trajectories.text import read_kitti
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Floats32, PointCloud
from hodge_pipeline.types.input_files import beginning, read_input

POSES, CALIBRATION, TO_CAMERA = "poses.txt", "calib.txt", "Tr:"
MAX_REFLECTANCE = 255
MAX_BEAM = 255
WIDTHS = (3, 4, 5, 6)
"""Columns: x, y, z; with a reflectance; with the number of the beam, a time, or both in either order as well."""
ASCENDING = 0.9
"""Share of the points that are measured after the one before them: in files by beams all but one for each beam."""
FOLLOWS = 0.5
"""Points that follow each other along a scan are this much nearer than rows that are cut at a wrong width: of a cloud
in no order the median steps of all widths are within a fifth of each other.
"""
KITTI_RAISE_DEG = 0.205
"""KITTI's calibration of its HDL-64E has the beams too low (Deschaud, IMLS-SLAM, ICRA 2018); KISS-ICP's value."""
SCANS_LOOKED_AT = 9
NEAREST_M = 5.0
"""Nearer points tell less of a beam's angle: lasers lie up to 20 cm from the origin that angles are taken at."""
NUMBERS_LOOKED_AT = 1024
"""Of a file: coordinates fall somewhere among far fewer."""
_NUMBERED = re.compile(r"\d(\.pcd)?\.bin$")


def is_scan(name: str) -> bool:
    """Whether a `.bin` file's name ends in a number, as those of scans do: others are COLMAP's."""
    return _NUMBERED.search(name) is not None


def ascends(path: Path) -> bool:
    """Whether the first numbers of a `.bin` file never fall: times of points, in a file beside that of the scan."""
    contents = beginning(path, 4 * NUMBERS_LOOKED_AT)
    values = np.frombuffer(contents, "<f4", count=len(contents) // 4)
    return bool(len(values)) and bool(values[-1] > values[0]) and bool((np.diff(values) >= 0).all())


def read_bin(path: Path) -> PointCloud:
    """The points of a scan of three to six columns (`WIDTHS`), told apart by what they then are, with their times.

    Raises `SourceError` where it has none of these.
    """
    with reading(path):
        values = np.frombuffer(read_input(path), np.uint8)
    tables = {width: values.view("<f4").reshape(-1, width) for width in WIDTHS if len(values) % (4 * width) == 0}
    if not tables:
        raise SourceError(f"{path}: {len(values)} bytes are no float32 rows of three to six columns: copy it again")
    table = _likeliest(tables)
    times = [column for column in table[:, 4:].T if _are_times(column, table[:, :3])]
    found = points_of_columns(path, dict(zip((*"xyz", "time"), (*table.T[:3], *times), strict=False)))
    if len(table) and not len(found):
        raise SourceError(f"{path}: holds no finite coordinates: is it a scan of float32 x y z?")
    return found


def _likeliest(tables: Mapping[int, Floats32]) -> Floats32:
    """The table of most columns that mean what they should, else that whose points follow each other, else that of
    fewest columns.
    """
    for width in sorted(tables, reverse=True)[: len(tables) - (3 in tables)]:
        table = tables[width]
        if _has_reflectance(table) and all(_are_beams(last) or _are_times(last, table) for last in table[:, 4:].T):
            return table
    fewest = tables[min(tables)]
    nearest = min(tables.values(), key=lambda table: _median_step(table[:, :3]))
    follows = _median_step(nearest[:, :3]) < FOLLOWS * _median_step(fewest[:, :3])
    return nearest if follows else fewest


def _are_beams(column: Floats32) -> bool:
    """Whether the values (N,) are numbers of beams."""
    with np.errstate(invalid="ignore"):
        return bool(((column >= 0) & (column <= MAX_BEAM) & (column == np.round(column))).all())


def _are_times(column: Floats32, points: Floats32) -> bool:
    """Whether the values (N,) are times of the points (N, 3 or more) in a revolution, which ascend as a rule."""
    if _are_beams(column) or not (np.diff(column) >= 0).mean() > ASCENDING:
        return False
    returned = np.asarray(points[:, :3].any(axis=1))
    return seconds_after_first(column.astype(float), returned)[0] is not None


def _has_reflectance(table: Floats32) -> bool:
    """Whether the fourth column is a reflectance: in [0, 1], or a whole number up to 255, or up to 255 with
    points that follow each other nearer than as three columns.
    """
    with np.errstate(invalid="ignore"):
        last = table[:, 3]
        if not ((last >= 0) & (last <= MAX_REFLECTANCE)).all():
            return False
        if (last <= 1).all() or (last == np.round(last)).all():
            return True
        if table.size % 3:
            return True
        return bool(_median_step(table[:, :3]) < _median_step(table.reshape(-1, 3)))


def _median_step(points: Floats32) -> float:
    if len(points) < 2:
        return 0.0
    with np.errstate(invalid="ignore"):
        steps = np.linalg.norm(np.diff(points.astype(float), axis=0), axis=1)
    return float(np.median(np.nan_to_num(steps, nan=np.inf)))


def raised(cloud: PointCloud, angle_deg: float) -> PointCloud:
    """The cloud with the elevation of each point larger by the angle, at the same range and azimuth."""
    points = cloud.points_in_cam.astype(float)
    ground = np.hypot(points[:, 0], points[:, 1])
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    points[:, :2] *= (cos - sin * points[:, 2] / np.maximum(ground, 1e-9))[:, None]
    points[:, 2] = cos * points[:, 2] + sin * ground
    return replace(cloud, points_in_cam=points.astype(np.float32))


def are_of_hdl64(files: Sequence[Path]) -> bool:
    """Whether the points of some of these scans together lie all round, between 24.8 degrees below the horizon and 2
    above it, where they end at once: the fan of an HDL-64E, KITTI's scanner, and of no other common one.
    """
    clouds: list[Floats32] = []
    for file in files[:: max(1, len(files) // SCANS_LOOKED_AT)]:
        try:
            clouds.append(read_bin(file).points_in_cam)
        except SourceError:  # said where the scan is read
            continue
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    points = points[np.linalg.norm(points, axis=1) > NEAREST_M]
    up = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    round_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    if len(np.unique(round_deg // 10)) < 36:
        return False
    beyond, low, at_0, at_1, at_3 = (
        float(((up >= least) & (up < most)).mean()) for least, most in ((4, 91), (-27, -20), (0, 1), (1, 2), (3, 4))
    )
    below = float((up < -27).mean())
    return max(beyond, below) < 0.005 and low > 0.001 and at_1 > 0.7 * at_0 and at_1 > 3 * at_3


def scan_poses(
    folder: Path, numbers: Sequence[float], notes: list[str]
) -> tuple[dict[float, Floats], tuple[Path, ...]]:
    """The poses world_from_scan of the scans by their numbers, which are rows of `poses.txt` in their folder or the one
    above, and the files read: where `calib.txt` lies beside it these are poses of the camera that it places.
    """
    place = next((place for place in (folder, folder.parent) if (place / POSES).is_file()), None)
    if place is None:
        return {}, ()
    poses = read_kitti(place / POSES).world_from_cam
    calibration = place / CALIBRATION
    files: tuple[Path, ...] = (place / POSES,)
    if calibration.is_file():
        poses, files = poses @ _camera_from_scan(calibration), (*files, calibration)
    else:
        notes.append(f"no {CALIBRATION} beside {POSES}: its poses are taken as the scanner's own, not a camera's")
    return {number: poses[int(number)] for number in numbers if number < len(poses)}, files


def _camera_from_scan(path: Path) -> Floats:
    row = next((row for row in read_rows(path) if row.fields[0] == TO_CAMERA), None)
    values = None if row is None else to_floats(row.fields[1:])
    pose = np.eye(4)
    if values is not None and len(values) == 12:
        pose[:3] = np.reshape(values, (3, 4))
    if values is None or len(values) != 12 or not se3.is_motion(pose[None]).all():
        raise SourceError(
            f"{path}: no line `{TO_CAMERA}` of twelve numbers, from the scanner to the camera: restore it"
        )
    pose[:3, :3] = se3.project_to_so3(pose[:3, :3])
    return pose

"""The clouds of files: which there are, the corner that their coordinates count from, and their points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hodge_adapters.clouds.columns import ZERO, Columns, Corner, coarse_step, far_corner, points_of_parts
from hodge_adapters.clouds.kitti import raised, read_bin
from hodge_adapters.clouds.npy import npy_parts
from hodge_adapters.clouds.pcd import pcd_parts
from hodge_adapters.clouds.ply import ply_parts
from hodge_adapters.clouds.scan_files import LIBRARIES, Scan, e57_parts, e57_scans, las_corner, las_parts
from hodge_adapters.clouds.tables import table_parts
from hodge_adapters.clouds.uos import read_uos, uos_pose
from hodge_adapters.clouds.vtk import vtk_parts
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, PointCloud
from hodge_pipeline.types.text import counted


@dataclass(frozen=True)
class Fragment:
    """A file of points, or one scan (`row`) of a file with several; `corner` is where its coordinates count from."""

    path: Path
    row: int | None = None
    corner: Corner = ZERO
    world_from_scan: tuple[float, ...] | None = None

    @property
    def name(self) -> str:
        """What a person calls it."""
        return self.path.name if self.row is None else f"{self.path.name}/{self.row}"

    def in_metres(self, units_per_metre: float) -> Floats | None:
        """`world_from_scan` (4, 4) in metres, None where the file gives none."""
        if self.world_from_scan is None:
            return None
        pose = np.array(self.world_from_scan).reshape(4, 4)
        pose[:3, 3] /= units_per_metre
        return pose


def read_fragment(fragment: Fragment, *, units_per_metre: float = 1.0, raise_deg: float = 0.0) -> PointCloud:
    """The points of a fragment in metres, by the ending of its file; those of a `.bin` raised by an angle.

    Points that are not finite are left out. Raises `SourceError` for a damaged file, and for one without x, y, z.
    """
    ending = fragment.path.suffix.lower()
    if ending in WHOLE:
        cloud = WHOLE[ending](fragment.path)
    else:
        cloud = points_of_parts(fragment.path, _parts(fragment), fragment.corner)
    if raise_deg and ending == ".bin":
        cloud = raised(cloud, raise_deg)
    if units_per_metre == 1.0:
        return cloud
    return replace(cloud, points_in_cam=cloud.points_in_cam / np.float32(units_per_metre))


def fragments_of(files: list[Path], units_per_metre: float, notes: list[str]) -> list[Fragment]:
    """The fragments of the files: each scan of an E57 file is one; those far from zero share the corner that they count
    from, that of the LAS files where there are some.
    """
    las = [file for file in files if LIBRARIES.get(file.suffix.lower()) == "laspy"]
    found: list[Fragment] = []
    for file in files:
        scans = _e57_scans(file, is_alone=len(files) == 1) if file.suffix.lower() == ".e57" else []
        found += [Fragment(file, scan.row, world_from_scan=_flat(scan.world_from_scan)) for scan in scans]
        found += [] if scans else [Fragment(file, world_from_scan=_flat(uos_pose(file)))]
    others = [fragment for fragment in found if fragment.path not in las and fragment.path.suffix.lower() in PARTS]
    corner = las_corner(las, units_per_metre, is_all=len(las) == len(files)) if las else None
    if corner is not None and any(corner):
        words = " ".join(f"{value:.0f}" for value in corner)
        notes.append(f"coordinates of {counted(len(las), 'LAS file')} are counted from their middle {words}")
    far, step_m = _far_corner(others[0], units_per_metre) if others else (ZERO, 0.0)
    if step_m:
        notes.append(
            f"{others[0].name}: was written far from zero in 32-bit numbers, rounded to steps of {step_m:.2g} m there: "
            "export it in 64 bits, or counted from a corner near it"
        )
    if any(far):
        far = corner if corner is not None and any(corner) else far
        words = " ".join(f"{value:.0f}" for value in far)
        notes.append(
            f"{others[0].name}: lies far from zero, where 32-bit numbers lose digits: coordinates of "
            f"{counted(len(others), 'cloud')} are counted from {words}"
        )
    corners = dict.fromkeys(las, corner or ZERO) | {fragment.path: far for fragment in others}
    return [replace(fragment, corner=corners.get(fragment.path, ZERO)) for fragment in found]


def _e57_scans(file: Path, *, is_alone: bool) -> list[Scan]:
    try:
        return e57_scans(file)
    except SourceError:
        if is_alone:
            raise
        return []  # said where the cloud is read


def _far_corner(fragment: Fragment, units_per_metre: float) -> tuple[Corner, float]:
    """By the first points of a fragment the corner to count from, zero where it is turned as a whole, and the step in
    metres to which they were rounded.
    """
    try:
        part = next(_parts(fragment))
    except SourceError:  # said where the cloud is read
        return ZERO, 0.0
    pose = fragment.in_metres(units_per_metre)
    is_turned = pose is not None and not np.array_equal(pose[:3, :3], np.eye(3))
    return ZERO if is_turned else far_corner(part, units_per_metre), coarse_step(part, units_per_metre)


def _parts(fragment: Fragment) -> Iterator[Columns]:
    """The columns of a fragment's file, in parts, at least one."""
    if fragment.row is not None:
        return e57_parts(fragment.path, fragment.row)
    return PARTS[fragment.path.suffix.lower()](fragment.path)


PARTS: Mapping[str, Callable[[Path], Iterator[Columns]]] = {
    ".ply": ply_parts,
    ".pcd": pcd_parts,
    ".las": las_parts,
    ".laz": las_parts,
    ".e57": e57_parts,
    ".xyz": table_parts,
    ".asc": table_parts,
    ".csv": table_parts,
    ".vtk": vtk_parts,
    ".npy": npy_parts,
}
WHOLE: Mapping[str, Callable[[Path], PointCloud]] = {".bin": read_bin, ".3d": read_uos}
"""Readers of files that are no columns of their own coordinates."""
ENDINGS = (*PARTS, *WHOLE)


def _flat(pose: Floats | None) -> tuple[float, ...] | None:
    return None if pose is None else tuple(pose.ravel().tolist())

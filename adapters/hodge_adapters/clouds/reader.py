"""A folder of point-cloud fragments in sequence, with an optional Redwood `.log` of poses or pairs."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.clouds.fragments import ENDINGS, fragments_of, read_fragment
from hodge_adapters.clouds.kitti import KITTI_RAISE_DEG, are_of_hdl64, ascends, is_scan, scan_poses
from hodge_adapters.clouds.npy import holds_points
from hodge_adapters.clouds.ply import write_ply
from hodge_adapters.clouds.scan_files import LIBRARIES, library
from hodge_adapters.clouds.tables import names_points
from hodge_adapters.clouds.uos import POSE, pose_file
from hodge_adapters.posed import left_out, written
from hodge_adapters.text_rows import listed, natural
from hodge_adapters.trajectories.log import begins_as_log, read_log_file
from hodge_adapters.trajectories.text import unit_of
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Floats32, Frame, PointCloud, Source, Trajectory, ViewGraph
from hodge_pipeline.types.positions import whole_kilometres
from hodge_pipeline.types.text import counted

OTHER_SCANS = frozenset((".pts", ".ptx", ".obj", ".stl", ".off", ".ptc", ".fls", ".rcp"))
TABLES = frozenset((".csv", ".txt", ".pts"))
"""Endings of files that may be tables of points as they are."""
TOLD_BY = {".csv": names_points, ".npy": holds_points}
"""Files of these endings hold many things: the beginning of one tells whether it holds points."""
_NUMBER = re.compile(r"(\d{1,19})\D*$")
_CLOCK = re.compile(r"(?<!\d)(\d{9,10})([._])(\d{1,9})$")
"""Seconds since 1970 with a fraction, as bag_to_pcd names its files, or with nanoseconds of their own."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CloudFolderReader:
    """Reads a folder of fragments, or one file; each is a frame with points and no images."""

    pattern: str = Field("*", description="which files of the folder, such as cloud_bin_*.ply")
    log: str = Field(
        "auto",
        description="Redwood .log in the folder: blocks `i i n` are poses, `i j n` measured pairs; auto: the only one "
        "there that begins as one; empty: none",
    )
    units_per_metre: float = Field(1.0, gt=0, description="stored units per metre; 1000 for millimetres")
    every: int = Field(1, ge=1, description="take every n-th fragment")
    raise_deg: float | Literal["auto"] = Field(
        "auto",
        description="degrees by which the points of `.bin` scans are raised; auto: 0.205, the error of KITTI's "
        "calibration, where the angles of the points are those of its scanner, an HDL-64E; 0: not",
    )

    def sniff(self, path: Path) -> Sniff:
        """By the endings of the files."""
        path = Path(path)
        try:
            names = [path] if path.is_file() else [path / name for name in os.listdir(path) if not name.endswith(POSE)]
        except OSError:
            return Sniff(0.0, "not a folder that can be read")
        count = sum(map(_is_scan, names))
        if not count:
            is_other = path.is_file() and path.suffix.lower() in OTHER_SCANS
            return Sniff(
                0.0, f"no {', '.join(ENDINGS)}", "a scan of another format: convert to PLY" if is_other else ""
            )
        return Sniff(
            0.8 if count * 2 > len(names) else 0.4,
            f"{counted(count, 'point cloud')} among {counted(len(names), 'file')}",
        )

    def open(self, path: Path) -> Source:
        """Fragments in natural order of their names. Ids are the names of the files, `a.e57/3` one scan of several;
        stamps are the last numbers in the names, else the rows.
        """
        path = Path(path)
        notes: list[str] = []
        files = [path] if path.is_file() else self._files(path, notes)
        for file in files:
            _require(file)
        fragments = fragments_of(files, self.units_per_metre, notes)
        scanners = _scanners([fragment.path for fragment in fragments])
        if scanners:
            counts = ", ".join(f"{name} {scanners.count(name)}" for name in dict.fromkeys(scanners))
            notes.append(f"several scanners, by the names of the files ({counts}): each is a sequence of its own")
        stems = [f"{f.path.stem}" if f.row is None else f"{f.path.stem} {f.row}" for f in fragments]
        numbers = [float(row) for row in range(len(stems))] if scanners else _numbers(stems, notes)
        order = np.argsort(numbers, kind="stable")
        fragments, numbers = [fragments[row] for row in order], [numbers[row] for row in order]
        log = self._log(path if path.is_dir() else path.parent, notes) if path.is_dir() or self.log != "auto" else None
        parsed = read_log_file(log) if log else None
        poses: Mapping[float, Floats] = dict(parsed.poses.items()) if parsed else {}
        beside = tuple(filter(None, [log, *(pose_file(file) for file in files)]))
        if not poses and is_scan(fragments[0].path.name):
            poses, beside = scan_poses(fragments[0].path.parent, numbers, notes)
        raise_deg = self._raise_deg([fragment.path for fragment in fragments], notes)
        names = {number: fragment.name for number, fragment in zip(numbers, fragments, strict=True)}
        without = [name for number, name in names.items() if number not in poses]
        if poses and without:
            notes.append(f"{len(without)} of {len(numbers)} fragments have no pose: {listed(without)}")
        if log and (others := len(poses.keys() - names.keys())):
            notes.append(
                f"{log.name}: {others} of {len(poses)} poses have no fragment of their number: is it of other frames, "
                "such as the images that fragments were made of? (option log: another one, or empty for none)"
            )
        frames = tuple(
            Frame(
                frame_id=fragment.name,
                stamp_s=number,
                read_points=partial(read_fragment, fragment, units_per_metre=self.units_per_metre, raise_deg=raise_deg),
                world_from_cam=poses.get(number, fragment.in_metres(self.units_per_metre)),
                sequence=scanner,
            )
            for number, fragment, scanner in zip(numbers, fragments, scanners or [""] * len(fragments), strict=True)
        )
        graph = _graph(names, parsed.pairs, parsed.i_from_j, notes) if parsed and len(parsed.pairs) else None
        every = frames[:: self.every]
        read = (*files, *beside)
        return Source(path.resolve().name, path, every, Trajectory.of_frames(frames), graph, tuple(notes), read)

    def _files(self, path: Path, notes: list[str]) -> list[Path]:
        try:
            listing = [file for file in path.glob(self.pattern) if not file.name.startswith(".")]
        except (OSError, ValueError, NotImplementedError) as error:
            raise SourceError(f"{path}: cannot be listed with pattern {self.pattern!r}: {error}") from error
        scans = [file for file in listing if _is_scan(file) and file.is_file()]
        times = {file for file in scans if file.suffix.lower() == ".bin" and ascends(file)}
        found = [file for file in scans if file not in times]
        others = {file for file in listing if file.suffix.lower() in OTHER_SCANS}
        if any(file.suffix.lower() == ".csv" for file in found):
            others |= {file for file in listing if file.suffix.lower() == ".csv"} - set(found)
        unread = []
        if times:
            told = _listed(times)
            unread.append(
                f"{len(times)} .bin files hold numbers that ascend, such as times, no points: left out: {told}"
            )
        if others:
            told = _listed(others)
            unread.append(
                f"{counted(len(others), 'file is a scan|files are scans')} of another format, left out: "
                f"{told}: convert to PLY"
            )
        if not found:
            if tables := {file for file in listing if file.suffix.lower() in TABLES}:
                unread.append(
                    f"tables of points are read as .xyz, x y z first or named above the rows: {_listed(tables)}"
                )
            why = "; ".join(unread) or "give a folder of fragments"
            raise SourceError(f"{path}: no {', '.join(ENDINGS)} like {self.pattern!r} in it: {why}")
        notes += unread
        return sorted(found, key=lambda file: natural(file.name))

    def _raise_deg(self, files: list[Path], notes: list[str]) -> float:
        """By how much the points of `.bin` scans are raised; told where the scans themselves decide it."""
        if self.raise_deg != "auto":
            return self.raise_deg
        scans = [file for file in files if file.suffix.lower() == ".bin"]
        if not scans or not are_of_hdl64(scans):
            return 0.0
        notes.append(
            f"the angles of {len(scans)} .bin scans are those of KITTI's HDL-64E: their points are raised by "
            f"{KITTI_RAISE_DEG:g} degrees, the known error of its calibration (source.reader.raise_deg=0: not)"
        )
        return KITTI_RAISE_DEG

    def _log(self, folder: Path, notes: list[str]) -> Path | None:
        if not self.log:
            return None
        if self.log != "auto":
            return folder / self.log
        found = set(folder.glob("*.log"))
        logs = {file for file in found if begins_as_log(file)}
        if others := found - logs:
            notes.append(f"{_listed(others)}: left out: begins with no block of a Redwood .log (option log names one)")
        if len(logs) > 1:
            notes.append(f"{len(logs)} .log files, none taken: option log names one of {_listed(logs)}")
        return logs.pop() if len(logs) == 1 else None


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PlyWriter:
    """Writes the points of all frames as one PLY in the world frame."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """One file, atomically. Frames need points; those without a pose are refused where there are several."""
        frames = [frame for frame in source.frames if frame.read_points is not None]
        if not frames:
            raise SourceError(
                f"{source.path}: no frame with points: PLY holds points; fuse depth images with `hodge run`"
            )
        if len(frames) > 1 and any(frame.world_from_cam is None for frame in frames):
            raise SourceError(f"{source.path}: fragments without poses cannot become one cloud: register them first")
        clouds = [(frame.read_points(), frame.world_from_cam) for frame in frames if frame.read_points]
        coloured = all(cloud.colours is not None for cloud, _ in clouds)
        points = [
            se3.transform(np.eye(4) if pose is None else pose, cloud.points_in_cam.astype(float))
            for cloud, pose in clouds
        ]
        in_world, notes = _near_zero(np.concatenate(points))
        colours = (
            np.concatenate([cloud.colours for cloud, _ in clouds if cloud.colours is not None]) if coloured else None
        )
        write_ply(path, PointCloud(in_world, None, colours))
        what = f"{counted(len(in_world), 'point')} of {len(frames)} clouds as one"
        lost = left_out(sum(cloud.no_numbers for cloud, _ in clouds))
        return (*written(what, source, {"point clouds"}), *notes, *lost)


def _near_zero(points: Floats) -> tuple[Floats32, list[str]]:
    """Points (P, 3) as float32, and a note where whole kilometres are taken off: it has no room for map coordinates."""
    near, off = points.astype(np.float32), whole_kilometres(points)
    if not off.any() or np.array_equal(near, points):
        return near, []
    words = " ".join(f"{value:.0f}" for value in off)
    return (points - off).astype(np.float32), [f"points lie far from zero: they are counted from {words}"]


def _is_scan(path: Path) -> bool:
    """By its ending; `.bin` by its name as well, `.csv` by its first line, `.npy` by its header."""
    ending = path.suffix.lower()
    if ending == ".bin":
        return is_scan(path.name)
    return ending in ENDINGS and (ending not in TOLD_BY or TOLD_BY[ending](path))


def _listed(files: set[Path]) -> str:
    return listed(sorted(file.name for file in files))


def _require(path: Path) -> None:
    """Raise `SourceError` early where a file's library is not there, or its ending unknown."""
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise SourceError(f"{path}: not one of {', '.join(ENDINGS)}: convert it to PLY")
    if ending in LIBRARIES:
        library(LIBRARIES[ending], path)


def _scanners(paths: list[Path]) -> list[str]:
    """The names of the files with a * in place of the last number, where the same numbers come with several names; else
    nothing.
    """
    found = [(path, number) for path in paths if (number := _number(path.stem))]
    names = [f"{path.stem[: n.begin]}*{path.stem[n.end :]}{path.suffix}" for path, n in found]
    numbers = [number.value for _, number in found]
    each = set(zip(names, numbers, strict=True))
    return names if len(set(numbers)) < len(numbers) == len(each) == len(paths) else []


def _numbers(stems: list[str], notes: list[str]) -> list[float]:
    """The last number in each name, or the rows where one has none or two have the same."""
    numbers = [number.value for stem in stems if (number := _number(stem))]
    if len(numbers) == len(stems) == len(set(numbers)):
        return numbers
    if len(stems) > 1:
        notes.append("names without a number of their own: fragments are numbered in the order of their names")
    return [float(row) for row in range(len(stems))]


class _Number(NamedTuple):
    value: float
    begin: int
    end: int


def _number(stem: str) -> _Number | None:
    """The last number in a name and where it stands: in seconds, where it is a time since 1973."""
    clock, number = _CLOCK.search(stem), _NUMBER.search(stem)
    if clock:
        fraction = clock[3] if clock[2] == "." else f"{clock[3]:0>9}"
        return _Number(float(f"{clock[1]}.{fraction}"), clock.start(1), clock.end(3))
    if not number:
        return None
    count = int(number[1])
    return _Number(count / int(unit_of(np.array([count], float))[1]), number.start(1), number.end(1))


def _graph(names: Mapping[float, str], pairs: Any, i_from_j: Any, notes: list[str]) -> ViewGraph:
    row_of = {number: row for row, number in enumerate(names)}
    known = np.array([int(i) in row_of and int(j) in row_of for i, j in pairs], bool)
    if not known.all():
        notes.append(
            f"{counted(int((~known).sum()), 'pair')} of the log left out: it names fragments that are not there"
        )
    edges = np.array([(row_of[int(i)], row_of[int(j)]) for i, j in pairs[known]], np.int64).reshape(-1, 2)
    return ViewGraph.from_edges(np.array(list(names.values())), edges, i_from_j[known], source="log")

"""The point cloud of a frame, and those of all frames as memory-mapped columns."""

from __future__ import annotations

import mmap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.types.arrays import Bytes, Floats, Floats32, Ints
from hodge_pipeline.types.camera import Camera, camera_numbers, camera_of

CLOUDS_AT_ONCE = 64
"""Clouds read before their memory is given back: 4 to 15 MB."""


@dataclass(frozen=True)
class Landmarks:
    """SIFT features of a frame's image with depth, by which the place is recognised.

    `points_in_cam (n, 3)` metres, `descriptors (n, 128)` bytes, `pixel_rad (n,)`: the angle of a pixel, by which each
    point may be off sideways.
    """

    points_in_cam: Floats32
    descriptors: Bytes
    pixel_rad: Floats32

    def __len__(self) -> int:
        return len(self.points_in_cam)

    @classmethod
    def none(cls) -> Landmarks:
        """No landmark."""
        return cls(np.zeros((0, 3), np.float32), np.zeros((0, 128), np.uint8), np.zeros(0, np.float32))


@dataclass(frozen=True)
class PointCloud:
    """Points of one frame, in its camera's axes: `points_in_cam (N, 3)` metres, unit normals, 8-bit RGB.

    - `landmarks`: features of the frame's image, None where they were not asked for.
    - `times_s (N,)`: when a scanner measured each point, seconds after the first; None where unknown.
    - `first_s`: the time of the first point as the sensor counts it, by a clock or after the frame's stamp.
    - `no_numbers`: how many points the reader left out, since their coordinates are no numbers.
    - `depth_camera`: that of the depth image that the points come from; None of a scan.
    """

    points_in_cam: Floats32
    normals_in_cam: Floats32 | None = None
    colours: Bytes | None = None
    landmarks: Landmarks | None = None
    times_s: Floats32 | None = None
    first_s: float = 0.0
    no_numbers: int = 0
    depth_camera: Camera | None = None

    def __len__(self) -> int:
        return len(self.points_in_cam)


class CloudSet(Sequence[PointCloud]):
    """The down-sampled cloud of every frame, as memory-mapped columns: opening one costs no copy.

    `offsets (N + 1,)` cut `points (P, 3)`, `normals (P, 3)`, `colours (P, 3)` into frames; an empty slice is a frame
    without a valid measurement. `cameras (N, 6)` are those of their depth images, as `camera_numbers`.
    `marks (N + 1,)` cut the landmarks' `mark_points (Q, 3)`, `mark_descriptors (Q, 128)`
    and `mark_pixel_rad (Q,)` likewise. `stored_in` is the folder of the columns; None of what is in memory.
    """

    OF_POINTS = ("offsets", "points", "normals", "colours", "cameras")
    FILES = (*OF_POINTS, "marks", "mark_points", "mark_descriptors", "mark_pixel_rad")

    def __init__(
        self,
        offsets: Ints,
        points: Floats32,
        normals: Floats32,
        colours: Bytes,
        cameras: Floats,
        marks: Ints,
        mark_points: Floats32,
        mark_descriptors: Bytes,
        mark_pixel_rad: Floats32,
        folder: Path | None = None,
    ) -> None:
        self.stored_in, self._reads = folder, 0
        self.offsets, self.points, self.normals, self.colours = offsets, points, normals, colours
        self.cameras = cameras
        self.marks, self.mark_points, self.mark_descriptors = marks, mark_points, mark_descriptors
        self.mark_pixel_rad = mark_pixel_rad

    @classmethod
    def open(cls, folder: Path) -> CloudSet:
        """The clouds that `save` wrote to this folder, mapped read-only."""
        return cls(**{name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in cls.FILES}, folder=folder)

    @classmethod
    def write(cls, folder: Path, parts: Iterable[CloudSet]) -> CloudSet:
        """The clouds of all parts as one set, written into a folder part by part and opened there."""
        folder.mkdir(exist_ok=True)
        nothing = cls.from_clouds([])
        with ExitStack() as stack:
            files = {
                name: stack.enter_context(_Column(folder / f"{name}.npy", getattr(nothing, name))) for name in cls.FILES
            }
            for part in parts:
                begin = {"offsets": files["points"].rows, "marks": files["mark_points"].rows}
                for name, file in files.items():
                    column = getattr(part, name)
                    file.append(column[1:] + begin[name] if name in begin else column)
        return cls.open(folder)

    @classmethod
    def from_clouds(cls, clouds: Sequence[PointCloud]) -> CloudSet:
        """One set of these clouds, in order; missing normals and colours become zeros, missing landmarks none."""
        empty = np.zeros((0, 3), np.float32)
        normals = [np.zeros((len(c), 3)) if c.normals_in_cam is None else c.normals_in_cam for c in clouds]
        colours = [np.zeros((len(c), 3)) if c.colours is None else c.colours for c in clouds]
        landmarks = [Landmarks.none() if c.landmarks is None else c.landmarks for c in clouds]
        return cls(
            _offsets([len(cloud) for cloud in clouds]),
            np.concatenate([empty, *(c.points_in_cam for c in clouds)]).astype(np.float32),
            np.concatenate([empty, *normals]).astype(np.float32),
            np.concatenate([empty, *colours]).astype(np.uint8),
            np.array([camera_numbers(c.depth_camera) for c in clouds], float).reshape(-1, 6),
            _offsets([len(one) for one in landmarks]),
            np.concatenate([empty, *(one.points_in_cam for one in landmarks)]).astype(np.float32),
            np.concatenate([Landmarks.none().descriptors, *(one.descriptors for one in landmarks)]),
            np.concatenate([Landmarks.none().pixel_rad, *(one.pixel_rad for one in landmarks)]).astype(np.float32),
        )

    def save(self, folder: Path) -> None:
        """Write the columns into a folder, one `.npy` each."""
        CloudSet.write(folder, [self])

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __repr__(self) -> str:
        return f"CloudSet({len(self)} clouds, {int(self.offsets[-1])} points)"

    def __getitem__(self, row: int) -> PointCloud:  # type: ignore[override]
        """The cloud of one frame, a view; every `CLOUDS_AT_ONCE` reads the memory is given back."""
        if not -len(self) <= row < len(self):
            raise IndexError(row)
        self._reads += 1
        if self._reads % CLOUDS_AT_ONCE == 0:
            self.forget()
        row %= len(self)
        cut = slice(int(self.offsets[row]), int(self.offsets[row + 1]))
        own = slice(int(self.marks[row]), int(self.marks[row + 1]))
        landmarks = Landmarks(self.mark_points[own], self.mark_descriptors[own], self.mark_pixel_rad[own])
        points, normals, colours = self.points[cut], self.normals[cut], self.colours[cut]
        return PointCloud(points, normals, colours, landmarks, depth_camera=camera_of(self.cameras[row]))

    def read(self, rows: Iterable[int]) -> Iterator[PointCloud]:
        """The clouds of these rows one after another."""
        return map(self.__getitem__, rows)

    def forget(self) -> None:
        """Give back the memory of what was read of the files; it is read again when it is needed."""
        for name in self.FILES:
            column = getattr(self, name)
            if isinstance(column, np.memmap) and hasattr(mmap, "MADV_DONTNEED"):
                column._mmap.madvise(mmap.MADV_DONTNEED)  # type: ignore[attr-defined]

    @property
    def folder(self) -> Path:
        """Where the columns lie, for worker processes to open; not of clouds in memory."""
        assert self.stored_in is not None, "clouds in memory have no folder: save them first"
        return self.stored_in

    @property
    def sizes(self) -> Ints:
        """Points of each cloud, (N,)."""
        return np.diff(self.offsets)

    @property
    def reach_m(self) -> float:
        """Metres from a camera to the farthest point of its cloud, over all clouds; 1 where there is no point."""
        return max((float(np.linalg.norm(c.points_in_cam, axis=1).max()) for c in self if len(c)), default=0.0) or 1.0


class _Column:
    """A context that writes an array to a `.npy` file in parts, the first being `first`, and its header at the end."""

    def __init__(self, path: Path, first: NDArray[Any]) -> None:
        path.unlink(missing_ok=True)  # a hard link to a file that is kept must not be written to
        self._file, self._first, self.rows = path.open("wb"), first, 0

    def __enter__(self) -> _Column:
        self._write_header()
        self.append(self._first)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        with self._file:
            if error is None:
                self._write_header()

    def append(self, rows: NDArray[Any]) -> None:
        """Write more rows; not by `tofile`, which loses the last bytes on a full disk without an error."""
        self._file.write(np.ascontiguousarray(rows, self._first.dtype).data)
        self.rows += len(rows)

    def _write_header(self) -> None:
        """Write the header over the last one: it has the same length for any number of rows."""
        shape = (self.rows, *self._first.shape[1:])
        self._file.seek(0)
        np.lib.format.write_array_header_1_0(
            self._file, {**np.lib.format.header_data_from_array_1_0(self._first), "shape": shape}
        )


def _offsets(sizes: Sequence[int]) -> Ints:
    """Where (N + 1,) parts of these sizes begin, and the last ends."""
    return np.concatenate([[0], np.cumsum(np.array(sizes, np.int64))]).astype(np.int64)

"""From a frame to its down-sampled cloud with normals, and what is odd about it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import small_gicp
from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.voxel_means import voxel_means
from hodge_pipeline.types import Bytes, Camera, CloudSet, Floats32, Frame, Landmarks, PointCloud
from hodge_pipeline.types.arrays import middles_in
from hodge_pipeline.types.text import counted

MIN_POINTS_FOR_NORMALS = 5
"""Three lie in a plane whatever they are."""
NORMAL_NEIGHBOURS = 10
"""In the plane fit of a normal: as in the paper."""
MANY_POINTS = 5_000_000
"""Measurements of a frame from which it is told that the cloud keeps fewer: more than a depth image has."""
MAP_AWAY = 10.0
"""A cloud whose median range is this many times its extent is in map coordinates, not in the sensor's axes."""
MAX_VOXELS_ALONG_AXIS = 2_000_000
"""Its cube still fits the 64-bit key of a voxel."""
BLANK_LEVELS = 6
"""Grey levels of 255 that a blank image spans at most: a covered camera's span 5 with a noise of 2 levels. Images of
fr1/rpy, fr1/xyz, red kitchen, ICL-NUIM and rendered rooms span 113 and more, 11 at a tenth of their brightness."""
FEW_PIXELS = 0.02
"""Share of the pixels ignored at either end of that span: the black rim of an undistorted image is a hundredth."""
BLANK_STRIDE = 4
"""Every so many rows and columns are tested."""
REACH_QUANTILE, REACH_POINTS = 0.99, 100_000
"""The reach of a scan is that of 99 % of its points, told by so many."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class CloudOptions:
    """How a frame becomes a cloud."""

    stride: int = Field(
        default=2,
        ge=1,
        description="Pixels; every n-th row and column, or, of an image too coarse for that, as many as keep the "
        "voxels filled up to the end of the range: with 3 cm and 6 m every 2nd of 640 pixels, all of 320.",
    )
    min_range_m: float = Field(
        default=0.2, ge=0, description="Metres along the optical axis; nearer is the sensor's blind zone."
    )
    max_range_m: float = Field(
        default=6.0, gt=0, description="Metres; beyond it the error of a structured-light sensor passes 5 cm."
    )
    voxel_m: float = Field(
        default=0.03, gt=0, description="Metres; one averaged point per voxel. 0.03 as in the paper."
    )
    colours: bool = Field(default=True, description="Whether colours are read too; the coloured registrars need them.")
    landmarks: int = Field(
        default=0,
        ge=0,
        description="SIFT landmarks of a frame, at most, the strongest; `rgbd` needs them, 800 serve it. About 30 ms a "
        "frame; 0: none",
    )
    unit_m: float = Field(
        default=1.0,
        gt=0,
        description="length units of the source per metre, set by `scale`: the noise of pixels and depth is known in "
        "metres",
    )

    @model_validator(mode="after")
    def _check_ranges(self) -> CloudOptions:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m} must be below max_range_m {self.max_range_m}")
        if 2 * self.max_range_m / self.voxel_m > MAX_VOXELS_ALONG_AXIS:
            raise ValueError(f"voxel_m {self.voxel_m} is too small for max_range_m {self.max_range_m}")
        return self

    def stride_of(self, camera: Camera) -> int:
        """The stride, in rows and columns, at which this camera's depth images are sampled."""
        return min(self.stride, max(1, round(abs(camera.fx) * self.voxel_m / self.max_range_m)))


class Oddity(NamedTuple):
    """What is odd about a frame's cloud: `what`, the same words for all frames alike, and `why`."""

    frame: int | str
    what: str
    why: str = ""

    def __str__(self) -> str:
        return f"frame {self.frame}: {self.what}{self.why and ': '}{self.why}"


class CloudCounts(NamedTuple):
    """What became of a frame: measurements looked at, those valid and in range; what is odd, whether its image is
    `blank`, how many points of a scan are no returns, and its reach in metres, NaN for a depth image.
    """

    looked_at: int
    valid: int
    odd: Oddity | None = None
    blank: bool = False
    no_returns: int = 0
    reach_m: float = float("nan")


class _Samples(NamedTuple):
    points_in_cam: Floats32
    colours: Bytes | None
    counts: CloudCounts
    why_none: str


def make_cloud(frame: Frame, options: CloudOptions) -> tuple[PointCloud, CloudCounts]:
    """The down-sampled cloud of one frame, in voxel order, and what was counted on the way.

    Normals are unit vectors that face the camera, zero where fewer than 5 points are there; colours are averaged,
    zero where the frame has none. Raises `SourceError` where depth cannot be read or the frame has no geometry.
    """
    samples = _read_samples(frame, options)
    points, colours = voxel_means(samples.points_in_cam, samples.colours, options.voxel_m)
    camera, counts = None if frame.read_depth is None else frame.camera, samples.counts
    cloud = PointCloud(points, _normals(points), colours, _landmarks(frame, options), depth_camera=camera)
    if not len(points):
        odd = Oddity(frame.frame_id, "no valid measurement in range, its cloud is empty", samples.why_none)
        return cloud, counts._replace(odd=odd)
    if counts.looked_at > MANY_POINTS:
        kept = f"{counted(counts.looked_at, 'point')} to {len(points)}, one a voxel of {options.voxel_m:.3g} m"
        return cloud, counts._replace(odd=Oddity(frame.frame_id, "down-sampled in parts", kept))
    return cloud, counts


def landmarks_of(options: CloudOptions, frames: Sequence[Frame]) -> CloudSet:
    """Clouds without points that have the landmarks of each frame of a block."""
    no_points = np.zeros((0, 3), np.float32)
    return CloudSet.from_clouds([PointCloud(no_points, landmarks=_landmarks(frame, options)) for frame in frames])


def _landmarks(frame: Frame, options: CloudOptions) -> Landmarks:
    """The frame's landmarks; none where they are not wanted, or it has no image that can be read."""
    if not options.landmarks:
        return Landmarks.none()
    from hodge_pipeline.registration.landmarks import find_landmarks

    try:
        return find_landmarks(frame, options.landmarks, options.min_range_m, options.max_range_m)
    except (SourceError, OSError):  # reported where the colours are read
        return Landmarks.none()


def is_blank(image: Bytes) -> bool:
    """Whether an image, (H, W) or (H, W, 3), is black or of one even colour, but for `FEW_PIXELS`.

    Zeros are ignored where they are fewer than half of the pixels: the rim of an undistorted image.
    """
    pixels = image[::BLANK_STRIDE, ::BLANK_STRIDE]
    for levels in pixels.reshape(pixels.shape[0] * pixels.shape[1], -1).T:
        below = np.bincount(levels).cumsum()
        below -= below[0] if 2 * below[0] < below[-1] else 0
        darkest, brightest = np.searchsorted(below, (FEW_PIXELS * below[-1], (1 - FEW_PIXELS) * below[-1]))
        if brightest - darkest > BLANK_LEVELS:
            return False
    return True


def cloud_or_note(frame: Frame, options: CloudOptions) -> tuple[PointCloud, str]:
    """The cloud of a frame and a note, empty where all is well; an empty cloud where it cannot be read."""
    cloud, counts = make_or_report(frame, options)
    return cloud, "" if counts.odd is None else str(counts.odd)


def make_or_report(frame: Frame, options: CloudOptions) -> tuple[PointCloud, CloudCounts]:
    """The cloud as of `make_cloud`; an empty one, and why, where the frame cannot be read."""
    try:
        return make_cloud(frame, options)
    except (SourceError, OSError) as error:
        odd = Oddity(frame.frame_id, "its cloud is empty", str(error))
        return PointCloud(np.zeros((0, 3), np.float32)), CloudCounts(0, 0, odd)


def _read_samples(frame: Frame, options: CloudOptions) -> _Samples:
    if frame.read_depth is not None and frame.camera is not None:
        return _back_project(frame, frame.read_depth, frame.camera, options)
    if frame.read_points is not None:
        return _sensor_points(frame.read_points(), options)
    raise SourceError(f"frame {frame.frame_id}: it has neither depth with a camera nor points")


def _back_project(frame: Frame, read_depth: Callable[[], Floats32], camera: Camera, options: CloudOptions) -> _Samples:
    depth, stride = read_depth(), options.stride_of(camera)
    z = depth[::stride, ::stride]
    kept = (z >= options.min_range_m) & (z <= options.max_range_m)  # false for NaN
    rows, columns = np.nonzero(kept)
    z_kept = z[kept].astype(np.float32)
    v, u = (np.arange(side) * stride for side in z.shape)
    x = ((u - camera.cx) / camera.fx).astype(np.float32)[columns] * z_kept
    y = ((v - camera.cy) / camera.fy).astype(np.float32)[rows] * z_kept
    colours, odd, blank = None, None, False
    if options.colours and frame.read_colour is not None and len(rows):
        try:
            image = frame.read_colour()
            v, u = middles_in(image.shape[0], v, len(depth)), middles_in(image.shape[1], u, depth.shape[1])
            colours = image.reshape(-1, 3).take(v[rows] * image.shape[1] + u[columns], axis=0)
            blank = is_blank(image)
        except (SourceError, OSError) as error:
            odd = Oddity(frame.frame_id, "its cloud has no colours", str(error))
    why_none = "" if len(rows) else _range_advice(z, "depth_scale", options)
    return _Samples(np.stack([x, y, z_kept], axis=1), colours, CloudCounts(z.size, len(rows), odd, blank), why_none)


def _sensor_points(cloud: PointCloud, options: CloudOptions) -> _Samples:
    kept = in_range(cloud, options)
    colours = kept.colours if options.colours else None
    why_none = "" if len(kept) else out_of_range(cloud, options)
    zeros = 0 if len(kept) == len(cloud) else int((~(_ranges(cloud) > 0)).sum())  # true for NaN
    lost, points = zeros + cloud.no_numbers, np.asarray(kept.points_in_cam, np.float32)
    looked_at, reach = len(cloud) + cloud.no_numbers, reach_m(cloud)
    return _Samples(points, colours, CloudCounts(looked_at, len(points), no_returns=lost, reach_m=reach), why_none)


def reach_m(cloud: PointCloud) -> float:
    """Metres within which `REACH_QUANTILE` of the points of a scan are, before any is left out for its range; NaN where
    there is none.
    """
    ranges = _ranges(cloud)[:: max(1, len(cloud) // REACH_POINTS)]
    ranges = ranges[np.isfinite(ranges) & (ranges > 0)]
    return float(np.quantile(ranges, REACH_QUANTILE)) if len(ranges) else float("nan")


def in_range(cloud: PointCloud, options: CloudOptions) -> PointCloud:
    """The points in range of a scanner, which sees all round: by distance, not by depth, 0 for no return."""
    ranges = _ranges(cloud)
    kept = (ranges > 0) & (ranges >= options.min_range_m) & (ranges <= options.max_range_m)  # false for NaN
    if kept.all():  # no copy of what may be large
        return cloud
    return replace(
        cloud,
        points_in_cam=cloud.points_in_cam[kept],
        normals_in_cam=None if cloud.normals_in_cam is None else cloud.normals_in_cam[kept],
        colours=None if cloud.colours is None else cloud.colours[kept],
        times_s=None if cloud.times_s is None else cloud.times_s[kept],
    )


def out_of_range(cloud: PointCloud, options: CloudOptions) -> str:
    """Why no point is in range and what to do: points may be in millimetres, or in map coordinates."""
    ranges = _ranges(cloud)
    finite = np.isfinite(ranges) & (ranges > 0)
    points, usual = cloud.points_in_cam[finite], float(np.median(ranges[finite])) if finite.any() else 0.0
    spread_m = float(np.ptp(np.quantile(points, (0.05, 0.95), axis=0), axis=0).max()) if finite.any() else 0.0
    if usual > max(options.max_range_m, MAP_AWAY * spread_m):
        rounding_m = float(np.spacing(np.float32(usual)))
        return (
            f"its points lie {usual:.3g} m away, all near each other: map coordinates? Subtract one corner from all "
            f"scans, in double precision, and write them again: float32 rounds them to {rounding_m:.2g} m there"
        )
    return _range_advice(ranges, "units_per_metre", options)


def _range_advice(ranges: Floats32, option: str, options: CloudOptions) -> str:
    """Why no depth, or range, is within the limits; `option` is the reader's that sets their unit."""
    finite = ranges[np.isfinite(ranges) & (ranges > 0)]
    if not len(finite):
        return "there is no point in it"
    usual = float(np.median(finite))
    limits = f"{options.min_range_m:g} to {options.max_range_m:g} m"
    units = f"source.reader.{option}"
    unit = (
        f" (millimetres? then {units}=1000; centimetres: 100)"
        if usual > 1000 * options.min_range_m
        else f" (is {units} right?)"
    )
    return f"its points lie {usual:.3g} m away, in range are {limits}{unit}"


def _ranges(cloud: PointCloud) -> Floats32:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.linalg.norm(np.asarray(cloud.points_in_cam, np.float32), axis=1))


def _normals(points: Floats32) -> Floats32:
    if len(points) < MIN_POINTS_FOR_NORMALS:
        return np.zeros((len(points), 3), np.float32)
    cloud = small_gicp.PointCloud(points.astype(np.float64))
    small_gicp.estimate_normals(cloud, small_gicp.KdTree(cloud), min(NORMAL_NEIGHBOURS, len(points)))
    normals = np.asarray(cloud.normals())[:, :3]
    away = np.einsum("ij,ij->i", normals, points) > 0
    return np.where(away[:, None], -normals, normals).astype(np.float32)

"""Which of several cameras took a sequence: the one of least reprojection error between pairs of frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hodge_adapters.images import pixels
from hodge_adapters.images.camera_files import Intrinsics
from hodge_pipeline.errors import CameraError, SourceError
from hodge_pipeline.types import Bools, Bytes, Floats, Floats32
from hodge_pipeline.types.notes import Note

PAIRS, SPAN_S, HOPS = 24, 0.35, 3
"""Pairs of frames, evenly over the sequence; seconds between their two frames; hops of optical flow between them."""
CORNERS, CORNER_QUALITY, CORNERS_APART_PX, BACKWARD_PX = 400, 0.005, 8.0, 0.7
"""Corners of a frame, at most; the weakest as a share of the strongest; pixels between two; and how near to its
beginning a corner that is followed back must end. Half or twice each, the same cameras surely fit fr1/xyz better; twice
the corners take half as much time again.
"""
FEWEST_CORNERS, FEWEST_PAIRS = 60, 6
"""Ten to each unknown of a motion; with six pairs `SURE` is passed by chance in 3.6 % of cases (Student's t)."""
RANGE_M, EDGE_STEP = (0.3, 5.0), 0.03
"""Where a Kinect measures; and the share of its depth by which the 3x3 pixels of a corner differ at most: others lie on
an edge.
"""
LARGEST_PX = 3.0
"""Cap on a reprojection error, and the gate of inliers."""
SURE = 2.5
"""Standard errors of the mean over the pairs by which a camera must fit better."""
TOLD = 0.95
"""Share of the pairs in which a camera must fit better than a rival: errors that all pairs share, such as those of a
rolling shutter, do not average out. Of fr1/xyz and fr1/rpy 0.75 and 0.65 fit fr2's better.
"""
FOCALS = tuple(0.4 * 1.12**k for k in range(13))
"""Focal lengths over the width of the image, from 103 to 35 degrees across."""
UNSTAMPED_STEP_S = 0.1
"""Assumed step of images without stamps, every third of a video; where they are farther apart, flow fails."""
OTHER_FOCAL = 0.1
"""Relative error of an assumed focal length that is a doubt: of four known cameras images tell it to 4 %."""


@dataclass(frozen=True)
class CameraFit:
    """`gain`: by which share a camera's error is below that of the standard one; `beaten`: the share of pairs of frames
    in which the best camera fits better than this one.
    """

    gain: float
    beaten: float = 0.0


@dataclass(frozen=True)
class Followed:
    """Corners in two frames: pixels (n, 2), and depths (n,) in metres, NaN where there is none that is sound."""

    first: Floats32
    first_m: Floats
    second: Floats32
    second_m: Floats


def fitting(
    cameras: Mapping[str, Intrinsics],
    standard: str,
    depth: Sequence[Path],
    colour: Sequence[Path | None],
    stamps_s: Floats,
    units_per_metre: float,
) -> dict[str, CameraFit]:
    """The cameras that surely fit better than the `standard` one, the best first."""
    errors = _errors(list(cameras.values()), depth, colour, stamps_s, units_per_metre)
    if len(errors) < FEWEST_PAIRS:
        return {}
    names = list(cameras)
    gain = errors[:, [names.index(standard)]] - errors
    better = [k for k in range(len(names)) if _surely_positive(gain[:, k])]
    better.sort(key=lambda k: -float(gain[:, k].mean()))
    beaten = {k: float((gain[:, better[0]] > gain[:, k]).mean()) for k in better}
    return {names[k]: CameraFit(float(-np.expm1(-gain[:, k].mean())), beaten[k]) for k in better}


def untold_camera_doubts(fits: Mapping[str, CameraFit]) -> tuple[Note, ...]:
    """A doubt where other cameras fit nearly as often as the best of them: by `beaten` below `TOLD`."""
    rivals = {name: fit for name, fit in list(fits.items())[1:] if fit.beaten < TOLD}
    if not rivals:
        return ()
    best = next(iter(fits))
    options = " or ".join(f"source.reader.camera={name}" for name in rivals)
    shares = " and ".join(f"{100 * fit.beaten:.0f} %" for fit in rivals.values())
    doubt = f"the camera may be {' or '.join(rivals)} in place of {best}: set {options} if it was"
    return (Note("reader's doubt", detail=f"{doubt}; {best} fits better in only {shares} of the pairs of frames"),)


def assumed_camera_doubts(
    taken: Intrinsics, depth: Sequence[Path], colour: Sequence[Path | None], stamps_s: Floats, units_per_metre: float
) -> tuple[Note, ...]:
    """A doubt unless images confirm the focal length of an assumed camera to within `OTHER_FOCAL`.

    Raises `CameraError`, with the estimated focal length, where the images have another aspect ratio than the camera.
    """
    size = pixels.common_size(depth)
    told = focal_px(size, depth, colour, stamps_s, units_per_metre)
    centre = size[0] / 2 - 0.5, size[1] / 2 - 0.5
    camera = f"[{told:.0f},{told:.0f},{centre[0]:g},{centre[1]:g}]" if told else "[fx,fy,cx,cy]"
    fits = f"; a focal length of about {told:.0f} pixels fits the images best" if told else ""
    width, height = taken.size or size
    if not pixels.same_shape((width, height), size):
        raise CameraError(
            f"{depth[0].parent}: images of {size[0]}x{size[1]}, but intrinsics of {width}x{height}{fits}", size, camera
        )
    mine = taken.fx * size[0] / width
    if told is not None and abs(told / mine - 1) < OTHER_FOCAL:
        return ()
    doubt = f"a camera of focal length {mine:g} is assumed{fits or ', which the images do not test'}"
    remedy = f"give those of your camera with --set source.reader.camera={camera}"
    return (Note("reader's doubt", detail=f"{doubt}: {remedy}"),)


def focal_px(
    size: tuple[int, int],
    depth: Sequence[Path],
    colour: Sequence[Path | None],
    stamps_s: Floats,
    units_per_metre: float,
) -> float | None:
    """The focal length of least reprojection error, in pixels of images of this (width, height); None without a clear
    minimum, as of a camera at rest.
    """
    width, height = size
    centre = width / 2 - 0.5, height / 2 - 0.5
    cameras = [Intrinsics(f * width, f * width, *centre, size) for f in FOCALS]
    errors = _errors(cameras, depth, colour, stamps_s, units_per_metre)
    best = int(errors.mean(axis=0).argmin()) if len(errors) >= FEWEST_PAIRS else 0
    sides = [best - 2, best + 2]
    if (
        sides[0] < 0
        or sides[1] >= len(FOCALS)
        or not all(_surely_positive(errors[:, k] - errors[:, best]) for k in sides)
    ):
        return None
    below, least, above = errors[:, best - 1 : best + 2].mean(axis=0)
    shift = 0.5 * (below - above) / (below - 2 * least + above)
    return float(width * FOCALS[best] * (FOCALS[1] / FOCALS[0]) ** shift)


def _errors(
    cameras: Sequence[Intrinsics],
    depth: Sequence[Path],
    colour: Sequence[Path | None],
    stamps_s: Floats,
    units_per_metre: float,
) -> Floats:
    """Logarithms of the misfit (pairs, cameras), of the pairs that have one under every camera."""
    pairs = _pairs(depth, colour, stamps_s, units_per_metre)
    errors = np.array([[_misfit(camera, pair) for camera in cameras] for pair in pairs]).reshape(-1, len(cameras))
    found: Floats = np.log(errors[np.isfinite(errors).all(axis=1)])
    return found


def _surely_positive(values: Floats) -> bool:
    return bool(values.mean() > SURE * values.std() / np.sqrt(len(values)))


def _pairs(
    depth: Sequence[Path], colour: Sequence[Path | None], stamps_s: Floats, units_per_metre: float
) -> Iterator[Followed]:
    usual_s = float(np.median(np.diff(stamps_s))) if len(stamps_s) > 1 else 0.0
    reach = int(np.clip(round(SPAN_S / usual_s), 1, 30)) if 0 < usual_s < 1 else 1
    last = len(stamps_s) - 1 - reach
    for first in np.unique(np.linspace(0, last, PAIRS).astype(int)).tolist() if last >= 0 else []:
        between = np.unique(np.linspace(first, first + reach, HOPS + 1).astype(int)).tolist()
        try:
            followed = _followed(
                [_grey(colour[row]) for row in between],
                [pixels.read_depth(depth[row], units_per_metre=units_per_metre) for row in (first, between[-1])],
            )
        except (SourceError, OSError):
            continue
        if followed is not None:
            yield followed


def _grey(path: Path | None) -> Bytes:
    if path is None:
        raise SourceError("a depth image without a colour image")
    return np.asarray(cv2.cvtColor(pixels.read_colour(path), cv2.COLOR_RGB2GRAY), np.uint8)


def _followed(greys: Sequence[Bytes], depths: Sequence[Floats32]) -> Followed | None:
    """Corners of the first image followed from image to image; None where few arrive."""
    found = cv2.goodFeaturesToTrack(greys[0], CORNERS, CORNER_QUALITY, CORNERS_APART_PX)
    if found is None:
        return None
    first = np.asarray(found, np.float32).reshape(-1, 2)
    now, arrives = first, np.ones(len(first), bool)
    for one, other in zip(greys[:-1], greys[1:], strict=True):
        ends, there = _flow(one, other, now)
        back, here = _flow(other, one, ends)
        arrives &= there & here & (np.abs(back - now) < BACKWARD_PX).all(axis=1)
        now = ends
    if arrives.sum() < FEWEST_CORNERS:
        return None
    first, now = first[arrives], now[arrives]
    return Followed(first, _depth_at(depths[0], first), now, _depth_at(depths[1], now))


def _flow(one: Bytes, other: Bytes, pixels: Floats32) -> tuple[Floats32, Bools]:
    start = pixels[:, None].copy()
    ends, status, _ = cv2.calcOpticalFlowPyrLK(one, other, pixels[:, None], start, winSize=(21, 21), maxLevel=4)
    return np.asarray(ends, np.float32).reshape(-1, 2), np.asarray(status).reshape(-1) == 1


def _depth_at(depth: Floats32, pixels: Floats32) -> Floats:
    u, v = np.clip(np.round(pixels).astype(int), 1, np.array(depth.shape[::-1]) - 2).T
    window = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=1).astype(float)
    middle, low, high = np.median(window, axis=1), window.min(axis=1), window.max(axis=1)
    sound = (low >= RANGE_M[0]) & (high <= RANGE_M[1]) & (high - low <= EDGE_STEP * middle)
    return np.where(sound, middle, np.nan)


def _misfit(camera: Intrinsics, pair: Followed) -> float:
    """RMS error in pixels of the corners under the best rigid motion, from either frame; NaN where there is none."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    lens = np.array(camera.distortion or np.zeros(5))
    first, second = (
        np.asarray(cv2.undistortPoints(pixels[:, None].astype(float), matrix, lens), float).reshape(-1, 2)
        for pixels in (pair.first, pair.second)
    )
    focal_px = float(np.sqrt(camera.fx * abs(camera.fy)))
    errors = [
        _motion_error(first, pair.first_m, second, focal_px),
        _motion_error(second, pair.second_m, first, focal_px),
    ]
    return float(np.sqrt(np.mean(np.square(errors))))


def _motion_error(slopes: Floats, depth_m: Floats, seen: Floats, focal_px: float) -> float:
    known = np.isfinite(depth_m)
    if known.sum() < FEWEST_CORNERS // 2:
        return float("nan")
    points = np.column_stack([slopes[known], np.ones(known.sum())]) * depth_m[known, None]
    seen, eye = seen[known], np.eye(3)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points, seen, eye, None, iterationsCount=300, reprojectionError=LARGEST_PX / focal_px, flags=cv2.SOLVEPNP_EPNP
    )
    if not found or inliers is None:
        return float("nan")
    rows = inliers.ravel()
    errors = np.zeros(0)
    for _ in range(3):
        if len(rows) < FEWEST_CORNERS // 3:
            return float("nan")
        turn, shift = cv2.solvePnPRefineLM(points[rows], seen[rows], eye, None, turn, shift)
        projected = cv2.projectPoints(points, turn, shift, eye, None)[0].reshape(-1, 2)
        errors = focal_px * np.linalg.norm(projected - seen, axis=1)
        rows = np.flatnonzero(errors < LARGEST_PX)
    return float(np.sqrt(np.mean(np.minimum(errors, LARGEST_PX) ** 2)))

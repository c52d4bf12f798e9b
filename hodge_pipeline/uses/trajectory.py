"""Refine a trajectory from Python: arrays, Open3D objects or files in, the same kind out."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.refine.guard import Decision
from hodge_pipeline.refine.open3d_objects import poses_of, with_poses
from hodge_pipeline.report.contents import Report
from hodge_pipeline.sources.inspect import guess_reader, guesses
from hodge_pipeline.store.progress import Watcher
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32, Frame, Source
from hodge_pipeline.uses.recipe_run import run as recipe_run

Array = TypeVar("Array")

RECIPE, SCANS = "slam_refine", "slam_refine_scans"
CALIBRATED = {"tum": "slam_refine_tum"}
"""Recipes for the readers of formats whose depth and colour are calibrated to each other, where landmarks measure."""
FARTHEST_M = 200.0
"""Median depth that no sensor has; a room in millimetres has 1000 and more."""


@dataclass(frozen=True)
class RefinedTrajectory:
    """`poses` of the type that was given (array (N, 4, 4), or Open3D's trajectory), the decision and the report.

    Where the decision keeps the input, `poses` is the very object that was given.
    """

    poses: Any
    decision: Decision
    report: Report


def frames_from_images(
    depths_m: Sequence[Floats32],
    camera: Camera | Floats,
    colours: Sequence[Bytes] | None = None,
    stamps_s: Sequence[float] | None = None,
) -> tuple[Frame, ...]:
    """Frames of images in memory: depths (H, W) in metres, 0 where there is none, and RGB colours (H, W, 3), 8 bit.

    `camera`: a `Camera`, or the matrix K (3, 3), as Open3D's `intrinsic.intrinsic_matrix`. Without `stamps_s` frames
    are one second apart. Raises `SourceError` for depth that is not metres, images of other sizes and a wrong camera.
    """
    if not len(depths_m):
        raise SourceError("no depth image given: refinement needs what the frames saw")
    check_depths(depths_m)
    height, width = np.shape(depths_m[0])
    camera = camera_of(camera, height, width)
    check_colours(colours, len(depths_m), (height, width))
    if stamps_s is not None and len(stamps_s) != len(depths_m):
        raise SourceError(f"{len(stamps_s)} stamps for {len(depths_m)} depth images: give one for each")
    return tuple(
        Frame(
            frame_id=row,
            stamp_s=float(row if stamps_s is None else stamps_s[row]),
            camera=camera,
            read_depth=partial(_same, np.asarray(depth, np.float32)),
            read_colour=None if colours is None else partial(_same, np.asarray(colours[row], np.uint8)),
        )
        for row, depth in enumerate(depths_m)
    )


def refine_trajectory(
    poses: Any,
    frames: Path | str | Sequence[Frame],
    *,
    out: Path | str | None = None,
    force: bool = False,
    recipe: str = "",
    overrides: Sequence[str] = (),
    watcher: Watcher | None = None,
    dask: str | None = None,
) -> RefinedTrajectory:
    """A trajectory refined by the frames that it belongs to, one pose for each frame.

    - `poses`: world_from_cam (N, 4, 4), NaN where unknown, or an `open3d.camera.PinholeCameraTrajectory`.
    - `frames`: a path that a reader opens, or frames (see `frames_from_images`).
    - `recipe`: slam_refine, slam_refine_tum or slam_refine_scans; by default the one that suits the frames.
    - `out`: the run folder with report and recording; by default none is kept. `force` writes a worse result too.
    - `dask` is as of `run`.

    `hodge refine trajectory` takes files of poses. Raises `HodgeError` (see `errors`) for whatever the user can mend.
    """
    open3d = not isinstance(poses, (np.ndarray, list, tuple))
    given = poses_of(poses) if open3d else np.asarray(poses, float)
    source = _source(frames, given)
    chosen = recipe or (recipe_for(Path(frames), source) if isinstance(frames, (str, Path)) else recipe_of(frames))
    ours = ["start.stage=given", f"guard.force={str(force).lower()}"]
    loaded = load_recipe(chosen, [*ours, *overrides])
    with tempfile.TemporaryDirectory(prefix="hodge-refine-") as scratch:
        folder = Path(scratch) / "run" if out is None else Path(out)
        run = recipe_run(loaded, folder, source=source, watcher=watcher, dask=dask)
    assert run.refined is not None
    decision = run.refined.decision
    if decision.keeps_input:
        return RefinedTrajectory(poses, decision, run.report)
    found = run.refined.world_from_cam
    return RefinedTrajectory(with_poses(poses, found) if open3d else found, decision, run.report)


def recipe_for(frames: Path, source: Source | None = None) -> str:
    """The name of the recipe that refines poses of these frames, by their format, or by what their frames hold.

    `source`: the opened frames, if they are open already.
    """
    found = guesses(frames) if frames.exists() else []
    if not found:
        return RECIPE
    if found[0].name in CALIBRATED:
        return CALIBRATED[found[0].name]
    return recipe_of((source or guess_reader(frames, found).open(frames)).frames)


def recipe_of(frames: Sequence[Frame]) -> str:
    """The recipe that refines poses of these frames in memory."""
    has_scans = any(frame.read_points is not None for frame in frames)
    return SCANS if has_scans and all(frame.camera is None for frame in frames) else RECIPE


def _source(frames: Path | str | Sequence[Frame], poses: Floats) -> Source:
    """The frames with these poses (N, 4, 4). Raises `SourceError` where there is not one pose for each frame."""
    if isinstance(frames, (str, Path)):
        source = guess_reader(Path(frames)).open(Path(frames).absolute())
    else:
        source = Source("frames in memory", Path("memory"), tuple(frames))
    count = len(source.frames)
    if poses.shape != (count, 4, 4):
        raise SourceError(f"poses of shape {poses.shape} for {count} frames: give one 4x4 matrix for each frame")
    posed = tuple(
        replace(frame, world_from_cam=pose if np.isfinite(pose).all() else None)
        for frame, pose in zip(source.frames, poses, strict=True)
    )
    return replace(source, frames=posed)


def _same(array: Array) -> Array:
    """The array: a reader of an image in memory that pickles."""
    return array


def camera_of(camera: Camera | Floats, height: int, width: int) -> Camera:
    """The camera of images of this size, from a `Camera` or K (3, 3). Raises `SourceError` for a wrong one."""
    if not isinstance(camera, Camera):
        k = np.asarray(camera, float)
        if k.shape != (3, 3) or not np.isfinite(k).all() or (k[2] != (0, 0, 1)).any() or k[1, 0]:
            raise SourceError(
                f"the camera is {np.round(k, 3).tolist()}: expected K in pixels, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        if k[0, 1]:
            raise SourceError(f"the camera has the skew {k[0, 1]:g}: undistort the images into a pinhole without one")
        camera = Camera(width, height, *(float(k[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))))
    if (camera.width, camera.height) != (width, height):
        given = f"{camera.width}x{camera.height}"
        raise SourceError(f"the camera has {given} pixels, the depth images {width}x{height}: scale one of them")
    if camera.fx <= 0 or camera.fy == 0 or not (0 <= camera.cx <= width and 0 <= camera.cy <= height):
        given = f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}"
        raise SourceError(f"the camera has {given}: expected pixels of an image of {width}x{height}, fx above 0")
    return camera


def check_depths(depths_m: Sequence[Floats32]) -> None:
    """Raise `SourceError` for an image that cannot be depth in metres, or has another size than the first."""
    size = np.shape(depths_m[0])
    for row, depth in enumerate(np.asarray(image) for image in depths_m):
        if depth.ndim != 2 or depth.shape != size:
            raise SourceError(
                f"depth image {row} has the shape {depth.shape}: expected {size if len(size) == 2 else '(H, W)'}"
            )
        if depth.dtype.kind != "f":
            raise SourceError(
                f"depth image {row} holds {depth.dtype}, as stored by a sensor: divide by its units per metre"
            )
        if not np.isfinite(depth).all() or (depth < 0).any():
            raise SourceError(
                f"depth image {row} has values that are not finite or below 0: set what is not measured to 0"
            )
        seen = depth[depth > 0]
        if len(seen) and np.median(seen) > FARTHEST_M:
            median = f"{np.median(seen):.0f} m"
            raise SourceError(
                f"depth image {row} has a median of {median}: divide by its units per metre (1000 for mm)"
            )


def check_colours(colours: Sequence[Bytes] | None, count: int, size: tuple[int, int]) -> None:
    """Raise `SourceError` where there is not one RGB image (H, W, 3) of 8 bit for each depth image."""
    if colours is None:
        return
    if len(colours) != count:
        raise SourceError(f"{len(colours)} colour images for {count} depth images: give one for each")
    for row, colour in enumerate(np.asarray(image) for image in colours):
        if colour.shape != (*size, 3) or colour.dtype != np.uint8:
            raise SourceError(
                f"colour image {row} is {colour.dtype} of the shape {colour.shape}: expected uint8 {(*size, 3)}, RGB"
            )

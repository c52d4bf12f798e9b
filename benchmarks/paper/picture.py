"""The paper's figure: the same scene under several sets of poses, whole and in four details, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.report import raster
from hodge_pipeline.types import Camera, Floats, Frame
from hodge_pipeline.types.output_files import replacing

STRIDE = 3  # pixels: 34 000 points of a VGA frame, which fill nearly all pixels of the pictures
MAX_RANGE_M = 5.0
SURFACE_M = 0.04  # points this far behind the front one belong to the same surface: their colours are averaged
STEP_BACK_M = 1.2
SHARP_M = 1.0  # where a pixel is as wide as the focal length says
DETAILS = 4
PICTURE = (360, 270)
WHOLE_FOCAL, DETAIL_FOCAL = 0.55, 1.1  # of the picture's width


def draw_comparison(path: Path, frames: Sequence[Frame], pose_sets: Mapping[str, Floats]) -> None:
    """Write one row of pictures for each set of poses (N, 4, 4), all seen from the same five places.

    The first set decides the places; the others are aligned to it. A pixel shows the mean colour of all points on its
    front surface, so what does not fit together is blurred or doubled.
    """
    points = [_frame_points(frame) for frame in frames]
    names = list(pose_sets)
    reference = pose_sets[names[0]]
    views = _views(reference)
    figure, axes = plt.subplots(len(names), len(views), figsize=(3.2 * len(views), 2.55 * len(names)), squeeze=False)
    for row, name in enumerate(names):
        aligned = pose_sets[name] if row == 0 else _aligned(pose_sets[name], reference)
        known = np.flatnonzero(np.isfinite(aligned).all(axis=(1, 2)))
        scene = raster.Points.joined([points[one].moved(aligned[one]) for one in known])
        for column, (title, world_from_eye, focal) in enumerate(views):
            axis = axes[row, column]
            axis.imshow(raster.picture(scene, _view(world_from_eye, focal)))
            axis.set(xticks=[], yticks=[], ylabel=name if column == 0 else "", title=title if row == 0 else "")
    figure.tight_layout(pad=0.4)
    try:
        with replacing(path) as file:
            figure.savefig(file, format="png", dpi=110)
    finally:
        plt.close(figure)


def _aligned(poses: Floats, reference: Floats) -> Floats:
    both = np.isfinite(poses).all(axis=(1, 2)) & np.isfinite(reference).all(axis=(1, 2))
    if both.sum() < 2:
        return poses
    alignment = absolute_error(poses, reference).alignments[0]
    return alignment.apply(poses)


def _views(reference: Floats) -> list[tuple[str, Floats, float]]:
    """(title, world_from_eye, focal length): the whole from behind the cameras, and what four of the frames look at."""
    known = reference[np.isfinite(reference).all(axis=(1, 2))]
    if not len(known):
        raise SourceError("a picture needs poses, and no frame has one")
    whole = np.eye(4)
    whole[:3, :3] = se3.project_to_so3(known[:, :3, :3].mean(axis=0))
    whole[:3, 3] = known[:, :3, 3].mean(axis=0) - STEP_BACK_M * whole[:3, 2]
    rows = ((np.arange(DETAILS) + 0.5) / DETAILS * len(known)).astype(int)
    details = [(f"detail {number}", known[row], DETAIL_FOCAL) for number, row in enumerate(rows, start=1)]
    return [("whole", whole, WHOLE_FOCAL), *details]


def _frame_points(frame: Frame) -> raster.Points:
    """A frame without depth, or whose images cannot be read, has none: the run has said so already."""
    camera: Camera | None = frame.camera
    nothing = raster.Points.of(np.zeros((0, 3), np.float32))
    if camera is None or frame.read_depth is None or frame.read_colour is None:
        return nothing
    try:
        depth, image = frame.read_depth(), frame.read_colour()
    except (SourceError, OSError):
        return nothing
    z = depth[::STRIDE, ::STRIDE]
    v, u = np.nonzero((z > 0) & (z <= MAX_RANGE_M))
    z = z[v, u].astype(np.float32)
    v, u = v * STRIDE, u * STRIDE
    x, y = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z
    colour = image[v * image.shape[0] // depth.shape[0], u * image.shape[1] // depth.shape[1]]
    return raster.Points.of(np.stack([x, y, z], axis=1).astype(np.float32), colours=colour)


def _view(world_from_eye: Floats, focal: float) -> raster.View:
    """What a camera sees whose focal length is this share of the picture's width."""
    axes = world_from_eye[:3, :3].T
    centre = world_from_eye[:3, 3] + SHARP_M * axes[2]
    pixel_m = SHARP_M / (focal * PICTURE[0])
    return raster.View(axes, centre, pixel_m, PICTURE, eye_m=SHARP_M, culled=False, fill_px=0, surface_m=SURFACE_M)

"""The paper's figure: the same scene under several sets of poses, whole and in four details, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.store.artifacts import write_atomically
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32, Frame, Ints

STRIDE = 3  # pixels: 34 000 points of a VGA frame, which fill nearly all pixels of the pictures
MAX_RANGE_M = 5.0
SURFACE_M = 0.04  # points this far behind the front one belong to the same surface: their colours are averaged
STEP_BACK_M = 1.2
DETAILS = 4
PICTURE = (360, 270)
WHOLE_FOCAL, DETAIL_FOCAL = 0.55, 1.1  # of the picture's width


@dataclass(frozen=True)
class _Points:
    """The points of all frames in their cameras' axes, with colours; `offsets (N + 1,)` cut them into frames."""

    offsets: Ints
    in_cam: Floats32
    colours: Bytes

    def in_world(self, world_from_cam: Floats) -> tuple[Floats32, Bytes]:
        """Points of the frames that have a pose, (M, 3), and their colours."""
        parts, kept = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)]
        for row in np.flatnonzero(np.isfinite(world_from_cam).all(axis=(1, 2))):
            cut = slice(self.offsets[row], self.offsets[row + 1])
            pose = world_from_cam[row].astype(np.float32)
            parts.append(self.in_cam[cut] @ pose[:3, :3].T + pose[:3, 3])
            kept.append(self.colours[cut])
        return np.concatenate(parts), np.concatenate(kept)


def draw_comparison(path: Path, frames: Sequence[Frame], pose_sets: Mapping[str, Floats]) -> None:
    """Write one row of pictures for each set of poses (N, 4, 4), all seen from the same five places.

    The first set decides the places; the others are aligned to it. A pixel shows the mean colour of all points on its
    front surface, so what does not fit together is blurred or doubled.
    """
    points = _read_points(frames)
    names = list(pose_sets)
    reference = pose_sets[names[0]]
    views = _views(reference)
    figure, axes = plt.subplots(len(names), len(views), figsize=(3.2 * len(views), 2.55 * len(names)), squeeze=False)
    for row, name in enumerate(names):
        aligned = pose_sets[name] if row == 0 else _aligned(pose_sets[name], reference)
        in_world, colours = points.in_world(aligned)
        for column, (title, world_from_eye, focal) in enumerate(views):
            axis = axes[row, column]
            axis.imshow(_render(in_world, colours, world_from_eye, focal))
            axis.set(xticks=[], yticks=[], ylabel=name if column == 0 else "", title=title if row == 0 else "")
    figure.tight_layout(pad=0.4)
    try:
        write_atomically(path, lambda stream: figure.savefig(stream, format="png", dpi=110))
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


def _read_points(frames: Sequence[Frame]) -> _Points:
    parts, colours, sizes = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.uint8)], [0]
    for frame in frames:
        in_cam, colour = _frame_points(frame)
        parts.append(in_cam)
        colours.append(colour)
        sizes.append(len(in_cam))
    return _Points(np.cumsum(sizes), np.concatenate(parts), np.concatenate(colours))


def _frame_points(frame: Frame) -> tuple[Floats32, Bytes]:
    """A frame without depth, or whose images cannot be read, has none: the run has said so already."""
    camera: Camera | None = frame.camera
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
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
    return np.stack([x, y, z], axis=1).astype(np.float32), colour


def _render(in_world: Floats32, colours: Bytes, world_from_eye: Floats, focal: float) -> Bytes:
    """The picture (H, W, 3) of the points from a camera; white where there is none."""
    width, height = PICTURE
    eye_from_world = se3.inverse(world_from_eye).astype(np.float32)
    in_eye = in_world @ eye_from_world[:3, :3].T + eye_from_world[:3, 3]
    front = in_eye[:, 2] > 0.1
    in_eye, colours = in_eye[front], colours[front]
    u = np.floor(in_eye[:, 0] / in_eye[:, 2] * focal * width + width / 2).astype(np.int64)
    v = np.floor(in_eye[:, 1] / in_eye[:, 2] * focal * width + height / 2).astype(np.int64)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixel, depth, colours = (v * width + u)[inside], in_eye[inside, 2], colours[inside]
    nearest = np.full(width * height, np.inf, np.float32)
    np.minimum.at(nearest, pixel, depth)
    shown = depth <= nearest[pixel] + SURFACE_M
    pixel, colours = pixel[shown], colours[shown]
    count = np.bincount(pixel, minlength=width * height)
    sums = [np.bincount(pixel, colours[:, channel], minlength=width * height) for channel in range(3)]
    mean = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
    picture = np.where(count[:, None] > 0, mean, 255.0).astype(np.uint8)
    return np.asarray(picture.reshape(height, width, 3))

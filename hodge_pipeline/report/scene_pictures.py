"""The pictures of scenes in a report: the place that changed most, four sides, and the frames of the worst edges."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from matplotlib import colormaps
from PIL import Image
from scipy.ndimage import uniform_filter

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.difference import length
from hodge_pipeline.report import raster
from hodge_pipeline.report.contents import EdgeRow
from hodge_pipeline.report.document import Picture
from hodge_pipeline.types import Bytes, CloudSet, Floats, Frame, Ints, Source
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.axes import is_scanner

FRAMES = 200
"""Frames whose clouds are merged: more of them add nothing that is seen in a picture."""
EDGES = 6
THUMBNAIL_PX = 300
LARGE = (720, 540)
FILL_PX = 5
"""Width in pixels of gaps that are closed in an enlarged picture."""
CLOSER = 2
"""How many times the place that changed most is enlarged."""
DOWN = np.diag([1.0, -1.0, -1.0])
"""Right, down and look of a view from above, in the axes of a scanner."""
VIEWED_PERCENT = 3.0
"""Percentage of a frame's points that may lie outside its own picture at each side."""


def changed_most(
    clouds: CloudSet, before: Floats, after: Floats, pairs: Ints, names: Sequence[object], component: Ints
) -> tuple[Picture, ...]:
    """The place where the run changed most, before and after: what the first frame of the pair (P, 2) looks at whose
    relative motion changed most, in all clouds of its component.
    """
    known = se3.has_pose(before) & se3.has_pose(after) & (clouds.sizes > 0)
    pairs = pairs[known[pairs].all(axis=1)]
    if not len(pairs):
        return ()
    moved_m = _moved_m(clouds, before, after, pairs)
    worst = int(np.argmax(moved_m))
    i, j = pairs[worst].tolist()
    rows = np.flatnonzero(known & (component == component[i]))
    rows = np.unique([*_some(rows), i, j])
    laid = after[i] @ se3.inverse(before[i]) @ before  # frame i where it ends, so that the rest is seen to move
    scenes = [raster.merged(clouds, poses, rows) for poses in (laid, after)]
    view = _closer(scenes, _as_seen_by(clouds, after, i))
    images = [raster.picture(scene, view) for scene in scenes]
    caption = (
        f"Part of what frame {names[i]} sees, in the clouds of {len(rows)} frames: before on the left, after on the "
        f"right. Frame {names[j]} moved by {length(float(moved_m[worst]))} against it, more than any other pair. What "
        "is double or blurred on the left and single on the right is what the run is for."
    )
    return (Picture("", caption, raster.jpeg(raster.beside(images))),)


def _moved_m(clouds: CloudSet, before: Floats, after: Floats, pairs: Ints) -> Floats:
    """How far (P,) the middle of cloud j moved against frame i."""
    middle = np.zeros((len(clouds), 3))
    for row in np.flatnonzero(clouds.sizes > 0).tolist():
        middle[row] = np.mean(clouds[row].points_in_cam, axis=0, dtype=float)
    seen = [se3.transform(se3.between(poses, pairs), middle[pairs[:, 1], None])[:, 0] for poses in (before, after)]
    return np.asarray(np.linalg.norm(seen[1] - seen[0], axis=1))


def _as_seen_by(clouds: CloudSet, world_from_cam: Floats, row: int) -> raster.View:
    """The view of one camera, orthographic, which its own points fill; of a scanner, from above."""
    pose = world_from_cam[row]
    points = np.asarray(clouds[row].points_in_cam, float)
    axes = DOWN if is_scanner(clouds, np.array([row])) else np.eye(3)
    held = raster.holding(axes, points, LARGE, VIEWED_PERCENT)
    depth_m = points @ axes[2]
    near_m = float(axes[2] @ held.centre - max(np.percentile(depth_m, 1) / 2, 0.0))
    centre = se3.transform(pose, held.centre[None])[0]
    return raster.View(axes @ pose[:3, :3].T, centre, held.metres_per_pixel, LARGE, near_m=near_m)


def _closer(scenes: Sequence[raster.Points], view: raster.View) -> raster.View:
    """The part of the view in which the two pictures differ most, enlarged."""
    first, second = (raster.picture(scene, view).astype(np.float32) for scene in scenes)
    both = (first < raster.PAPER).any(axis=2) & (second < raster.PAPER).any(axis=2)
    differing = np.where(both, np.abs(first - second).sum(axis=2), 0.0)
    width, height = view.size
    part = width // CLOSER, height // CLOSER
    sums = uniform_filter(differing, size=part[::-1], mode="constant")
    inside = sums[part[1] // 2 : height - part[1] // 2, part[0] // 2 : width - part[0] // 2]
    row, column = np.unravel_index(int(inside.argmax()), inside.shape)
    right, down = column + part[0] // 2 - width / 2, row + part[1] // 2 - height / 2
    centre = view.centre + view.metres_per_pixel * (right * view.axes[0] + down * view.axes[1])
    return replace(view, centre=centre, metres_per_pixel=view.metres_per_pixel / CLOSER, fill_px=FILL_PX)


def _some(rows: Ints) -> Ints:
    return np.asarray(rows[evenly(len(rows), FRAMES)])


def four_sides(clouds: CloudSet, before: Floats, after: Floats, component: Ints) -> tuple[Picture, ...]:
    """One picture for each side: the clouds laid together by the poses before, aligned to those after, on the left, and
    by these on the right.

    Only frames of the largest component, which both sets of poses (N, 4, 4) know; none where there is nothing to see.
    """
    finite = se3.has_pose(before) & se3.has_pose(after)
    rows = _some(np.flatnonzero(finite & (component == 0) & (clouds.sizes > 0)))
    if len(rows) < 2:
        return ()
    aligned = se3.fit_poses(after[rows], before[rows]) @ before  # known positions have a world of their own
    scenes = [raster.merged(clouds, poses, rows) for poses in (aligned, after)]
    return sides(scenes, raster.around(scenes[1], after[rows], is_scanner(clouds, rows)), "Before | after")


def sides(scenes: Sequence[raster.Points], views: Mapping[str, raster.View], caption: str) -> tuple[Picture, ...]:
    """The scenes beside each other, from each view."""
    return tuple(
        Picture(
            f"From the {name}",
            caption,
            raster.jpeg(raster.beside([raster.picture(scene, view) for scene in scenes])),
        )
        for name, view in views.items()
    )


def worst_pairs(source: Source, edges: Sequence[EdgeRow]) -> Iterator[Picture]:
    """The two frames of each of the worst edges side by side; an edge whose images cannot be read has no picture."""
    frames = {str(frame.frame_id): frame for frame in source.frames}
    for edge in edges[:EDGES]:
        shown = images_of([frames[name] for name in (edge.i, edge.j) if name in frames], THUMBNAIL_PX)
        if len(shown) == 2:
            ignored = ", ignored by the solver" if edge.weight <= 0 else ""
            caption = f"{edge.source}: off by {length(edge.residual_m)} and {edge.residual_deg:.2f}°{ignored}"
            yield Picture(f"{edge.i} – {edge.j}", caption, raster.jpeg(raster.beside(shown)))


def images_of(frames: Sequence[Frame], width: int) -> list[Bytes]:
    """The frames as their cameras saw them, without those that have nothing to show or cannot be read."""
    found = []
    for frame in frames:
        try:
            image = _thumbnail(frame, width)
        except (SourceError, OSError):
            continue
        if image is not None:
            found.append(image)
    return found


def _thumbnail(frame: Frame, width: int) -> Bytes | None:
    if frame.read_colour is not None:
        image = frame.read_colour()
    elif frame.read_depth is not None:
        depth = frame.read_depth()
        far = max(float(np.percentile(depth, 98)), 1e-3)
        image = (colormaps["cividis"](np.clip(depth / far, 0, 1))[:, :, :3] * 255).astype(np.uint8)
    else:
        return None
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(Image.fromarray(np.ascontiguousarray(image)).resize((width, height)))

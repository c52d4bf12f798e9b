"""Pictures of single edges: their two clouds before and after, their two images with what matches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.errors import SourceError
from hodge_pipeline.report import splat
from hodge_pipeline.report.diagnosis_page import EdgePictures
from hodge_pipeline.report.matches import side_by_side
from hodge_pipeline.report.plots import Plot
from hodge_pipeline.report.thumbnails import beside, thumbnail
from hodge_pipeline.report.two_clouds import View, picture, views
from hodge_pipeline.types import CloudSet, Floats, Frame, Ints, PointCloud, ViewGraph

IMAGE_WIDTH = 420
LEAST_UP = 0.1
"""Of the mean up direction: where cameras look every way there is none."""


def edge_pictures(
    graph: ViewGraph, diagnosis: Diagnosis, rows: Ints, frames: Sequence[Frame], clouds: CloudSet | None
) -> tuple[EdgePictures, ...]:
    """The pictures of these edges; nothing for a graph without frames or clouds."""
    found = []
    for row in map(int, rows):
        plots = tuple(_plots(graph, diagnosis, row, frames, clouds))
        if plots:
            found.append(EdgePictures(row, plots))
    return tuple(found)


def _plots(
    graph: ViewGraph, diagnosis: Diagnosis, row: int, frames: Sequence[Frame], clouds: CloudSet | None
) -> Iterator[Plot]:
    i, j = graph.edges[row].tolist()
    names = graph.vertex_ids[i], graph.vertex_ids[j]
    if clouds is not None and len(clouds[i]) and len(clouds[j]):
        known = [("As the edge says", graph.i_from_j[row])]
        if diagnosis.piece[i] == diagnosis.piece[j]:
            robust = se3.inverse(diagnosis.world_from_cam[i]) @ diagnosis.world_from_cam[j]
            known.append(("As the robust poses say", robust))
        seen = _views(clouds[i], clouds[j], [motion for _, motion in known], _up(diagnosis, i))
        shown = f"Frame {names[0]} blue, frame {names[1]} orange; left as camera {names[0]} looks, right from above."
        for title, motion in known:
            yield Plot(title, shown, _clouds(clouds[i], clouds[j], motion, seen))
    if frames:
        yield from _images(frames[i], frames[j])


def _up(diagnosis: Diagnosis, i: int) -> Floats:
    """Where up is, in camera i's axes: the mean of what the cameras of its piece have as up."""
    poses = diagnosis.world_from_cam
    up = -poses[diagnosis.piece == diagnosis.piece[i], :3, 1].mean(axis=0)
    size = float(np.linalg.norm(up))
    return np.asarray(poses[i, :3, :3].T @ (up / size) if size > LEAST_UP else np.array([0.0, -1.0, 0.0]))


def _views(first: PointCloud, second: PointCloud, motions: Sequence[Floats], up_in_i: Floats) -> tuple[View, View]:
    """The same views for every motion, so that the pictures compare."""
    moved = [se3.transform(motion, np.asarray(second.points_in_cam, float)) for motion in motions]
    return views(np.concatenate([np.asarray(first.points_in_cam, float), *moved]), up_in_i)


def _clouds(first: PointCloud, second: PointCloud, i_from_j: Floats, seen: tuple[View, View]) -> bytes:
    return splat.jpeg(beside([picture(first, second, i_from_j, view) for view in seen]))


def _images(first: Frame, second: Frame) -> Iterator[Plot]:
    """The frames as their cameras saw them; a frame with nothing to show, or nothing that can be read, has none."""
    try:
        images = [thumbnail(frame, IMAGE_WIDTH) for frame in (first, second)]
    except (SourceError, OSError):
        return
    shown = [image for image in images if image is not None]
    if len(shown) < 2:
        return
    title = f"Images of {first.frame_id} and {second.frame_id}"
    if first.read_colour is None or second.read_colour is None:
        yield Plot(title, "Depth where there is no colour: the brighter, the farther.", splat.jpeg(beside(shown)))
        return
    found = side_by_side(*shown)
    caption = (
        f"{found.matches} SIFT matches; {found.agreeing} of them (green) agree on one relative pose. Places that look "
        "alike match too: see whether the whole views fit."
    )
    yield Plot(title, caption, splat.jpeg(found.image))

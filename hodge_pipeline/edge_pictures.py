"""Pictures of single edges: their two clouds before and after, their two images with what matches."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence

import numpy as np
from PIL import Image

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.matches import side_by_side
from hodge_pipeline.diagnosis.page import EdgePictures
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.diagnosis.two_clouds import PAPER, picture, views
from hodge_pipeline.errors import SourceError
from hodge_pipeline.evaluation.plots import Plot
from hodge_pipeline.types import Bytes, CloudSet, Floats, Frame, Ints, PointCloud, ViewGraph

GAP = 6
JPEG_QUALITY = 82


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
        up_in_i = _up(diagnosis.world_from_cam, diagnosis.piece, i)
        shown = f"Frame {names[0]} blue, frame {names[1]} orange; left as camera {names[0]} looks, right from above."
        yield Plot("As the edge says", shown, _clouds(clouds[i], clouds[j], graph.i_from_j[row], up_in_i))
        if diagnosis.piece[i] == diagnosis.piece[j]:
            robust = se3.inverse(diagnosis.world_from_cam[i]) @ diagnosis.world_from_cam[j]
            yield Plot("As the robust poses say", shown, _clouds(clouds[i], clouds[j], robust, up_in_i))
    if frames:
        yield from _images(frames[i], frames[j])


def _up(world_from_cam: Floats, piece: Ints, i: int) -> Floats:
    """Where up is, in camera i's axes: the mean of what the cameras of its piece have as up."""
    up = -world_from_cam[piece == piece[i], :3, 1].mean(axis=0)
    size = float(np.linalg.norm(up))
    return np.asarray(world_from_cam[i, :3, :3].T @ (up / size) if size > 0.1 else np.array([0.0, -1.0, 0.0]))


def _clouds(first: PointCloud, second: PointCloud, i_from_j: Floats, up_in_i: Floats) -> bytes:
    seen = [picture(first, second, i_from_j, view) for view in views(first, up_in_i)]
    return _jpeg(np.hstack([seen[0], np.full((len(seen[0]), GAP, 3), PAPER, np.uint8), seen[1]]))


def _images(first: Frame, second: Frame) -> Iterator[Plot]:
    """The images; a frame whose image is not there or cannot be read has no picture."""
    if first.read_colour is None or second.read_colour is None:
        return
    try:
        found = side_by_side(first.read_colour(), second.read_colour())
    except (SourceError, OSError):
        return
    caption = (
        f"{found.matches} SIFT matches; {found.agreeing} of them (green) agree on one relative pose. Places that look "
        "alike match too: see whether the whole views fit."
    )
    yield Plot(f"Images of {first.frame_id} and {second.frame_id}", caption, _jpeg(found.image))


def _jpeg(image: Bytes) -> bytes:
    target = io.BytesIO()
    Image.fromarray(image).save(target, "JPEG", quality=JPEG_QUALITY, optimize=True)
    return target.getvalue()

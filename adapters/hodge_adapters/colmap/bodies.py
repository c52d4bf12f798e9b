"""The moving bodies of a COLMAP model, and edges between images as edges between bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import matrix_of
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Ints, ViewGraph


@dataclass(frozen=True)
class Bodies:
    """COLMAP's frames (B) in the order of their first images, and for each image (N) its body and place on it."""

    frame_ids: tuple[int, ...]
    names: tuple[str, ...]
    world_from_body: Floats
    body_of_image: Ints
    body_from_cam: Floats


def bodies_of(reconstruction: pycolmap.Reconstruction, image_ids: Sequence[int]) -> Bodies:
    """The bodies of these images, which all have a pose."""
    images = [reconstruction.images[image_id] for image_id in image_ids]
    frame_ids = list(dict.fromkeys(image.frame_id for image in images))
    row = {frame_id: number for number, frame_id in enumerate(frame_ids)}
    body_of_image = np.array([row[image.frame_id] for image in images], np.int64)
    poses: list[Any] = [reconstruction.frames[key].rig_from_world for key in frame_ids]
    world_from_body = np.array([matrix_of(pose.inverse()) for pose in poses])
    world_from_cam = np.array([matrix_of(image.cam_from_world().inverse()) for image in images])
    first = np.unique(body_of_image, return_index=True)[1]
    return Bodies(
        frame_ids=tuple(frame_ids),
        names=tuple(images[at].name for at in first),
        world_from_body=world_from_body,
        body_of_image=body_of_image,
        body_from_cam=se3.inverse(world_from_body[body_of_image]) @ world_from_cam,
    )


def body_graph(graph: ViewGraph, bodies: Bodies) -> ViewGraph:
    """The graph of images as one of bodies: `B_i Z B_j⁻¹`, the information carried over; none within one body."""
    i, j = graph.edges.T
    between = bodies.body_of_image[i] != bodies.body_of_image[j]
    chosen = graph.select(between)
    i, j = chosen.edges.T
    cam_from_body = se3.inverse(bodies.body_from_cam[j])
    return replace(
        chosen,
        vertex_ids=np.array(bodies.names),
        edges=bodies.body_of_image[chosen.edges].reshape(-1, 2),
        i_from_j=bodies.body_from_cam[i] @ chosen.i_from_j @ cam_from_body,
        information=se3.pull_back(cam_from_body, chosen.information),
    )

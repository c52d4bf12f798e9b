"""What pycolmap's model holds, as plain arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_adapters.colmap_files import natural
from hodge_adapters.colmap_records import NO_POINT, CameraRecord, ImageRecord, Model, Points
from hodge_adapters.pycolmap_import import pycolmap
from hodge_pipeline import se3
from hodge_pipeline.types import Floats


def content_of(reconstruction: pycolmap.Reconstruction) -> Model:
    """The posed images in natural order of their names, their cameras, and the points with their tracks."""
    posed = (reconstruction.images[image_id] for image_id in reconstruction.reg_image_ids())
    images = [_image(image) for image in sorted(posed, key=lambda image: natural(image.name))]
    cameras = {
        key: CameraRecord(key, camera.model.name, camera.width, camera.height, tuple(camera.params))
        for key, camera in reconstruction.cameras.items()
    }
    return Model(cameras, images, _points(reconstruction, {image.image_id for image in images}), ())


def refreshed(model: Model, reconstruction: pycolmap.Reconstruction) -> Model:
    """The content with the poses and positions of a reconstruction of the same images and points.

    A point that the reconstruction lost stays where it was.
    """
    points3d = reconstruction.points3D
    xyz = model.points.xyz.copy()
    for row, point_id in enumerate(model.points.ids.tolist()):
        if point_id in points3d:
            xyz[row] = points3d[point_id].xyz
    images = [replace(image, world_from_cam=_pose(reconstruction.images[image.image_id])) for image in model.images]
    cameras = {
        key: replace(record, params=tuple(reconstruction.cameras[key].params)) for key, record in model.cameras.items()
    }
    return replace(model, cameras=cameras, images=images, points=replace(model.points, xyz=xyz))


def _pose(image: pycolmap.Image) -> Floats:
    return se3.inverse(np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]]))


def _image(image: pycolmap.Image) -> ImageRecord:
    invalid = pycolmap.INVALID_POINT3D_ID
    points = list(image.points2D)
    pixels = np.array([point.xy for point in points]).reshape(-1, 2)
    ids = (point.point3D_id for point in points)
    point_ids = np.fromiter((NO_POINT if one == invalid else one for one in ids), np.int64, len(points))
    return ImageRecord(image.image_id, _pose(image), image.camera_id, image.name, pixels, point_ids)


def _points(reconstruction: pycolmap.Reconstruction, posed: set[int]) -> Points:
    """The points; what an image without a pose saw of them tells nothing."""
    ids, xyz, counts, image_ids, columns = [], [], [], [], []
    for key, point in sorted(reconstruction.points3D.items()):
        ids.append(key)
        xyz.append(point.xyz)
        seen = [(one.image_id, one.point2D_idx) for one in point.track.elements if one.image_id in posed]
        counts.append(len(seen))
        image_ids += [one for one, _ in seen]
        columns += [one for _, one in seen]
    return Points(
        ids=np.array(ids, np.int64),
        xyz=np.array(xyz, np.float64).reshape(-1, 3),
        offsets=np.concatenate([[0], np.cumsum(np.array(counts, np.int64))]).astype(np.int64),
        image_ids=np.array(image_ids, np.int64),
        columns=np.array(columns, np.int64),
    )

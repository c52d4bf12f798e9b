"""Two COLMAP models in one gauge as one: cameras, rigs, frames, images, points and tracks of both."""

from __future__ import annotations

import numpy as np

from hodge_adapters.colmap.pycolmap_import import pycolmap

SAME_PARAMS = 1e-9
"""Share by which parameters of one camera may differ: what rounding leaves of them in a text file."""


def united(first: pycolmap.Reconstruction, second: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """A new model of both. Ids stay, unless another thing of the first has them; an image in both is the first's.

    A point of the second that both models see at one keypoint is merged with the first's.
    """
    out = pycolmap.Reconstruction(first)
    cameras = {camera_id: _add_camera(out, camera) for camera_id, camera in second.cameras.items()}
    rigs = {rig_id: _add_rig(out, rig, cameras) for rig_id, rig in second.rigs.items()}
    names = {out.images[image_id].name: image_id for image_id in out.reg_image_ids()}
    images: dict[int, int] = {}
    for frame_id in second.reg_frame_ids():
        _add_frame(out, second, second.frames[frame_id], cameras, rigs, names, images)
    for point in second.points3D.values():
        _add_point(out, point, images)
    return out


def _free(wanted: int, taken: object) -> int:
    ids = set(taken)  # type: ignore[call-overload]
    return wanted if wanted not in ids else max(ids) + 1


def _add_camera(out: pycolmap.Reconstruction, camera: pycolmap.Camera) -> int:
    if camera.camera_id in out.cameras and _same_camera(out.cameras[camera.camera_id], camera):
        return int(camera.camera_id)
    copy = pycolmap.Camera(
        model=camera.model, width=camera.width, height=camera.height, params=camera.params,
        camera_id=_free(camera.camera_id, out.cameras.keys()),
    )  # fmt: skip
    copy.has_prior_focal_length = camera.has_prior_focal_length
    out.add_camera(copy)
    return int(copy.camera_id)


def _same_camera(a: pycolmap.Camera, b: pycolmap.Camera) -> bool:
    same = a.model == b.model and a.width == b.width and a.height == b.height
    return same and bool(np.allclose(a.params, b.params, rtol=SAME_PARAMS, atol=SAME_PARAMS))


def _sensor(sensor: pycolmap.sensor_t, cameras: dict[int, int]) -> pycolmap.sensor_t:
    is_camera = sensor.type == pycolmap.SensorType.CAMERA
    return pycolmap.sensor_t(sensor.type, cameras[sensor.id] if is_camera else sensor.id)


def _add_rig(out: pycolmap.Reconstruction, rig: pycolmap.Rig, cameras: dict[int, int]) -> int:
    copy = pycolmap.Rig()
    copy.add_ref_sensor(_sensor(rig.ref_sensor_id, cameras))
    for sensor, sensor_from_rig in rig.non_ref_sensors.items():
        copy.add_sensor(_sensor(sensor, cameras), sensor_from_rig)
    if rig.rig_id in out.rigs and _same_rig(out.rigs[rig.rig_id], copy):
        return int(rig.rig_id)
    copy.rig_id = _free(rig.rig_id, out.rigs.keys())
    out.add_rig(copy)
    return int(copy.rig_id)


def _same_rig(a: pycolmap.Rig, b: pycolmap.Rig) -> bool:
    if a.ref_sensor_id != b.ref_sensor_id or set(a.non_ref_sensors) != set(b.non_ref_sensors):
        return False
    poses = ((a.non_ref_sensors[sensor], b.non_ref_sensors[sensor]) for sensor in a.non_ref_sensors)
    return all(
        one is other is None or (one is not None and other is not None and np.allclose(one.matrix(), other.matrix()))
        for one, other in poses
    )


def _add_frame(
    out: pycolmap.Reconstruction,
    second: pycolmap.Reconstruction,
    frame: pycolmap.Frame,
    cameras: dict[int, int],
    rigs: dict[int, int],
    names: dict[str, int],
    images: dict[int, int],
) -> None:
    theirs = [second.images[data.id] for data in frame.image_ids]
    for image in theirs:
        if image.name in names:
            images[image.image_id] = names[image.name]
    if any(image.name in names for image in theirs):
        return  # the first model has this moment already
    copy = pycolmap.Frame()
    copy.frame_id, copy.rig_id = _free(frame.frame_id, out.frames.keys()), rigs[frame.rig_id]
    for image in theirs:
        images[image.image_id] = _free(image.image_id, [*out.images.keys(), *images.values()])
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, cameras[image.camera_id])
        copy.add_data_id(pycolmap.data_t(sensor, images[image.image_id]))
    copy.rig_from_world = frame.rig_from_world
    out.add_frame(copy)
    for image in theirs:
        new = pycolmap.Image(
            image.name,
            np.array([point.xy for point in image.points2D]).reshape(-1, 2),
            cameras[image.camera_id],
            images[image.image_id],
        )
        new.frame_id = copy.frame_id
        out.add_image(new)
    out.register_frame(copy.frame_id)


def _add_point(out: pycolmap.Reconstruction, point: pycolmap.Point3D, images: dict[int, int]) -> None:
    track, twins = pycolmap.Track(), set()
    for element in point.track.elements:
        if element.image_id not in images:
            continue
        image_id = images[element.image_id]
        image = out.images[image_id]
        if element.point2D_idx >= image.num_points2D():
            continue
        seen = image.points2D[element.point2D_idx]
        if seen.has_point3D():
            twins.add(seen.point3D_id)
        else:
            track.add_element(image_id, element.point2D_idx)
    if len(twins) == 1:
        (twin,) = twins
        there = {element.image_id for element in out.points3D[twin].track.elements}
        for element in track.elements:
            if element.image_id not in there:
                out.add_observation(twin, element)
    elif track.length() >= 2:
        out.add_point3D(point.xyz, track, point.color)

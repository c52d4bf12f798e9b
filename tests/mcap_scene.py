"""Whole recordings of an RGB-D sequence: depth, colour, calibration and poses, or its clouds, as a robot logs them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from hodge_pipeline.types import Camera, Frame
from mcap_data import (
    CALIBRATION,
    COLOUR,
    COMPRESSED,
    DEPTH,
    INFO,
    OPTICAL,
    SECOND,
    Log,
    calibration,
    compressed_depth,
    foxglove_header,
    odometry,
    point_cloud,
    pose_message,
    raw_image,
    ros_header,
    transforms,
)
from mcap_encoding import CDR
from readers_data import HEIGHT, WIDTH, depth_values, some_poses

BEGIN_S = 1000.0
POSES, CLOUDS = "/cam/pose", "/points"


def stamp_s(frame: Frame) -> float:
    """That of the frame, later by `BEGIN_S`: a stamp of 0 would mean none."""
    return BEGIN_S + frame.stamp_s


def write_rgbd(
    path: Path,
    frames: Sequence[Frame],
    depth_schema: str,
    depth_message: Callable[[np.ndarray], dict[str, Any]],
    encoding: str = CDR,
    **options: Any,
) -> Path:
    """A recording of frames that come from files: depth as made by `depth_message`, colour passed through, poses."""
    log = Log()
    for frame in frames:
        assert frame.camera and frame.encoded_depth and frame.encoded_colour and frame.world_from_cam is not None
        head, log_ns = foxglove_header(stamp_s(frame), OPTICAL), int(stamp_s(frame) * SECOND)
        stored = cv2.imdecode(np.frombuffer(frame.encoded_depth().contents, np.uint8), cv2.IMREAD_UNCHANGED)
        colour = frame.encoded_colour()
        coded = {"format": colour.media_type.removeprefix("image/"), "data": colour.contents}
        log.add(INFO, CALIBRATION, {**head, **camera_message(frame.camera)}, encoding, log_ns)
        log.add(DEPTH, depth_schema, {**head, **depth_message(stored)}, encoding, log_ns)
        moment = foxglove_header(stamp_s(frame) + frame.colour_delay_s, OPTICAL)
        log.add(COLOUR, COMPRESSED, {**moment, **coded}, encoding, log_ns)
        log.add(POSES, "foxglove.PoseInFrame", pose_in_frame(frame), encoding, log_ns)
    return log.write(path, **options)


def write_clouds(path: Path, frames: Sequence[Frame], clouds: Sequence[np.ndarray], **options: Any) -> Path:
    """A recording of points (N, 3) as PointCloud2 in the camera's axes, with the frames' poses."""
    log = Log()
    for frame, points in zip(frames, clouds, strict=True):
        head = {"header": ros_header(stamp_s(frame), OPTICAL)}
        columns = {axis: points[:, number].astype(np.float32) for number, axis in enumerate("xyz")}
        message = point_cloud(columns, {"x": 0, "y": 4, "z": 8}, step=16)
        log_ns = int(stamp_s(frame) * SECOND)
        log.add(CLOUDS, "sensor_msgs/msg/PointCloud2", {**head, **message}, CDR, log_ns)
        log.add(POSES, "foxglove.PoseInFrame", pose_in_frame(frame), CDR, log_ns)
    return log.write(path, **options)


def camera_message(camera: Camera) -> dict[str, Any]:
    return calibration(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def pose_in_frame(frame: Frame) -> dict[str, Any]:
    assert frame.world_from_cam is not None
    return {**foxglove_header(stamp_s(frame), "map"), "pose": pose_message(frame.world_from_cam)}


def everything(encoding: str = CDR, count: int = 3) -> Log:
    """Depth raw, as PNG and as RVL, colour, clouds, calibration, odometry and transforms."""
    log, pose = Log(), some_poses(1)[0]
    for row in range(count):
        head, log_ns = foxglove_header(100 + row, "cam"), (100 + row) * SECOND
        depth = depth_values(row)
        log.add("/info", "foxglove.CameraCalibration", {**head, **calibration(WIDTH, HEIGHT, 9, 9, 4, 3)}, encoding)
        log.add("/raw", "foxglove.RawImage", {**head, **raw_image(depth, "16UC1")}, encoding, log_ns)
        for coding in ("png", "rvl"):
            image = {**head, **compressed_depth(depth, coding)}
            log.add(f"/{coding}", "foxglove.CompressedImage", image, encoding, log_ns)
        colour = raw_image(np.zeros((HEIGHT, WIDTH, 3), np.uint8), "rgb8")
        log.add("/colour", "foxglove.RawImage", {**head, **colour}, encoding, log_ns)
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(100 + row, pose), CDR, log_ns)
        log.add("/tf", "tf2_msgs/msg/TFMessage", transforms((100 + row, "base_link", "cam", pose)), CDR, log_ns)
        points = {axis: np.arange(4, dtype="<f4") for axis in "xyz"}
        cloud = {"header": ros_header(100 + row, "cam"), **point_cloud(points, {"x": 0, "y": 4, "z": 8}, 12)}
        log.add("/points", "sensor_msgs/msg/PointCloud2", cloud, CDR, log_ns)
    return log

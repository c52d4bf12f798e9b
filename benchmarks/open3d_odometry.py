"""Open3D's RGB-D odometry of consecutive frames, chained: what `main_job.py` prints beside the main job."""

from __future__ import annotations

import time

import numpy as np
import open3d as o3d

from hodge_pipeline.types import Floats, Frame, Source

DEPTH_LIMIT_M = 6.0


def tracked_by_open3d(source: Source) -> tuple[Floats, int, float]:
    """The poses (N, 4, 4), how many pairs it cannot register, which keep the pose of the frame before, and its CPU
    seconds, reading of frames included.
    """
    frames, begin_cpu = source.frames, time.process_time()
    poses, lost = [np.eye(4)], 0
    before = _image(frames[0])
    for frame in frames[1:]:
        image, camera = _image(frame), frame.camera
        assert camera is not None
        pinhole = o3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        )
        found, before_from_this, _ = o3d.pipelines.odometry.compute_rgbd_odometry(
            image, before, pinhole, np.eye(4), o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm()
        )
        lost += not found
        poses.append(poses[-1] @ (before_from_this if found else np.eye(4)))
        before = image
    return np.array(poses), lost, time.process_time() - begin_cpu


def _image(frame: Frame) -> o3d.geometry.RGBDImage:
    assert frame.read_depth is not None and frame.read_colour is not None
    colour, depth = o3d.geometry.Image(frame.read_colour()), o3d.geometry.Image(frame.read_depth().astype(np.float32))
    return o3d.geometry.RGBDImage.create_from_color_and_depth(colour, depth, 1.0, DEPTH_LIMIT_M)

"""Open3D's RGB-D odometry of consecutive frames, chained: what `main_job.py` prints beside the main job."""

from __future__ import annotations

import time

import numpy as np
import open3d as o3d

from hodge_pipeline.evaluation.trajectory import absolute_error, relative_error
from hodge_pipeline.scene import true_poses
from hodge_pipeline.types import Floats, Frame, Source

DEPTH_LIMIT_M = 6.0


def open3d_row(source: Source) -> str:
    """A row of the main job's table: frames, CPU seconds in all and a frame, errors; a dash for what it does not give.

    A pair that it cannot register keeps the pose of the frame before, and is counted.
    """
    begin = time.process_time()
    poses, lost = _chained(source.frames)
    cpu_s = time.process_time() - begin
    truth, count = true_poses(source), len(source.frames)
    note, errors = f", {lost} pairs lost" if lost else "", "– | – | – | –"
    if np.isfinite(truth).any():
        error, step = absolute_error(poses, truth), relative_error(poses, truth)
        errors = (
            f"{100 * error.rmse_m:.2f} | {100 * error.max_m:.1f} | {1e3 * step.translation_rmse_m:.1f} | "
            f"{step.rotation_rmse_deg:.2f}"
        )
    return f"| Open3D's odometry{note} | {count} | {cpu_s:.1f} | {1e3 * cpu_s / count:.0f} | – | – | – | {errors} | – |"


def _chained(frames: tuple[Frame, ...]) -> tuple[Floats, int]:
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
    return np.array(poses), lost


def _image(frame: Frame) -> o3d.geometry.RGBDImage:
    assert frame.read_depth is not None and frame.read_colour is not None
    colour, depth = o3d.geometry.Image(frame.read_colour()), o3d.geometry.Image(frame.read_depth().astype(np.float32))
    return o3d.geometry.RGBDImage.create_from_color_and_depth(colour, depth, 1.0, DEPTH_LIMIT_M)

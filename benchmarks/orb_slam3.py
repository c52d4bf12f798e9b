"""ORB-SLAM3 on RGB-D frames: what `main_job.py` prints beside the main job.

It needs `pip install pyorbslam3` (GPL) and Debian's libopengl0, libegl1, libsm6 and libxext6. Its vocabulary has 139 MB
and is no part of the package: one is trained on the frames themselves, which places are recognised by no worse.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.scene import has_real_stamps
from hodge_pipeline.types import Floats, Frame, Source

FRAME_S = 1 / 30
"""Seconds between frames without stamps."""
PAUSE_S = 0.1
"""Seconds after each frame."""
BRANCHES, DEPTH, SMALLEST = 10, 6, 10
"""Of the vocabulary's tree: children of a node, levels, and the descriptors of a node that is not divided further."""
TRAINED_ON = 40
"""Frames that the vocabulary is trained on, evenly over the sequence."""
SETTINGS = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: {camera.fx}
Camera1.fy: {camera.fy}
Camera1.cx: {camera.cx}
Camera1.cy: {camera.cy}
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0
Camera.width: {camera.width}
Camera.height: {camera.height}
Camera.fps: 30
Camera.RGB: 1
Stereo.ThDepth: 40.0
Stereo.b: 0.075
RGBD.DepthMapFactor: 1000.0
ORBextractor.nFeatures: 1000
ORBextractor.scaleFactor: 1.2
ORBextractor.nLevels: 8
ORBextractor.iniThFAST: 20
ORBextractor.minThFAST: 7
Viewer.KeyFrameSize: 0.05
Viewer.KeyFrameLineWidth: 1.0
Viewer.GraphLineWidth: 0.9
Viewer.PointSize: 2.0
Viewer.CameraSize: 0.08
Viewer.CameraLineWidth: 3.0
Viewer.ViewpointX: 0.0
Viewer.ViewpointY: -0.7
Viewer.ViewpointZ: -1.8
Viewer.ViewpointF: 500.0
"""
"""Its own for the TUM sequences, but for the camera: images come undistorted and depth in metres."""


def tracked_by_orb_slam3(source: Source) -> tuple[Floats, int, float]:
    """The poses (N, 4, 4) after all its threads have ended, NaN where it was lost; of how many, and its CPU seconds,
    reading of frames included.

    Frames come slowly: its mapping runs beside tracking, and skips what comes too fast.
    """
    import pyorbslam3

    frames, stamps = source.frames, _stamps(source)
    with tempfile.TemporaryDirectory() as name, _quiet():
        folder = Path(name)
        (folder / "vocabulary.txt").write_text(_vocabulary(frames))
        (folder / "settings.yaml").write_text(SETTINGS.format(camera=frames[0].camera))
        system = pyorbslam3.Slam(folder / "vocabulary.txt", folder / "settings.yaml", pyorbslam3.Sensor.RGBD)
        begin_cpu = time.process_time()
        for frame, stamp in zip(frames, stamps, strict=True):
            assert frame.read_depth is not None
            system.track_rgbd(_grey(frame), 1e3 * np.nan_to_num(frame.read_depth()), stamp)
            time.sleep(PAUSE_S)
        system.shutdown()
        cpu_s = time.process_time() - begin_cpu
        system.save_trajectory_tum(str(folder / "poses.tum"))
        rows = np.loadtxt(folder / "poses.tum", ndmin=2).reshape(-1, 8)  # none where it never began
    poses = np.full((len(frames), 4, 4), np.nan)
    place = np.abs(rows[:, :1] - stamps).argmin(axis=1)
    poses[place] = se3.from_quat_xyzw(rows[:, 1:4], rows[:, 4:8])
    return poses, len(frames) - len(np.unique(place)), cpu_s


def _stamps(source: Source) -> Floats:
    if has_real_stamps(source.frames):
        return np.array([frame.stamp_s for frame in source.frames])
    return FRAME_S * np.arange(len(source.frames))


def _grey(frame: Frame) -> NDArray[np.uint8]:
    assert frame.read_colour is not None
    return cv2.cvtColor(frame.read_colour(), cv2.COLOR_RGB2GRAY)


def _vocabulary(frames: tuple[Frame, ...]) -> str:
    """A tree of ORB descriptors in DBoW2's text format: k-means of k-means, words weighted by inverse frequency."""
    detector = cv2.ORB_create(1500)
    chosen = frames[:: max(len(frames) // TRAINED_ON, 1)]
    each = [detector.detectAndCompute(_grey(frame), None)[1] for frame in chosen]
    each = [found for found in each if found is not None]
    image = np.repeat(np.arange(len(each)), [len(found) for found in each])
    bits = np.unpackbits(np.concatenate(each), axis=1).astype(np.float32)
    cv2.setRNGSeed(0)
    lines, queue, number = [f"{BRANCHES} {DEPTH} 0 0"], deque([(0, np.arange(len(bits)), 1)]), 0
    while queue:
        parent, rows, level = queue.popleft()
        stop = (cv2.TERM_CRITERIA_COUNT, 8, 0.0)
        count = min(BRANCHES, len(rows))
        _, label, _ = cv2.kmeans(bits[rows], count, None, stop, 1, cv2.KMEANS_PP_CENTERS)
        for group in (rows[label.ravel() == child] for child in range(count)):
            if not len(group):
                continue
            number += 1
            is_word = level == DEPTH or len(group) <= SMALLEST
            weight = np.log((1 + len(each)) / len(np.unique(image[group]))) if is_word else 0.0  # 0: features dropped
            centre = " ".join(map(str, np.packbits(bits[group].mean(axis=0) >= 0.5)))
            lines.append(f"{parent} {int(is_word)} {centre} {weight:.6f}")
            if not is_word:
                queue.append((number, group, level + 1))
    return "\n".join(lines) + "\n"


@contextmanager
def _quiet() -> Iterator[None]:
    """Away with what native code writes to standard output and error."""
    kept, nowhere = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        for number, stream in enumerate(kept, 1):
            os.dup2(stream, number)
            os.close(stream)
        os.close(nowhere)

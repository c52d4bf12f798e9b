"""Writes posed frames as a COLMAP model without points, with rigs of one camera each, as COLMAP makes them itself."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.colmap_cameras import HALF_PIXEL
from hodge_adapters.colmap_records import CAMERA_MODELS, to_colmap
from hodge_adapters.colmap_rigs import CAMERA
from hodge_adapters.text_rows import write_bytes_atomically
from hodge_pipeline.errors import SourceError, not_written
from hodge_pipeline.types import Camera, Floats, Frame, Source


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ColmapWriter:
    """Writes a COLMAP model of the frames that have a camera and a pose."""

    form: Literal["bin", "txt"] = Field("bin", description="binary, or text with the digits that restore every number")

    def write(self, path: Path, source: Source) -> None:
        """A folder with cameras, rigs, frames, images and points3D; each file is replaced in one step.

        An image's name is the frame's id, with `.png` where that is a number. Raises `SourceError` where no frame has
        a camera and a pose, or where y points up, which no camera of COLMAP's does.
        """
        frames = [frame for frame in source.frames if frame.camera is not None and frame.world_from_cam is not None]
        if not frames:
            raise SourceError(f"{source.path}: no frame with a camera and a pose: COLMAP needs both")
        cameras = list(dict.fromkeys(frame.camera for frame in frames if frame.camera))
        if any(camera.fy < 0 for camera in cameras):
            raise SourceError(
                f"{source.path}: fy is negative (y points up), which COLMAP has not: turn the images over"
            )
        write = _binary_files if self.form == "bin" else _text_files
        _write_folder(Path(path), write(cameras, frames))


def image_name(frame: Frame) -> str:
    """The name that a frame's image gets in the model."""
    name = f"{frame.frame_id:06d}.png" if isinstance(frame.frame_id, int) else frame.frame_id
    return "_".join(name.split())


def _params(camera: Camera) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL


def _poses(frames: list[Frame]) -> Floats:
    return np.hstack(to_colmap(np.array([frame.world_from_cam for frame in frames])))


def _camera_ids(cameras: list[Camera], frames: list[Frame]) -> list[int]:
    """The number of each frame's camera, from 1; it is the number of its rig as well."""
    numbers = {camera: number for number, camera in enumerate(cameras, 1)}
    return [numbers[frame.camera] for frame in frames if frame.camera is not None]


def _text_files(cameras: list[Camera], frames: list[Frame]) -> dict[str, bytes]:
    lines = [
        f"{number} PINHOLE {camera.width} {camera.height} {' '.join(map(repr, _params(camera)))}\n"
        for number, camera in enumerate(cameras, 1)
    ]
    poses = [" ".join(map(repr, pose)) for pose in _poses(frames).tolist()]
    numbered = list(enumerate(zip(poses, _camera_ids(cameras, frames), frames, strict=True), 1))
    rows = [f"{number} {pose} {camera} {image_name(frame)}\n\n" for number, (pose, camera, frame) in numbered]
    rig_frames = [f"{number} {camera} {pose} 1 CAMERA {camera} {number}\n" for number, (pose, camera, _) in numbered]
    return {
        "cameras.txt": ("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n" + "".join(lines)).encode(),
        "rigs.txt": (
            "# RIG_ID NUM_SENSORS REF_SENSOR_TYPE REF_SENSOR_ID\n"
            + "".join(f"{number} 1 CAMERA {number}\n" for number in range(1, len(cameras) + 1))
        ).encode(),
        "frames.txt": ("# FRAME_ID RIG_ID RIG_FROM_WORLD NUM_DATA_IDS DATA_IDS\n" + "".join(rig_frames)).encode(),
        "images.txt": ("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its points\n" + "".join(rows)).encode(),
        "points3D.txt": b"# POINT3D_ID X Y Z R G B ERROR TRACK\n",
    }


def _binary_files(cameras: list[Camera], frames: list[Frame]) -> dict[str, bytes]:
    number_of_pinhole = CAMERA_MODELS["PINHOLE"][0]
    records = [
        struct.pack("<IiQQ4d", number, number_of_pinhole, camera.width, camera.height, *_params(camera))
        for number, camera in enumerate(cameras, 1)
    ]
    numbered = list(enumerate(zip(_poses(frames).tolist(), _camera_ids(cameras, frames), frames, strict=True), 1))
    rows = [
        struct.pack("<I7dI", number, *pose, camera) + image_name(frame).encode() + struct.pack("<xQ", 0)
        for number, (pose, camera, frame) in numbered
    ]
    rigs = [struct.pack("<IIiI", number, 1, CAMERA, number) for number in range(1, len(cameras) + 1)]
    rig_frames = [
        struct.pack("<II7dIiIQ", number, camera, *pose, 1, CAMERA, camera, number)
        for number, (pose, camera, _) in numbered
    ]
    return {
        "cameras.bin": struct.pack("<Q", len(records)) + b"".join(records),
        "rigs.bin": struct.pack("<Q", len(rigs)) + b"".join(rigs),
        "frames.bin": struct.pack("<Q", len(rig_frames)) + b"".join(rig_frames),
        "images.bin": struct.pack("<Q", len(rows)) + b"".join(rows),
        "points3D.bin": struct.pack("<Q", 0),
    }


def _write_folder(folder: Path, files: dict[str, bytes]) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise not_written(folder, error) from error
    for name, contents in files.items():
        write_bytes_atomically(folder / name, contents)

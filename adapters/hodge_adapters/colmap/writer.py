"""Writes posed frames as a COLMAP model, with rigs of one camera each, as COLMAP makes them itself; a model that was
read from COLMAP's files stays whole, points and rigs included.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.colmap.content import read_model
from hodge_adapters.colmap.files import find_model
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.images.lens_models import pinhole_params
from hodge_adapters.posed import written
from hodge_adapters.text_rows import listed, write_bytes_atomically
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError, not_written
from hodge_pipeline.types import Frame, Source
from hodge_pipeline.types.input_files import read_input
from hodge_pipeline.types.text import counted

SAME = 1e-6
"""Of the positions' spread, and of a rotation's entries: poses that differ by less are the same."""
Lens = tuple[str, int, int, tuple[float, ...]]
"""A camera model by name, width, height, parameters."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ColmapWriter:
    """Writes a COLMAP model of the frames that have a camera and a pose."""

    form: Literal["bin", "txt"] = Field("bin", description="binary, or text with the digits that restore every number")

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """A folder with cameras, rigs, frames, images and points3D; each file is replaced in one step.

        A camera is that of the frame's image file, distortion included, else the frame's own; an image's name is the
        frame's id, or its file's where that is a number. A model that was read from COLMAP's files keeps its points.
        Raises `SourceError` where no frame has a camera and a pose, or where y points up, which no camera of COLMAP's
        does.
        """
        frames = [frame for frame in source.frames if frame.camera is not None and frame.world_from_cam is not None]
        if not frames:
            raise SourceError(f"{source.path}: no frame with a camera and a pose: COLMAP needs both")
        if any(frame.camera.fy < 0 for frame in frames if frame.camera):
            raise SourceError(
                f"{source.path}: fy is negative (y points up), which COLMAP has not: turn the images over"
            )
        model = _whole_model(source, frames)
        points = "no points" if model is None else counted(model.num_points3D(), "point")
        model = model or _made_model(frames)
        blank = [image.name for image in model.images.values() if len(image.name.split()) != 1]
        if blank and self.form == "txt":
            raise SourceError(
                f"{source.path}: COLMAP's text cannot hold names with blanks ({listed(blank)}): write form=bin"
            )
        _write_folder(Path(path), _files_of(model, self.form))
        sizes = f"{counted(model.num_reg_images(), 'image')}, {counted(model.num_cameras(), 'camera')}"
        return written(f"{sizes}, {points}", source, {"cameras", "names", "images"})


def _whole_model(source: Source, frames: list[Frame]) -> pycolmap.Reconstruction | None:
    """The model that the frames were read from, in their unit of length; None where they are no such model's, or not
    all of it, or have other poses.
    """
    folder = find_model(source.path) if source.path.is_dir() else None
    if folder is None:
        return None
    try:
        model, _ = read_model(folder)
    except SourceError:
        return None
    images = {
        image.name: image.cam_from_world().inverse().matrix() for image in model.images.values() if image.has_pose
    }
    if set(images) != {frame.frame_id for frame in frames}:
        return None
    before = np.array([images[frame.frame_id] for frame in frames])
    after = np.array([frame.world_from_cam for frame in frames])[:, :3]
    spread = [float(np.linalg.norm(poses[:, :, 3] - poses[:, :, 3].mean(axis=0))) for poses in (before, after)]
    scale = spread[1] / spread[0] if spread[0] > 0 else 1.0
    turned = np.abs(after[:, :, :3] - before[:, :, :3]).max()
    moved = np.abs(after[:, :, 3] - scale * before[:, :, 3]).max()
    if turned > SAME or moved > SAME * max(spread[1], 1e-300):
        return None
    if abs(scale - 1) > SAME:
        model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)))
    return model


def _made_model(frames: list[Frame]) -> pycolmap.Reconstruction:
    """A model of these frames without points: a rig for each camera, a frame for each image."""
    model, numbers = pycolmap.Reconstruction(), dict[Lens, int]()
    for row, (frame, name) in enumerate(zip(frames, _names(frames), strict=True), 1):
        lens = _lens(frame)
        if lens not in numbers:
            numbers[lens] = len(numbers) + 1
            kind, width, height, params = lens
            camera = pycolmap.Camera(
                camera_id=numbers[lens], model=kind, width=width, height=height, params=np.array(params)
            )
            model.add_camera_with_trivial_rig(camera)
        assert frame.world_from_cam is not None
        image = pycolmap.Image(name, np.zeros((0, 2)), numbers[lens], row)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(se3.inverse(frame.world_from_cam)[:3]))
    return model


def _files_of(model: pycolmap.Reconstruction, form: str) -> dict[str, bytes]:
    with tempfile.TemporaryDirectory(prefix="hodge-colmap-") as scratch:
        (model.write_binary if form == "bin" else model.write_text)(scratch)
        return {file.name: read_input(file) for file in sorted(Path(scratch).iterdir())}


def _lens(frame: Frame) -> Lens:
    if frame.image is not None:
        return frame.image.lens, frame.image.width, frame.image.height, frame.image.params
    camera = frame.camera
    assert camera is not None
    return "PINHOLE", camera.width, camera.height, pinhole_params(camera)


def _names(frames: list[Frame]) -> list[str]:
    """The name of each frame's image in the model: its id, or its file's name where that is but a number."""
    files = [frame.image.path.name if frame.image else f"{frame.frame_id}.png" for frame in frames]
    numbered = [f"{frame.frame_id:06d}.png" if isinstance(frame.frame_id, int) else frame.frame_id for frame in frames]
    if len(set(files)) < len(files) or not all(isinstance(frame.frame_id, int) and frame.image for frame in frames):
        return numbered
    return files


def _write_folder(folder: Path, files: dict[str, bytes]) -> None:
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise not_written(folder, error) from error
    for name, contents in files.items():
        write_bytes_atomically(folder / name, contents)

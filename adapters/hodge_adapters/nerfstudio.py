"""nerfstudio's `transforms.json`: poses of OpenGL cameras (x right, y up, looking along −z), turned into ours here."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters import images
from hodge_adapters.json_files import first_text, motion, number, objects, read_json, whole, write_json
from hodge_adapters.posed import trajectory_of
from hodge_adapters.text_rows import inside, listed
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Camera, Frame, Source, Trajectory

FILE = "transforms.json"
OPENGL_FROM_CAM = np.diag([1.0, -1.0, -1.0, 1.0])
HALF_PIXEL = 0.5
"""nerfstudio puts 0, 0 at the outer corner of the first pixel."""
MAX_SIDE = 1 << 16
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
METRES_PER_UNIT = 1e-3


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NerfstudioReader:
    """Opens a `transforms.json`, or the folder with one: posed images, with depth where the file names some."""

    no_depth: tuple[int, ...] = Field((0, 65535), description="stored depth values that mean none")
    every: int = Field(1, ge=1, description="take every n-th frame")

    def sniff(self, path: Path) -> Sniff:
        """By the name, or by the keys near the first_text."""
        path = Path(path)
        text = first_text(path / FILE if path.is_dir() else path)
        if '"transform_matrix"' in text or '"frames"' in text:
            return Sniff(0.9, "frames with a transform_matrix")
        return Sniff(0.0, "no transforms.json")

    def open(self, path: Path) -> Source:
        """Frames in the file's order: id is `file_path`, stamp the row. World and scale are the file's own."""
        path = Path(path)
        file = path / FILE if path.is_dir() else path
        content = read_json(file)
        entries = objects(content.get("frames"), f"{file}: frames")
        if not entries:
            raise SourceError(f"{file}: no frames in it: give a transforms.json that has some")
        notes: list[str] = []
        frames = tuple(self._frame(file, row, content, entry) for row, entry in enumerate(entries))
        if len({frame.frame_id for frame in frames}) < len(frames):
            raise SourceError(f"{file}: two frames have the same file_path: remove one")
        if any(number(place.get(name)) for place in (content, *entries) for name in DISTORTION):
            notes.append("the cameras have lens distortion, which is not corrected: undistort the images first")
        lost = [frame.frame_id for frame in frames if frame.read_colour is None]
        if lost:
            notes.append(f"{len(lost)} of {len(frames)} images are not there as PNG or JPEG: {listed(lost)}")
        poses = np.array([frame.world_from_cam for frame in frames])
        trajectory = Trajectory(np.arange(len(frames), dtype=float), poses)
        name = file.parent.resolve().name if path.is_dir() else file.stem
        return Source(name, path, frames[:: self.every], trajectory, notes=tuple(notes), files=(file,))

    def _frame(self, file: Path, row: int, content: dict[str, Any], entry: dict[str, Any]) -> Frame:
        where = f"{file}: frame {row}"
        pose = motion(entry.get("transform_matrix"), where) @ OPENGL_FROM_CAM
        name = entry.get("file_path")
        if not isinstance(name, str) or not name:
            raise SourceError(f"{where}: has no file_path: mend the file")
        camera = _camera({**content, **entry}, where)
        colour = _existing(file.parent, name)
        depth = _existing(file.parent, entry.get("depth_file_path"))
        unit = number(content.get("depth_unit_scale_factor")) or METRES_PER_UNIT
        if unit <= 0:
            raise SourceError(f"{file}: depth_unit_scale_factor is {unit:g}: it is metres per stored unit")
        size = (camera.width, camera.height) if camera else None
        read = partial(images.read_depth, units_per_metre=1 / unit, no_depth=self.no_depth, size=size)
        return Frame(
            frame_id=name,
            stamp_s=float(row),
            camera=camera,
            read_depth=partial(read, depth) if depth and camera else None,
            read_colour=partial(images.read_colour, colour, size=size) if colour else None,
            encoded_depth=partial(images.encoded_depth, depth, units_per_metre=1 / unit) if depth and camera else None,
            encoded_colour=partial(images.encoded_colour, colour) if colour else None,
            world_from_cam=pose,
        )


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NerfstudioWriter:
    """Writes posed frames as a `transforms.json`."""

    def write(self, path: Path, source: Source) -> None:
        """One file, atomically. A frame's `file_path` is its id; stamps are lost."""
        posed = [frame for frame in source.frames if frame.world_from_cam is not None]
        if posed:
            entries = [_entry(str(frame.frame_id), frame.world_from_cam, frame.camera) for frame in posed]
        else:
            poses = trajectory_of(source).world_from_cam
            entries = [_entry(f"{row:06d}", pose, None) for row, pose in enumerate(poses)]
        write_json(Path(path), {"camera_model": "OPENCV", "orientation_override": "none", "frames": entries})


def _entry(name: str, world_from_cam: Any, camera: Camera | None) -> dict[str, Any]:
    entry: dict[str, Any] = {"file_path": name}
    if camera is not None:
        entry |= {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
        entry |= {"cx": camera.cx + HALF_PIXEL, "cy": camera.cy + HALF_PIXEL}
    return entry | {"transform_matrix": (world_from_cam @ OPENGL_FROM_CAM + 0.0).tolist()}


def _camera(values: dict[str, Any], where: str) -> Camera | None:
    """The camera, None where the file gives no intrinsics."""
    if "fl_x" not in values:
        return None
    width, height = whole(values.get("w"), 1, MAX_SIDE), whole(values.get("h"), 1, MAX_SIDE)
    fx, cx, cy = (number(values.get(key)) for key in ("fl_x", "cx", "cy"))
    fy = number(values.get("fl_y", fx))
    if not width or not height or not fx or fx <= 0 or not fy or cx is None or cy is None:
        raise SourceError(f"{where}: w, h, fl_x, fl_y, cx, cy are no camera: mend the file")
    return Camera(width, height, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL)


def _existing(folder: Path, name: Any) -> Path | None:
    """The image of a frame inside the folder; older files leave out the ending."""
    if not isinstance(name, str) or "\0" in name:
        return None
    for ending in ("", ".png", ".jpg"):
        path = inside(folder, name + ending)
        if path and path.suffix.lower() in (".png", ".jpg", ".jpeg") and path.is_file():
            return path
    return None

"""nerfstudio's `transforms.json`: poses of OpenGL cameras (x right, y up, looking along −z), turned into ours here."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.images import pixels
from hodge_adapters.images.headers import MAX_SIDE
from hodge_adapters.images.lens_models import (
    FISHEYE,
    HALF_PIXEL,
    NAMES,
    PERSPECTIVE,
    image_file,
    named,
    pinhole_params,
)
from hodge_adapters.json_files import motion, number, objects, read_json, whole, write_json
from hodge_adapters.posed import trajectory_of, written
from hodge_adapters.text_rows import first_text, inside, listed, write_bytes_atomically
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError, not_written
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Camera, Frame, ImageFile, Source, Trajectory
from hodge_pipeline.types.input_files import read_input
from hodge_pipeline.types.text import counted

FILE = "transforms.json"
IMAGES = "images"
ENDINGS = (".png", ".jpg", ".jpeg")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
METRES_PER_UNIT = 1e-3


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NerfstudioReader:
    """Opens a `transforms.json`, or the folder with one: posed images, with depth where the file names some."""

    no_depth: tuple[int, ...] = Field((0, 65535), description="stored depth values that mean none")
    every: int = Field(1, ge=1, description="take every n-th frame")

    def sniff(self, path: Path) -> Sniff:
        """By the name, or by the keys near its beginning."""
        path = Path(path)
        text = first_text(transforms_file(path))
        if '"transform_matrix"' in text or '"frames"' in text:
            return Sniff(0.9, "frames with a transform_matrix")
        return Sniff(0.0, "no transforms.json")

    def open(self, path: Path) -> Source:
        """Frames in the file's order: id is `file_path`, stamp the row. World and scale are the file's own."""
        path = Path(path)
        file = transforms_file(path)
        content = read_json(file)
        entries = objects(content.get("frames"), f"{file}: frames")
        if not entries:
            raise SourceError(f"{file}: no frames in it: give a transforms.json that has some")
        notes: list[str] = []
        content = {**_by_angle(file, content, entries, notes), **content}
        merged = [{**content, **entry} for entry in entries]
        frames = tuple(self._frame(file, row, values) for row, values in enumerate(merged))
        if len({frame.frame_id for frame in frames}) < len(frames):
            raise SourceError(f"{file}: two frames have the same file_path: remove one")
        lenses = [_lens(values) for values in merged]
        if FISHEYE in lenses or any(number(values.get(name)) for values in merged for name in DISTORTION):
            notes.append("the cameras have lens distortion, which is not corrected: undistort the images first")
        if any(lens == PERSPECTIVE and number(values.get("k4")) for lens, values in zip(lenses, merged, strict=True)):
            notes.append("k4 of a lens that is no fisheye is left out: COLMAP has no such lens")
        lost = [frame.frame_id for frame in frames if frame.read_colour is None]
        if lost:
            notes.append(f"{len(lost)} of {len(frames)} images are not there as PNG or JPEG: {listed(lost)}")
        told = zip(frames, merged, strict=True)
        lost = [frame.frame_id for frame, values in told if values.get("depth_file_path") and not frame.read_depth]
        if lost:
            notes.append(
                f"{len(lost)} of {len(frames)} depth images are not read, since they are not there or have no camera "
                f"(w, h, fl_x): {listed(lost)}"
            )
        poses = np.array([frame.world_from_cam for frame in frames])
        trajectory = Trajectory(np.arange(len(frames), dtype=float), poses, has_stamps=False)
        name = file.parent.resolve().name if path.is_dir() else file.stem
        return Source(name, path, frames[:: self.every], trajectory, notes=tuple(notes), files=(file,))

    def _frame(self, file: Path, row: int, values: dict[str, Any]) -> Frame:
        where = f"{file}: frame {row}"
        pose = motion(values.get("transform_matrix"), where) @ se3.OPENGL_FROM_CAM
        name = values.get("file_path")
        if not isinstance(name, str) or not name:
            raise SourceError(f"{where}: has no file_path: mend the file")
        camera = _camera(values, where)
        colour = _existing(file.parent, name)
        depth = _existing(file.parent, values.get("depth_file_path"))
        stated = values.get("depth_unit_scale_factor")
        unit = METRES_PER_UNIT if stated is None else number(stated)
        if unit is None or unit <= 0:
            raise SourceError(f"{file}: depth_unit_scale_factor is {stated!r:.40}: give metres per stored unit")
        size = (camera.width, camera.height) if camera else None
        read = partial(pixels.read_depth, units_per_metre=1 / unit, no_depth=self.no_depth, size=size)
        return Frame(
            frame_id=name,
            stamp_s=float(row),
            camera=camera,
            read_depth=partial(read, depth) if depth and camera else None,
            read_colour=partial(pixels.read_colour, colour, size=size) if colour else None,
            encoded_depth=partial(pixels.encoded, depth, units_per_metre=1 / unit) if depth and camera else None,
            encoded_colour=partial(pixels.encoded, colour) if colour else None,
            image=_image_file(colour, camera, values) if colour and camera else None,
            world_from_cam=pose,
        )


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class NerfstudioWriter:
    """Writes posed frames as a `transforms.json`, with images that its cameras fit."""

    def write(self, path: Path, source: Source) -> tuple[str, ...]:
        """A `.json`, or `transforms.json` in a folder of that name, atomically, after the images: each stays where it
        is below the file's folder, else a copy goes to `images/` beside it. Lens distortion passes through where
        nerfstudio knows the lens (k1 to k4, p1, p2, for all images alike); else undistorted images are written there.
        Without an image `file_path` is the frame's id.
        """
        path = Path(path) if Path(path).suffix == ".json" else Path(path) / FILE
        posed = [frame for frame in source.frames if frame.world_from_cam is not None]
        if not posed:
            poses = trajectory_of(source).world_from_cam
            bare = [_entry(f"{row:06d}", pose, None) for row, pose in enumerate(poses)]
            write_json(
                _target(path.parent, path.name),
                {"camera_model": PERSPECTIVE, "orientation_override": "none", "frames": bare},
            )
            return written(f"{counted(len(bare), 'pose')} without images", source)
        lenses = [None if frame.image is None else named(frame.image) for frame in posed]
        models = {lens[0] for lens in lenses if lens}
        model = models.pop() if len(models) == 1 else None
        entries, done = [], Counter[str]()
        for frame, lens in zip(posed, lenses, strict=True):
            if lens is not None and model is not None and frame.image is not None:
                name, how = _placed(path.parent, frame.image.path, frame.frame_id)
                entries.append(_entry(name, frame.world_from_cam, lens[1]))
            else:
                name, how = _undistorted(path.parent, frame)
                entries.append(_entry(name, frame.world_from_cam, _pinhole(frame.camera)))
            done[how] += 1
        write_json(
            _target(path.parent, path.name),
            {"camera_model": model or PERSPECTIVE, "orientation_override": "none", "frames": entries},
        )
        how = ", ".join(f"{count} {what}" for what, count in done.items())
        return written(f"{counted(len(entries), 'frame')}: {how}", source, {"cameras", "names", "images"})


def transforms_file(path: Path) -> Path:
    """The file itself, or the one in a folder."""
    return path / FILE if path.is_dir() else path


def opengl_matrix(world_from_cam: Any) -> list[list[float]]:
    """The rows of a `transform_matrix`."""
    return (world_from_cam @ se3.OPENGL_FROM_CAM + 0.0).tolist()  # type: ignore[no-any-return]


def _entry(name: str, world_from_cam: Any, camera: Mapping[str, float] | None) -> dict[str, Any]:
    return {"file_path": name, **(camera or {}), "transform_matrix": opengl_matrix(world_from_cam)}


def _pinhole(camera: Camera | None) -> dict[str, float]:
    if camera is None:
        return {}
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy")
    return dict(zip(names, (camera.width, camera.height, *pinhole_params(camera)), strict=True))


def _placed(folder: Path, image: Path, frame_id: int | str) -> tuple[str, str]:
    """The `file_path` of an image below the folder, where a copy is put if it lies elsewhere: named as the frame, or
    as the file where the frame has but a number.
    """
    base = folder.resolve()
    if image.resolve().is_relative_to(base):
        return image.resolve().relative_to(base).as_posix(), "images where they are"
    target = _target(folder / IMAGES, image.name if isinstance(frame_id, int) else _bare(frame_id) + image.suffix)
    write_bytes_atomically(target, read_input(image))
    return target.relative_to(folder).as_posix(), "images copied"


def _undistorted(folder: Path, frame: Frame) -> tuple[str, str]:
    """The `file_path` of the image that a frame's pinhole camera sees, written as PNG."""
    if frame.read_colour is None:
        return str(frame.frame_id), "without an image"
    target = _target(folder / IMAGES, _bare(str(frame.frame_id)) + ".png")
    done, contents = cv2.imencode(".png", cv2.cvtColor(frame.read_colour(), cv2.COLOR_RGB2BGR))
    assert done
    write_bytes_atomically(target, bytes(contents))
    return target.relative_to(folder).as_posix(), "images written undistorted"


def _bare(name: str) -> str:
    """The name without the ending of an image."""
    pure = PurePosixPath(name)
    return str(pure.with_suffix("")) if pure.suffix.lower() in ENDINGS else name


def _target(folder: Path, name: str) -> Path:
    """The path of this file in the folder, which is made."""
    target = inside(folder, name)
    if target is None:
        raise SourceError(f"{name!r}: the name of an image leaves its folder: rename it")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise not_written(target, error) from error
    return target


def _by_angle(file: Path, content: dict[str, Any], entries: list[dict[str, Any]], notes: list[str]) -> dict[str, float]:
    """The camera of a file that tells but the angle that its images' width spans, as Blender's do: by their size."""
    if "camera_angle_x" not in content or any("fl_x" in place for place in (content, *entries)):
        return {}
    size = content.get("w"), content.get("h")
    if None in size:
        images = [image for entry in entries if (image := _existing(file.parent, entry.get("file_path")))]
        if not images:
            notes.append("camera_angle_x tells no camera, since neither w and h nor images are there: give these")
            return {}
        size = pixels.common_size(images)
    width, height = (whole(side, 1, MAX_SIDE) for side in size)
    angle = number(content["camera_angle_x"])
    if not width or not height or not angle or not 0 < angle < math.pi:
        raise SourceError(f"{file}: w, h, camera_angle_x are no camera: mend the file")
    return {"w": width, "h": height, "fl_x": width / 2 / math.tan(angle / 2), "cx": width / 2, "cy": height / 2}


def _lens(values: dict[str, Any]) -> str | None:
    """Whether the camera is perspective or a fisheye by nerfstudio's names; None for another, such as a panorama."""
    model = str(values.get("camera_model") or PERSPECTIVE).upper()
    return NAMES[model][0] if model in NAMES else None


def _camera(values: dict[str, Any], where: str) -> Camera | None:
    """The camera, None where the file gives no intrinsics. Raises `SourceError` for one that is no pinhole."""
    if "fl_x" not in values:
        return None
    if _lens(values) is None:
        raise SourceError(
            f"{where}: camera_model is {values['camera_model']!r:.40}, neither perspective nor a known fisheye: "
            "give images of such a camera"
        )
    width, height = whole(values.get("w"), 1, MAX_SIDE), whole(values.get("h"), 1, MAX_SIDE)
    fx, cx, cy = (number(values.get(key)) for key in ("fl_x", "cx", "cy"))
    fy = number(values.get("fl_y", fx))
    if not width or not height or not fx or fx <= 0 or not fy or cx is None or cy is None:
        raise SourceError(f"{where}: w, h, fl_x, fl_y, cx, cy are no camera: mend the file")
    return Camera(width, height, fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL)


def _image_file(path: Path, camera: Camera, values: dict[str, Any]) -> ImageFile:
    """The image with the lens that the file says."""
    k1, k2, k3, k4, p1, p2 = (number(values.get(name)) or 0.0 for name in DISTORTION)
    if _lens(values) == FISHEYE:
        return image_file(path, camera, FISHEYE, (k1, k2, k3, k4))
    if k3:
        return image_file(path, camera, "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    return (
        image_file(path, camera, PERSPECTIVE, (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else image_file(path, camera)
    )


def _existing(folder: Path, name: Any) -> Path | None:
    """The image of a frame inside the folder; older files leave out the ending."""
    if not isinstance(name, str) or "\0" in name:
        return None
    for ending in ("", ".png", ".jpg"):
        path = inside(folder, name + ending)
        if path and path.suffix.lower() in ENDINGS and path.is_file():
            return path
    return None

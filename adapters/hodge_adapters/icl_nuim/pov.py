"""ICL-NUIM's POV-Ray files: `scene_00_0000.depth` (ray lengths as text), `.png` and `.txt` (camera parameters)."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from hodge_adapters.images import pixels
from hodge_adapters.text_rows import listed, names_in, read_text, reading, to_floats
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Camera, Floats, Floats32, Frame
from hodge_pipeline.types.input_files import read_input
from hodge_pipeline.types.text import counted

FARTHEST_M = 1000.0
"""A ray that hits nothing has a huge length: no measurement."""

_DEPTH_FILE = re.compile(r"scene_(\d+)_(\d+)\.depth$")
_VECTOR = re.compile(r"(cam_\w+)\s*=\s*\[([^\]]*)\]")
_BYTES_PER_NUMBER = 32


def list_pov(folder: Path) -> dict[int, Path]:
    """The `.depth` files of a folder by frame number."""
    matches = [(_DEPTH_FILE.match(name), folder / name) for name in names_in(folder)]
    return {int(match[2]): path for match, path in matches if match}


def pov_frames(
    depth: dict[int, Path], camera: Camera, units_per_metre: float, notes: list[str]
) -> tuple[list[Frame], tuple[Path, ...]]:
    """The frames of the `.depth` files, and all files that they need."""
    frames: list[Frame] = []
    files: list[Path] = []
    without: list[int] = []
    size = camera.width, camera.height
    for number, path in sorted(depth.items()):
        colour, parameters = path.with_suffix(".png"), path.with_suffix(".txt")
        pose = read_pose(parameters, units_per_metre) if parameters.is_file() else None
        if pose is None:
            without.append(number)
        has_colour = colour.is_file()
        files.extend(file for file in (path, colour, parameters) if file.is_file())
        frames.append(
            Frame(
                frame_id=number,
                stamp_s=float(number),
                camera=camera,
                read_depth=partial(read_ray_lengths, path, camera=camera, units_per_metre=units_per_metre),
                read_colour=partial(pixels.read_colour, colour, size=size) if has_colour else None,
                encoded_colour=partial(pixels.encoded, colour) if has_colour else None,
                world_from_cam=pose,
                true_world_from_cam=pose,
            )
        )
    if without:
        notes.append(f"{counted(len(without), 'frame')} without usable camera parameters: {listed(without)}")
    far = [
        frame for frame in frames if frame.world_from_cam is not None and abs(frame.world_from_cam[:3, 3]).max() > 50
    ]
    if far:
        notes.append("positions beyond 50 m: are the files in centimetres? then set depth_scale to 100")
    return frames, tuple(files)


def read_ray_lengths(path: Path, *, camera: Camera, units_per_metre: float) -> Floats32:
    """Depth z (H, W) in float32 metres from the Euclidean lengths of the rays, 0 where they hit nothing.

    The ray of a pixel has the direction `(x, y, 1)`, so `z = length / sqrt(x² + y² + 1)`.
    """
    count = camera.width * camera.height
    try:
        with reading(path):
            lengths = np.array(read_input(path, count * _BYTES_PER_NUMBER).split(), np.float64) / units_per_metre
    except ValueError as error:
        raise SourceError(f"{path}: not a text of ray lengths: copy it again from its source") from error
    if len(lengths) != count:
        expected = f"{camera.width}x{camera.height}"
        raise SourceError(f"{path}: {len(lengths)} ray lengths, the camera has {expected}: the file is truncated")
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    seen = np.isfinite(lengths) & (lengths > 0) & (lengths < FARTHEST_M)
    z = np.where(seen, lengths, 0.0).reshape(camera.height, camera.width) / np.sqrt(x**2 + y[:, None] ** 2 + 1)
    return np.asarray(z, np.float32)


def read_pose(path: Path, units_per_metre: float) -> Floats | None:
    """The pose world_from_cam (4, 4) of a camera file, None where its vectors are missing or degenerate.

    The axes are right = up × direction, up, direction: y points up, as fy < 0 says.
    """
    vectors = {name: to_floats(text.replace(",", " ").split()) for name, text in _VECTOR.findall(read_text(path))}
    found = [vectors.get(name) or [] for name in ("cam_pos", "cam_dir", "cam_up")]
    if any(len(vector) != 3 for vector in found):
        return None
    position, ahead, up = np.array(found)
    if not np.isfinite(position).all() or not np.abs([ahead, up]).max() < 1e9:  # of nan too
        return None
    right = np.cross(up, ahead)
    if not (np.linalg.norm([ahead, up, right], axis=1) > 1e-9).all():
        return None
    z, x = ahead / np.linalg.norm(ahead), right / np.linalg.norm(right)
    return se3.from_parts(np.column_stack([x, np.cross(z, x), z]), position / units_per_metre)

"""Lazy frames of a depth image and the colour image on the same pixel grid."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hodge_adapters.images import pixels
from hodge_adapters.images.camera_files import resized
from hodge_adapters.images.lens import (
    Lens,
    encoded_colour,
    encoded_straight_colour,
    encoded_straight_depth,
    straight_colour,
    straight_depth,
)
from hodge_adapters.images.lens_models import image_file
from hodge_pipeline.types import Camera, Floats, Frame, ImageFile


def image_frame(
    frame_id: int | str,
    stamp_s: float,
    camera: Camera,
    depth: Path,
    colour: Path | None,
    *,
    units_per_metre: float,
    no_depth: tuple[int, ...] = (0, 65535),
    world_from_cam: Floats,
    is_true: bool = False,
    sequence: str = "",
    lens: Lens | None = None,
    colour_delay_s: float = 0.0,
    colour_size: tuple[int, int] | None = None,
) -> Frame:
    """A frame that reads its images when asked, and then refuses those of another size than the camera.

    With a lens they are bent straight first. Colour files of another size (`colour_size`) but the camera's shape are
    brought to its size. A pose (4, 4) that is not finite means none; `is_true` says that it is
    a benchmark's.
    """
    pose = world_from_cam if np.isfinite(world_from_cam).all() else None
    size = camera.width, camera.height
    frame = Frame(
        frame_id=frame_id,
        stamp_s=float(stamp_s),
        camera=camera,
        read_depth=partial(pixels.read_depth, depth, units_per_metre=units_per_metre, no_depth=no_depth, size=size),
        read_colour=partial(pixels.read_colour, colour, size=size) if colour else None,
        encoded_depth=partial(pixels.encoded, depth, units_per_metre=units_per_metre),
        encoded_colour=partial(encoded_colour, colour, size) if colour else None,
        image=None if colour is None else _image_file(colour, resized(camera, colour_size or size), lens),
        world_from_cam=pose,
        true_world_from_cam=pose if is_true else None,
        sequence=sequence,
        colour_delay_s=colour_delay_s,
    )
    return frame if lens is None else _straight(frame, lens, units_per_metre)


def _image_file(path: Path, camera: Camera, lens: Lens | None) -> ImageFile:
    if lens is None:
        return image_file(path, camera)
    return image_file(path, camera, "FULL_OPENCV", (*lens.distortion, 0.0, 0.0, 0.0))


def _straight(frame: Frame, lens: Lens, units_per_metre: float) -> Frame:
    depth, colour = frame.read_depth, frame.read_colour
    return replace(
        frame,
        read_depth=partial(straight_depth, depth, lens) if depth else None,
        encoded_depth=partial(encoded_straight_depth, depth, lens, units_per_metre) if depth else None,
        read_colour=partial(straight_colour, colour, lens) if colour else None,
        encoded_colour=partial(encoded_straight_colour, colour, lens) if colour else None,
    )

"""Frames of depth images, point clouds or colour images of a recording, which are decoded when they are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from hodge_adapters.images.frames import Lens, as_jpeg, undistorted
from hodge_adapters.images.second_camera import SecondCamera, read_on_depth_pixels
from hodge_adapters.mcap.clouds import CloudLayout, read_points
from hodge_adapters.mcap.images import UNITS_PER_METRE, ImageLayout, encoded_image, read_colour, read_depth
from hodge_adapters.mcap.recording import Seen
from hodge_pipeline.types import Camera, EncodedImage, Frame


def depth_frames(
    images: Sequence[Seen[ImageLayout]],
    coloured: Sequence[Seen[ImageLayout] | None],
    camera: Camera,
    lens: Lens | None,
    second: SecondCamera | None,
    *,
    depth_scale: float | None,
    no_depth: tuple[int, ...],
) -> list[Frame]:
    """A frame for each depth image, with the colour image of its row; `lens` of images to be undistorted, `second` the
    camera of colour where it is not that of depth.
    """
    units, frames = depth_scale or UNITS_PER_METRE, []
    for row, (image, other) in enumerate(zip(images, coloured, strict=True)):
        is_plain_png = image.layout.coding == "png" and image.layout.quantisation is None
        frame = Frame(
            frame_id=row,
            stamp_s=image.stamp_s,
            camera=camera,
            read_depth=partial(read_depth, image.payload, image.layout, units_per_metre=depth_scale, no_depth=no_depth),
            encoded_depth=partial(encoded_image, image.payload, image.layout, units) if is_plain_png else None,
            read_colour=partial(read_colour, other.payload, other.layout) if other and not second else None,
            encoded_colour=_encoded_colour(other),
            colour_delay_s=other.stamp_s - image.stamp_s if other else 0.0,
        )
        frame = undistorted(frame, lens, units) if lens else frame
        frames.append(_beside(frame, other, second) if second and other else frame)
    return frames


def cloud_frames(clouds: Sequence[Seen[CloudLayout]]) -> list[Frame]:
    """A frame for each cloud."""
    return [
        Frame(row, cloud.stamp_s, read_points=partial(read_points, cloud.payload, cloud.layout))
        for row, cloud in enumerate(clouds)
    ]


def colour_frames(images: Sequence[Seen[ImageLayout]], camera: Camera | None, lens: Lens | None) -> list[Frame]:
    """A frame for each colour image; `lens` of images to be undistorted."""
    frames = [
        Frame(
            row,
            image.stamp_s,
            camera,
            read_colour=partial(read_colour, image.payload, image.layout),
            encoded_colour=_encoded_colour(image),
        )
        for row, image in enumerate(images)
    ]
    return [undistorted(frame, lens, UNITS_PER_METRE) for frame in frames] if lens else frames


def _beside(frame: Frame, image: Seen[ImageLayout], second: SecondCamera) -> Frame:
    """The frame with colour of a camera beside that of its depth, on the pixels of depth."""
    assert frame.read_depth is not None and frame.camera is not None
    seen = partial(read_colour, image.payload, image.layout)
    colour = partial(read_on_depth_pixels, seen, frame.read_depth, frame.camera, second)
    return replace(frame, read_colour=colour, encoded_colour=partial(as_jpeg, colour))


def _encoded_colour(image: Seen[ImageLayout] | None) -> Callable[[], EncodedImage] | None:
    if image is None or image.layout.coding == "raw":
        return None
    return partial(encoded_image, image.payload, image.layout)

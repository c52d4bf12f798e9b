"""A frame while its block is tracked: its image, corners and cloud, each made when it is first needed; and frames that
repeat the one before.
"""

from __future__ import annotations

import filecmp
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.clouds import CloudOptions, cloud_or_note, is_blank
from hodge_pipeline.registration.tracking.flow import Corners, FlowImage, find_corners, flow_image
from hodge_pipeline.stages import Registrar
from hodge_pipeline.types import Bytes, Floats, Frame, Ints, PointCloud

FEWEST_FOLLOWED = 25
"""Corners that must agree on a motion for it to be believed; below it clouds are registered."""


def read_once(frame: Frame) -> Frame:
    """The frame, whose images are decoded once and kept as long as it is; an error is raised each time."""
    depth, colour = frame.read_depth, frame.read_colour
    return replace(frame, read_depth=depth and cache(depth), read_colour=colour and cache(colour))


class TrackedFrame:
    """A frame at its `place` in the block; `left_out` is the share of its image that moves otherwise than the camera,
    `unread` why its image cannot be read, `twist (6,)` the camera's velocity per second in its own axes.
    """

    def __init__(self, frame: Frame, place: int, clouds: CloudOptions, registrar: Registrar) -> None:
        self._frame, self.place, self._clouds, self._registrar = read_once(frame), place, clouds, registrar
        self.left_out, self.unread = 0.0, ""
        self.twist: Floats = np.zeros(6)
        self.colour_delay_s = frame.colour_delay_s

    @cached_property
    def image(self) -> FlowImage | None:
        """The image for optical flow, None where it lacks colour, depth or camera, or cannot be read (see `unread`)."""
        range_m = self._clouds.min_range_m, self._clouds.max_range_m
        try:
            return flow_image(self._frame, range_m, self._clouds.unit_m)
        except (SourceError, OSError) as error:
            self.unread = str(error)
            return None

    @property
    def is_blank(self) -> bool:
        """Whether the frame has depth, and an image that shows nothing."""
        return self.image is not None and bool((self.image.depth > 0).any()) and is_blank(self.image.grey)

    @cached_property
    def corners(self) -> Corners | None:
        """What flow follows from this frame."""
        return None if self.image is None else find_corners(self.image)

    @property
    def can_be_followed(self) -> bool:
        """Whether it shows enough for flow."""
        return self.corners is not None and len(self.corners) >= FEWEST_FOLLOWED

    @cached_property
    def cloud_and_note(self) -> tuple[PointCloud, str]:
        """The frame's cloud, and a note where something is odd about it."""
        return cloud_or_note(self._frame, self._clouds)

    @property
    def cloud(self) -> PointCloud:
        """The frame's cloud."""
        return self.cloud_and_note[0]

    @cached_property
    def prepared(self) -> Any:
        """What the registrar made of the cloud."""
        return self._registrar.prepare(self.cloud)

    def leave_out(self, moving: Bytes, corners: Corners) -> None:
        """From now on the frame has no depth where `moving (H, W)` is not 0, the share `left_out` at most, and flow
        follows these corners.
        """
        assert self.image is not None
        self.left_out = max(self.left_out, float((moving > 0).mean()))
        depth = np.where(moving, np.float32(0), self.image.depth)
        self._frame = replace(self._frame, read_depth=lambda: depth)
        for made in ("image", "cloud_and_note", "prepared"):
            self.__dict__.pop(made, None)
        self.corners = corners


def find_repeats(frames: Sequence[Frame]) -> Ints:
    """The rows of frames whose colour file and depth image are those of the frame before, in the same sequence: where
    a camera stalls they tell of no motion.
    """
    pairs = zip(frames[:-1], frames[1:], strict=True)
    return np.array([row for row, pair in enumerate(pairs, start=1) if _are_same(*pair)], np.int64)


def _are_same(one: Frame, other: Frame) -> bool:
    if one.sequence != other.sequence or not (one.image and other.image and one.read_depth and other.read_depth):
        return False
    try:  # files of two sizes, as nearly all are, are not read
        if not filecmp.cmp(one.image.path, other.image.path, shallow=False):
            return False
        depth = other.read_depth()
        in_the_dark = not depth.any()  # where all frames are alike
        return not in_the_dark and np.array_equal(one.read_depth(), depth, equal_nan=True)
    except (SourceError, OSError):
        return False

"""Matches of two RGB-D frames with no guess: SIFT features, placed in space by depth, that one motion explains."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import dataclass as plain_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.edges.sift_features import DESCRIPTOR_LENGTH, Features
from hodge_pipeline.edges.sift_matching import match
from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.consensus import rigid_consensus
from hodge_pipeline.registration.global_evidence import DepthView, depth_view
from hodge_pipeline.stages import Advance, Workers, no_progress
from hodge_pipeline.types import Bytes, Floats, Floats32, Frame, Ints, Match

FRAMES_IN_BLOCK = 8
ROOT_STEPS = 255


@plain_dataclass(frozen=True)
class ImageDescription:
    """Features with depth of one frame: `points_in_cam (N, 3)`, RootSIFT in steps of 1/255; its depth, made small."""

    points_in_cam: Floats
    root_sift: Bytes
    view: DepthView | None
    complaint: str = ""

    @property
    def descriptors(self) -> Floats32:
        """Unit descriptors (N, 128)."""
        return np.asarray(self.root_sift / np.float32(ROOT_STEPS), np.float32)

    def __len__(self) -> int:
        return len(self.points_in_cam)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SiftWithDepth:
    """A global registrar of images: 3-D to 3-D, so that scale is known and a plane is no special case."""

    ratio: float = Field(default=0.85, gt=0, le=1, description="a match is this much nearer than the second nearest")
    tolerance_m: float = Field(default=0.05, gt=0, description="metres between matched points; depth noise at 4 m")

    def match(self, target: ImageDescription, source: ImageDescription) -> Match:
        """Where the source's camera lies in the target's."""
        rows = match(target.descriptors, source.descriptors, self.ratio)
        found = rigid_consensus(target.points_in_cam[rows[:, 0]], source.points_in_cam[rows[:, 1]], self.tolerance_m)
        return Match(found.i_from_j, found.count, len(rows))

    def describe(self, cloud: Any) -> Any:
        """Frames are described by `describe_frames`: a cloud has no image."""
        raise NotImplementedError


def has_images(frame: Frame) -> bool:
    """Whether a frame has both colour and depth."""
    return frame.read_colour is not None and frame.read_depth is not None and frame.camera is not None


def describe_frames(
    frames: Sequence[Frame],
    max_features: int,
    max_range_m: float,
    out: Path,
    workers: Workers,
    advance: Advance = no_progress,
) -> tuple[str, ...]:
    """Describe every frame, each into a file of the folder `out`; gives a note for each that has no feature."""
    out.mkdir(parents=True, exist_ok=True)
    starts = range(0, len(frames), FRAMES_IN_BLOCK)
    blocks = [(start, tuple(frames[start : start + FRAMES_IN_BLOCK])) for start in starts]
    task = partial(_describe_block, max_features, max_range_m, out)
    notes: dict[int, list[str]] = {}
    for number, found in workers.map(task, blocks):
        notes[number] = found
        advance(len(blocks[number][1]))
    return tuple(note for number in sorted(notes) for note in notes[number] if note)


def _describe_block(
    max_features: int, max_range_m: float, out: Path, block: tuple[int, tuple[Frame, ...]]
) -> list[str]:
    start, frames = block
    notes = []
    for row, frame in enumerate(frames, start):
        described = describe_frame(frame, max_features, max_range_m)
        notes.append(described.complaint)
        with (out / f"{row}.pickle").open("wb") as file:
            pickle.dump(described, file, protocol=5)
    return notes


def describe_frame(frame: Frame, max_features: int, max_range_m: float) -> ImageDescription:
    """The features of one frame that have depth up to `max_range_m`; none, and why, where it cannot be read."""
    nothing = np.zeros((0, 3)), np.zeros((0, DESCRIPTOR_LENGTH), np.uint8)
    if frame.read_depth is None or frame.camera is None:
        return ImageDescription(
            *nothing, None, f"frame {frame.frame_id}: has no depth image: it is not matched by image"
        )
    try:
        depth = frame.read_depth()
    except (SourceError, OSError) as error:
        return ImageDescription(*nothing, None, f"frame {frame.frame_id}: not matched by image: {error}")
    view = depth_view(depth, frame.camera)
    features = Features([frame], np.zeros(1, np.int64), max_features)
    try:
        if features.complaints:
            return ImageDescription(*nothing, view, features.complaints[0])
        slopes, descriptors = features.points(0).astype(float), features.descriptors(0)
    finally:
        features.close()
    z = depth_at(slopes, depth, frame)
    kept = (z > 0) & (z <= max_range_m)
    points = np.column_stack([slopes[kept] * z[kept, None], z[kept]])
    rounded = np.rint(descriptors[kept] * ROOT_STEPS).astype(np.uint8)
    return ImageDescription(points, rounded, view)


def depth_at(slopes: Floats, depth: Floats32, frame: Frame) -> Floats:
    """Depth (N,) in metres along the rays with these slopes (N, 2), of the nearest pixel; 0 for none."""
    assert frame.camera is not None
    camera = frame.camera
    column = np.rint(slopes[:, 0] * camera.fx + camera.cx).astype(np.int64)
    row = np.rint(slopes[:, 1] * camera.fy + camera.cy).astype(np.int64)
    return depth[_clipped(row, depth.shape[0]), _clipped(column, depth.shape[1])].astype(float)


def _clipped(values: Ints, size: int) -> Ints:
    return np.clip(values, 0, size - 1)

"""Shared by all fusers: the choice of frames, and notes on frames left out or fused without colour."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import HodgeError
from hodge_pipeline.types import Bytes, Floats, Frame
from hodge_pipeline.types.text import counted


class Skipped:
    """A tally of the frames left out, or fused without colour: how many for each reason, and the first of them."""

    def __init__(self) -> None:
        self._frames: dict[str, dict[int, str]] = {}

    def add(self, reason: str, frame: Frame, detail: str = "", fate: str = "skipped") -> None:
        """Count one frame, once however often it is looked at."""
        named = f"{frame.frame_id}: {detail}" if detail else f"{frame.frame_id}"
        self._frames.setdefault(f"{fate}: {reason}", {})[id(frame)] = named

    @contextmanager
    def unreadable(self, frame: Frame) -> Iterator[None]:
        """Counts the frame where its files cannot be read, and goes on; any other error is raised."""
        try:
            yield
        except (HodgeError, OSError) as error:
            self.add("cannot be read", frame, str(error))

    def colour(self, frame: Frame) -> Bytes | None:
        """The frame's colour image (h, w, 3); None where it has none, or none that can be read, which is counted."""
        try:
            return frame.read_colour() if frame.read_colour else None
        except (HodgeError, OSError) as error:
            self.add("its image cannot be read", frame, str(error), fate="fused without colour")
            return None

    def notes(self) -> tuple[str, ...]:
        """One line for each reason."""
        return tuple(
            f"{counted(len(names), 'frame')} {why} (the first: {next(iter(names.values()))})"
            for why, names in self._frames.items()
        )


def posed(
    frames: Sequence[Frame], world_from_cam: Floats, every: int, skipped: Skipped, min_motion_m: float = 0.0
) -> list[tuple[Frame, Floats]]:
    """Each `every`-th frame with its pose (4, 4), without those that moved less than `min_motion_m` since the last one.

    A turn counts as what it moves a point at one metre. A frame whose pose is not finite is counted in `skipped`.
    """
    taken: list[tuple[Frame, Floats]] = []
    for frame, pose in zip(frames[::every], world_from_cam[::every], strict=True):
        if not np.isfinite(pose).all():
            skipped.add("its pose is unknown", frame)
        elif (
            not taken
            or min_motion_m == 0
            or se3.displacement_m(se3.inverse(taken[-1][1]) @ pose, se3.ARM_M) >= min_motion_m
        ):
            taken.append((frame, pose))
    return taken

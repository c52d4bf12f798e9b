"""Small depth images of all frames on disk, for free-space tests."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.global_evidence import DepthView, depth_view
from hodge_pipeline.stages import Workers
from hodge_pipeline.types import Frame

FRAMES_IN_BLOCK = 16
VIEWS_KEPT = 1024
"""Views in memory, 77 kB each."""


class Views:
    """The depth views of frames by their rows; None where a frame has no depth image."""

    def __init__(self, frames: Sequence[Frame], folder: Path) -> None:
        self._frames, self._folder = frames, folder
        self._load = lru_cache(maxsize=VIEWS_KEPT)(self._read)

    @classmethod
    def make(cls, frames: Sequence[Frame], folder: Path, workers: Workers) -> Views:
        """Read every depth image once; `folder` takes the views."""
        folder.mkdir(parents=True, exist_ok=True)
        starts = range(0, len(frames), FRAMES_IN_BLOCK)
        blocks = [(start, tuple(frames[start : start + FRAMES_IN_BLOCK])) for start in starts]
        for _ in workers.map(partial(_write_block, folder), blocks):
            pass
        return cls(frames, folder)

    def __call__(self, row: int) -> DepthView | None:
        """The view of a frame."""
        return self._load(row)

    def _read(self, row: int) -> DepthView | None:
        path, camera = self._folder / f"{row}.npz", self._frames[row].camera
        if camera is None or not path.exists():
            return None
        with np.load(path) as stored:
            return DepthView(stored["nearest_m"], int(stored["stride"]), camera)


def _write_block(folder: Path, block: tuple[int, tuple[Frame, ...]]) -> int:
    start, frames = block
    for row, frame in enumerate(frames, start):
        if frame.read_depth is None or frame.camera is None:
            continue
        try:
            view = depth_view(frame.read_depth(), frame.camera)
        except (SourceError, OSError):  # said where the clouds are made
            continue
        np.savez(folder / f"{row}.npz", nearest_m=view.nearest_m, stride=view.stride)
    return len(frames)

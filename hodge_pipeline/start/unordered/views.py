"""Free-space views on disk: the small depth image of every frame, or the panorama of a scan."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.global_evidence import DepthView, depth_view, panorama
from hodge_pipeline.registration.global_features import viewpoint
from hodge_pipeline.stages import Workers
from hodge_pipeline.types import CloudSet, Frame, Ints

FRAMES_IN_BLOCK = 16
VIEWS_KEPT = 1024
"""Views in memory, 77 kB each."""


class Views:
    """The depth views of frames by their rows; None where a frame has no depth image, nor a cloud with all that its
    origin sees.
    """

    def __init__(self, frames: Sequence[Frame], clouds: CloudSet, folder: Path) -> None:
        self._frames, self._clouds, self._folder = frames, clouds, folder
        self._load = lru_cache(maxsize=VIEWS_KEPT)(self._read)

    @classmethod
    def make(cls, frames: Sequence[Frame], clouds: CloudSet, rows: Ints, folder: Path, workers: Workers) -> Views:
        """Read the depth images of these rows once; `folder` takes the views, `clouds` are those of the frames."""
        folder.mkdir(parents=True, exist_ok=True)
        starts = range(0, len(rows), FRAMES_IN_BLOCK)
        blocks = [[(row, frames[row]) for row in rows[start : start + FRAMES_IN_BLOCK].tolist()] for start in starts]
        for _ in workers.map(partial(_write_block, folder), blocks):
            pass
        return cls(frames, clouds, folder)

    def __call__(self, row: int) -> DepthView | None:
        """The view of a frame."""
        return self._load(row)

    def _read(self, row: int) -> DepthView | None:
        path, camera = self._folder / f"{row}.npz", self._frames[row].camera
        if camera is None:
            points = np.asarray(self._clouds[row].points_in_cam, float)
            return panorama(points) if len(points) and not viewpoint(points).any() else None
        if not path.exists():
            return None
        with np.load(path) as stored:
            return DepthView(stored["nearest_m"], int(stored["stride"]), camera)


def _write_block(folder: Path, block: Sequence[tuple[int, Frame]]) -> int:
    for row, frame in block:
        if frame.read_depth is None or frame.camera is None:
            continue
        try:
            view = depth_view(frame.read_depth(), frame.camera)
        except (SourceError, OSError):  # reported where the clouds are made
            continue
        np.savez(folder / f"{row}.npz", nearest_m=view.nearest_m, stride=view.stride)
    return len(block)

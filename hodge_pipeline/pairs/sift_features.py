"""SIFT features of every frame, kept on disk so that memory does not grow with the sequence."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.errors import SourceError
from hodge_pipeline.registration.descriptors import root_sift
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Bytes, Floats32, Frame, Ints

DESCRIPTOR_LENGTH = 128
MatOfBytes: TypeAlias = NDArray[np.uint8]


class Features:
    """The features of the frames `rows`: `points` (n, 2) and RootSIFT `descriptors` (n, 128) of one frame at a time.

    The descriptors are bytes, as SIFT makes them, in a temporary file that the system pages; 128 kB for a frame of
    1000 features. `complaints` say which images could not be read, one line each.
    """

    def __init__(self, frames: Sequence[Frame], rows: Ints, max_features: int) -> None:
        self._file = tempfile.TemporaryFile(prefix="hodge-sift-")  # noqa: SIM115 - lives as long as the features
        size = max(1, len(rows)) * max_features * DESCRIPTOR_LENGTH
        artifacts.reserve(self._file, size)
        column = np.memmap(self._file, np.uint8, "w+", shape=(size,))
        self._bytes: Bytes = column.reshape(-1, max_features, DESCRIPTOR_LENGTH)
        self._place = {int(row): place for place, row in enumerate(rows)}
        self._points: list[Floats32] = []
        self.complaints: list[str] = []
        detector = cv2.SIFT_create(nfeatures=max_features)  # type: ignore[attr-defined]
        for place, row in enumerate(rows):
            points, descriptors = self._detect(detector, frames[int(row)])
            points, descriptors = points[:max_features], descriptors[:max_features]  # equal responses can exceed it
            self._points.append(points)
            self._bytes[place, : len(points)] = descriptors

    def _detect(self, detector: cv2.SIFT, frame: Frame) -> tuple[Floats32, Bytes]:
        nothing = np.zeros((0, 2), np.float32), np.zeros((0, DESCRIPTOR_LENGTH), np.uint8)
        if frame.read_colour is None:
            self.complaints.append(f"frame {frame.frame_id}: has no colour image: no SIFT edges")
            return nothing
        try:
            image = frame.read_colour()
        except (SourceError, OSError) as error:
            self.complaints.append(f"frame {frame.frame_id}: no SIFT edges: {error}")
            return nothing
        found, descriptors = detector.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        if not found:
            self.complaints.append(f"frame {frame.frame_id}: no SIFT feature in its image: no SIFT edges")
            return nothing
        points = np.array([point.pt for point in found], np.float32)
        return rays(points, image.shape, frame), np.asarray(descriptors).astype(np.uint8)

    def count(self, row: int) -> int:
        """How many features a frame has."""
        return len(self._points[self._place[row]])

    def points(self, row: int) -> Floats32:
        """Where they are (n, 2): see `rays`."""
        return self._points[self._place[row]]

    def descriptors(self, row: int) -> Floats32:
        """Unit RootSIFT descriptors (n, 128) (Arandjelović and Zisserman 2012)."""
        return root_sift(self._bytes[self._place[row], : self.count(row)])

    def close(self) -> None:
        """Give the disk space back."""
        del self._bytes
        self._file.close()


def rays(points_px: Floats32, shape: tuple[int, ...], frame: Frame) -> Floats32:
    """The points (n, 2) as slopes x/z, y/z of their rays, where the frame has a camera; else pixels as they are.

    The camera is that of the depth image; a colour image of another size is taken to show the same view.
    """
    camera = frame.camera
    if camera is None:
        return points_px
    scale = np.array([camera.width / shape[1], camera.height / shape[0]])
    return np.asarray((points_px * scale - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.float32)

"""Pairs of frames whose images show the same: SIFT matches that one relative pose explains (paper, Section 4)."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import SourceError
from hodge_pipeline.pairs.candidates import usable_rows
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.pairs.sift_matching import count_inliers
from hodge_pipeline.pairs.sift_similarity import global_descriptors, most_similar, vocabulary
from hodge_pipeline.registration.descriptors import match, root_sift
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Bytes, CloudSet, Edges, Floats, Floats32, Frame, Ints
from hodge_pipeline.types.text import counted

log = logging.getLogger("hodge_pipeline")

DESCRIPTOR_LENGTH = 128
MatOfBytes: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SiftEdges:
    """Pairs the frames with more than `min_inliers` matches that agree with one relative pose.

    Pairs are proposed before anything is matched: the neighbours in the sequence, and the frames whose global
    descriptors (VLAD over the sequence's own features) are the most similar. Poses play no part, so every outer
    iteration gets the same pairs, and they are found once.
    """

    min_inliers: int = Field(
        50,
        ge=8,
        description="a pair has more verified matches than this; 50 is the paper's, which does not say if it verifies",
    )
    reach: int = Field(5, ge=1, description="frames: neighbours up to this far in the sequence are always matched")
    similar_per_frame: int = Field(
        10,
        ge=0,
        description="the most similar frames beyond the reach that are matched too, at most one of every `reach` "
        "consecutive ones; about 5 ms a pair",
    )
    max_features: int = Field(1000, ge=50, description="features of a frame, the strongest; about 60 ms a frame")
    words: int = Field(32, ge=1, description="words of the global descriptor's vocabulary; 16 kB a frame")
    ratio: float = Field(
        0.8, gt=0, le=1, description="a match is this much nearer than the second nearest (Lowe 2004: 0.8)"
    )
    seed: int = Field(0, ge=0, description="of the vocabulary's sample; the same seed gives the same pairs")

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Verified pairs; `overlap` is the share of the poorer frame's features that are inliers.

        None for frames without points, or whose image is missing or cannot be read, which the log lists. Raises
        `SourceError` where not a single image can be used.
        """
        rows = usable_rows(clouds)
        if len(rows) < 2:
            return Edges.proposed(np.zeros((0, 2), np.int64), "sift")
        neighbours = SequentialEdges(reach=self.reach).propose(frames, clouds, world_from_cam).pairs
        return _verified(self, _Same(frames, rows, neighbours))


class _Same:
    """Frames by identity: the same objects with the same usable rows are the same work."""

    def __init__(self, frames: Sequence[Frame], rows: Ints, neighbours: Ints) -> None:
        self.frames, self.rows, self.neighbours = tuple(frames), rows, neighbours

    def __hash__(self) -> int:
        return hash((len(self.frames), self.rows.tobytes()))

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, _Same)
            and len(self.frames) == len(other.frames)
            and all(a is b for a, b in zip(self.frames, other.frames, strict=True))
            and np.array_equal(self.rows, other.rows)
        )


@lru_cache(maxsize=1)  # the next outer iteration asks again
def _verified(options: SiftEdges, same: _Same) -> Edges:
    features = Features(same.frames, same.rows, options.max_features)
    try:
        return _matched(options, same, features)
    finally:
        features.close()


def _matched(options: SiftEdges, same: _Same, features: Features) -> Edges:
    for complaint in features.complaints:
        log.warning("%s", complaint)
    rows = np.array([row for row in same.rows.tolist() if features.count(row)], np.int64)
    if not len(rows):
        raise SourceError(
            f"no image of the {counted(len(same.rows), 'frame')} gave a SIFT feature ({features.complaints[0]}): "
            "use edges that need no images, such as centroid or overlap"
        )
    proposed = _proposed(options, same, features, rows)
    kept, shares, matched_i = [np.zeros((0, 2), np.int64)], [], -1
    for i, j in proposed.tolist():
        if i != matched_i:
            matched_i, descriptors_i = i, features.descriptors(i)
        matches = match(descriptors_i, features.descriptors(j), options.ratio)
        inliers = 0
        if len(matches) > options.min_inliers:
            points_i, points_j = features.points(i)[matches[:, 0]], features.points(j)[matches[:, 1]]
            cameras = same.frames[i].camera, same.frames[j].camera
            inliers = count_inliers(points_i, points_j, cameras)
        accepted = inliers > options.min_inliers
        name_i, name_j = same.frames[i].frame_id, same.frames[j].frame_id
        log.log(
            logging.INFO if accepted else logging.DEBUG,
            "sift: frames %s and %s: %d matches, %d verified", name_i, name_j, len(matches), inliers,
        )  # fmt: skip
        if accepted:
            kept.append(np.array([[i, j]]))
            shares.append(inliers / min(features.count(i), features.count(j)))
    log.info("sift: %d of %d proposed pairs have more than %d matches", len(shares), len(proposed), options.min_inliers)
    return Edges.proposed(np.concatenate(kept), "sift", np.array(shares))


def _proposed(options: SiftEdges, same: _Same, features: Features, rows: Ints) -> Ints:
    """Pairs (P, 2) to match, i < j, by i."""
    near = same.neighbours[np.isin(same.neighbours, rows).all(axis=1)]
    centres = vocabulary(features, rows, options.words, options.seed)
    similar = most_similar(global_descriptors(features, rows, centres), options.similar_per_frame, options.reach)
    return np.unique(np.concatenate([near, np.sort(rows[similar], axis=1)]), axis=0)


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

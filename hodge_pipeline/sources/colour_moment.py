"""Whether colour is of another moment than depth, by the edges that both show while the camera moves."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.depth_units import SAMPLED_FRAMES
from hodge_pipeline.types import Floats, Frame
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.image_edges import FEWEST_EDGES, change_along_rows, depth_edges
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted

MOST_LATE = 3
"""Frames before and after, whose colour is compared too."""
WIDTH_PX = 320
"""Edges are compared in images of about this width, in which frames some milliseconds apart agree as well."""
FEWEST_FRAMES, SURE, BETTER = 5, 2.5, 1.25
"""As of colour beside depth. Of seven recordings, colour shifted by two frames has 1.4 to 10 times the agreement at the
right frame, at 4 to 12 standard errors; whole frames of fr1 are .6 of a step late, and so count as of one moment."""


def late_doubts(frames: Sequence[Frame]) -> tuple[Note, ...]:
    """A note where colour of frames more than a step away surely agrees better with depth than that of any nearer one;
    none of too few frames, or where the camera hardly moves.
    """
    inner = range(MOST_LATE, len(frames) - MOST_LATE)
    each = [
        _agreements(frames[inner[row] - MOST_LATE : inner[row] + MOST_LATE + 1])
        for row in evenly(len(inner), SAMPLED_FRAMES)
    ]
    found = np.array([agreements for agreements in each if agreements is not None])
    if len(found) < FEWEST_FRAMES:
        return ()
    steps = np.arange(-MOST_LATE, MOST_LATE + 1) + _usual_delay(frames)
    is_near, mean = abs(steps) <= 1, found.mean(axis=0)
    if is_near.all() or not is_near.any():
        return ()
    best = int(mean.argmax())
    gains = found[:, best] - found[:, is_near].max(axis=1)
    is_sure = gains.mean() > SURE * gains.std() / np.sqrt(len(gains))
    if is_near[best] or not is_sure or mean[best] < BETTER * mean[is_near].max():
        return ()
    late = best - MOST_LATE
    told = f"{counted(abs(late), 'frame')} {'later' if late > 0 else 'earlier'}"
    return (Note("colour of another moment", detail=told),)


def _agreements(frames: Sequence[Frame]) -> Floats | None:
    """How much the colour of each frame (M,) changes at the depth edges of the middle one, in standard deviations; None
    where one cannot be read, or is of another sequence or size, or there are too few edges.
    """
    middle, found = frames[len(frames) // 2], list[float]()
    if middle.read_depth is None or any(frame.sequence != middle.sequence for frame in frames):
        return None
    try:
        depth_m = middle.read_depth()
        rows, columns, _ = depth_edges(depth_m)
        for frame in frames:
            colour = None if frame.read_colour is None else frame.read_colour()
            if colour is None or colour.shape[:2] != depth_m.shape or len(rows) < FEWEST_EDGES:
                return None
            shrink = max(depth_m.shape[1] // WIDTH_PX, 1)
            size = depth_m.shape[1] // shrink, depth_m.shape[0] // shrink
            change = cv2.resize(np.sqrt(change_along_rows(colour)), size, interpolation=cv2.INTER_AREA)
            places = np.minimum(rows // shrink, size[1] - 1), np.minimum(columns // shrink, size[0] - 1)
            if not change.std() > 0:
                return None
            found.append(float((change[places].mean() - change.mean()) / change.std()))
    except (SourceError, OSError):
        return None
    return np.array(found)


def _usual_delay(frames: Sequence[Frame]) -> float:
    """By how many steps the stamps of colour are later than those of depth, in the median."""
    step_s = float(np.median(np.diff([frame.stamp_s for frame in frames])))
    delay_s = float(np.median([frame.colour_delay_s for frame in frames]))
    return delay_s / step_s if step_s > 0 and np.isfinite(delay_s) else 0.0

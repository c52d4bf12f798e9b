"""Whether colour is of another moment than depth, by the edges that both show while the camera moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.depth_units import SAMPLED_FRAMES
from hodge_pipeline.types import Bools, Floats, Frame
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
right frame, at 4 to 12 standard errors; whole frames of fr1 are .6 of a step late, and so count as of one moment.
The step by which pairs are made anew is sure by the same measure: of twelve recordings shifted by -5 to 5 frames all
those taken for sure (57) are right to within the frame that they are late by themselves."""


def late_doubts(frames: Sequence[Frame]) -> tuple[Note, ...]:
    """A note where colour of frames more than a step away surely agrees better with depth than that of any nearer one;
    none of too few frames, or where the camera hardly moves. The count of "colour paired anew" is by how many frames
    colour is to be taken later, negative: earlier.
    """
    found = _sampled(frames, MOST_LATE)
    if not len(found):
        return ()
    steps = np.arange(-MOST_LATE, MOST_LATE + 1) + _usual_delay(frames)
    is_near, best = abs(steps) <= 1, int(found.mean(axis=0).argmax())
    if is_near.all() or not is_near.any() or is_near[best] or not _is_surely_better(found, best, is_near):
        return ()
    late = _sure_step(_sampled(frames, 2 * MOST_LATE))
    if not late:
        return (Note("colour of another moment", detail=_told(best - MOST_LATE)),)
    return (Note("colour paired anew", late, _told(late)),)


def paired_anew(frames: Sequence[Frame], late: int) -> list[Frame]:
    """The frames, each with the colour of the one so many frames later in its sequence; without colour where there is
    none. What the stamps of colour say is taken from their usual delay, which is not that of the new pairs.
    """
    usual_s = float(np.median([frame.colour_delay_s for frame in frames]))
    paired = list[Frame]()
    for row, frame in enumerate(frames):
        other = frames[row + late] if 0 <= row + late < len(frames) else None
        if other is None or other.sequence != frame.sequence:
            paired.append(replace(frame, read_colour=None, encoded_colour=None, image=None))
            continue
        images = {name: getattr(other, name) for name in ("read_colour", "encoded_colour", "image")}
        paired.append(replace(frame, **images, colour_delay_s=other.colour_delay_s - usual_s))
    return paired


def _sure_step(found: Floats) -> int | None:
    """By how many frames later colour agrees best; None at an end of the steps tried, or where a step that is no
    neighbour of the best one may be as good.
    """
    if not len(found):
        return None
    best, last = int(found.mean(axis=0).argmax()), found.shape[1] - 1
    is_away = np.abs(np.arange(last + 1) - best) > 1
    return best - last // 2 if 0 < best < last and _is_surely_better(found, best, is_away) else None


def _told(late: int) -> str:
    return f"{counted(abs(late), 'frame')} {'later' if late > 0 else 'earlier'}"


def _is_surely_better(found: Floats, best: int, others: Bools) -> bool:
    """Whether agreements (F, M) at the best step exceed those at any of the others by far more than their scatter."""
    gains, mean = found[:, best] - found[:, others].max(axis=1), found.mean(axis=0)
    is_sure = gains.mean() > SURE * gains.std() / np.sqrt(len(gains))
    return bool(is_sure and mean[best] >= BETTER * mean[others].max())


def _sampled(frames: Sequence[Frame], most: int) -> Floats:
    """Agreements (F, 2 most + 1) of frames that are evenly spread with colour of so many frames before and after; none
    of too few frames.
    """
    inner = range(most, len(frames) - most)
    each = [
        _agreements(frames[inner[row] - most : inner[row] + most + 1]) for row in evenly(len(inner), SAMPLED_FRAMES)
    ]
    found = np.array([agreements for agreements in each if agreements is not None])
    return found if len(found) >= FEWEST_FRAMES else found[:0]


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

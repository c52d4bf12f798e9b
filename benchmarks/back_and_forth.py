"""A sequence as long as one likes: the frames of a short one played forwards, backwards, forwards, …"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.types import Frame, Source


def first_frames(source: Source, count: int) -> Source:
    """The first `count` frames; a source that has fewer is played back and forth until there are so many.

    Played backwards, a shutter rolls from the last row to the first one and colour runs ahead of depth, or behind.
    """
    if count <= len(source.frames):
        return replace(source, frames=source.frames[:count])
    frames, first = source.frames, source.frames[0].stamp_s
    usual_s = float(np.median(np.diff([frame.stamp_s for frame in frames])))
    turn = len(frames) - 1
    played: list[Frame] = []
    for number in range(count):
        lap, place = divmod(number, turn)
        backwards = bool(lap % 2)
        frame = frames[turn - place if backwards else place]
        if backwards and frame.camera is not None:
            camera = replace(frame.camera, readout_s=-frame.camera.readout_s)
            frame = replace(frame, camera=camera, colour_delay_s=-frame.colour_delay_s)
        played.append(replace(frame, frame_id=number, stamp_s=first + number * usual_s))
    return replace(source, frames=tuple(played), trajectory=None)

"""Whether depth and colour lie on each other, by the edges that both show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.colour_moment import late_doubts, paired_anew
from hodge_pipeline.sources.depth_units import SAMPLED_FRAMES, doubts_of
from hodge_pipeline.types import Bytes, Camera, Floats, Floats32, Frame, Source
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.image_edges import FEWEST_EDGES, change_along_rows, depth_edges
from hodge_pipeline.types.notes import Note

FEWEST_FRAMES = 5
"""Frames that are needed: the error of a mean of fewer is hardly known."""
STRONG = 0.98
"""Quantile of the colour's change from which on edges count alike, so that no window or screen decides alone."""
CELLS, FARTHEST, NEAR = 160, 10, 2
"""Cells across the image, in which edges are compared; cells that depth is shifted by at most, and those that a
calibrated camera's may be off, 8 pixels of 640."""
SCALES = np.exp(0.05 * np.arange(-3, 11))
"""About the middle of the image: a Kinect's depth camera sees 0.90 of what its colour camera does, that of a RealSense
D435 1.6 times as much."""
NEAR_SCALES = slice(2, 5)
"""Within 5 %, which a calibrated camera's scale may be off."""
SURE = 2.5
"""Standard errors of the mean over the frames, each measured at the best place of the other ones."""
BETTER = 1.25
"""Agreement at the best place over that near the own one. Of 170 single frames of fr1, fr3, red kitchen, stairs and
ICL-NUIM, each as good as a camera at rest, none reaches 1.20; red kitchen's colour as the camera took it has 1.5."""


@dataclass(frozen=True)
class Agreement:
    """The mean change of colour, in standard deviations, at depth edges (scale, cells down, cells to the right)."""

    values: Floats
    cell_px: int


def image_doubts(frames: Sequence[Frame]) -> tuple[Note, ...]:
    """Notes on depth that seems not to be in metres, or not to lie on colour, by a few frames, evenly spread.

    An image that cannot be read is left to whoever reads it next. Colour of another moment lies beside depth too, of a
    camera that moves steadily: it is the moment where pairs made anew leave no doubt.
    """
    with_depth = [frame for frame in frames if frame.read_depth is not None]
    values, found = _sampled(with_depth)
    width_px = max((depth_m.shape[1] for depth_m in values), default=0)
    units = doubts_of(np.concatenate([depth_m.ravel() for depth_m in values]), width_px) if values else ()
    camera = with_depth[0].camera if with_depth else None
    beside, late = colour_doubts(found, camera), late_doubts(with_depth)
    if beside and late and late[0].kind == "colour paired anew":
        beside = colour_doubts(_sampled(paired_anew(with_depth, late[0].count))[1])
    return (*units, *(beside or late))


def _sampled(frames: Sequence[Frame]) -> tuple[list[Floats32], list[Agreement]]:
    """Depth of a few frames, evenly spread, and how their colour agrees with it."""
    values, found = list[Floats32](), list[Agreement]()
    for row in evenly(len(frames), SAMPLED_FRAMES):
        try:
            read_depth, read_colour = frames[row].read_depth, frames[row].read_colour
            assert read_depth is not None
            values.append(read_depth())
            found += agreement(values[-1], read_colour()) if read_colour is not None else []
        except (SourceError, OSError):
            continue
    return values, found


def usable_colour(source: Source, doubts: Sequence[Note]) -> Source:
    """The source, its colour paired anew where it is surely of another moment than depth; without colour where that is
    doubted to lie on depth or to be of its moment.

    Landmarks then have the depth of other things, and place frames worse than surfaces alone. The images are still
    shown as they are stored.
    """
    told = {doubt.kind: doubt.count for doubt in doubts}
    if "colour paired anew" in told:
        return replace(source, frames=paired_anew(source.frames, told["colour paired anew"]))
    if not told.keys() & {"colour beside depth", "colour of another moment"}:
        return source
    return replace(source, frames=[replace(frame, read_colour=None) for frame in source.frames])


def colour_doubts(found: Sequence[Agreement], camera: Camera | None = None) -> tuple[Note, ...]:
    """A note where edges of colour surely agree better with depth scaled or shifted; none of too few frames. It says of
    which `camera` depth is taken to be.
    """
    if len(found) < FEWEST_FRAMES:
        return ()
    every = np.array([each.values for each in found])
    near = every[:, NEAR_SCALES, *[slice(FARTHEST - NEAR, FARTHEST + NEAR + 1)] * 2].reshape(len(every), -1)
    mean, every = every.mean(axis=0), every.reshape(len(every), -1)
    gains = np.array([_at_best(every, row) - _at_best(near, row) for row in range(len(every))])
    is_sure = gains.mean() > SURE * gains.std() / np.sqrt(len(gains))
    if not is_sure or mean.max() < BETTER * near.mean(axis=0).max():
        return ()
    scale, down, right = np.unravel_index(int(mean.argmax()), mean.shape)
    shift_px = [(at - FARTHEST) * found[0].cell_px for at in (right, down)]
    told = f"scaled by {SCALES[scale]:.2f} and shifted by {shift_px[0]} and {shift_px[1]} pixels"
    if camera is not None:
        told += f" than as it is, of a camera of focal length {camera.fx:.4g} pixels (source.reader.camera)"
    return (Note("colour beside depth", detail=told),)


def _at_best(agreement: Floats, row: int) -> float:
    """What a row of agreements (F, P) has at the place that is best for the other rows."""
    return float(agreement[row, (agreement.sum(axis=0) - agreement[row]).argmax()])


def agreement(depth_m: Floats32, colour: Bytes) -> list[Agreement]:
    """That of one frame; none of too few depth edges, or of colour of one shade or another size."""
    height, width = depth_m.shape
    rows, columns, _ = depth_edges(depth_m)
    if colour.shape[:2] != depth_m.shape or len(rows) < FEWEST_EDGES:
        return []
    cell = max(width // CELLS, 1)
    size = height // cell, width // cell
    change = _change(colour, size)
    if not change.any():
        return []
    padded = size[0] + FARTHEST, size[1] + FARTHEST  # no shift leads round to the other side
    of_colour, out = np.fft.rfft2(change, padded), np.zeros((len(SCALES), 2 * FARTHEST + 1, 2 * FARTHEST + 1))
    middle = np.array([height / 2, width / 2])
    for number, scale in enumerate(SCALES):
        places = ((np.stack([rows, columns + 0.5], axis=1) - middle) * scale + middle) / cell
        inside = ((places >= 0) & (places < size)).all(axis=1)
        cells = places[inside].astype(np.int64)
        edges = np.bincount(cells @ [padded[1], 1], minlength=padded[0] * padded[1]).reshape(padded)
        shifted = np.fft.irfft2(of_colour * np.conj(np.fft.rfft2(edges)), padded)
        shifted = np.roll(shifted, (FARTHEST, FARTHEST), (0, 1))[: 2 * FARTHEST + 1, : 2 * FARTHEST + 1]
        out[number] = shifted / max(int(inside.sum()), 1)
    return [Agreement(out, cell)]


def _change(colour: Bytes, size: tuple[int, int]) -> Floats:
    """The change of colour along rows in cells (rows, columns), of mean 0 and standard deviation 1; 0 without any."""
    change = change_along_rows(colour)
    change = np.sqrt(np.minimum(change, np.quantile(change, STRONG)))
    cells = np.asarray(cv2.resize(change, size[::-1], interpolation=cv2.INTER_AREA), float)
    cells -= cells.mean()
    return cells / cells.std() if cells.std() > 0 else cells

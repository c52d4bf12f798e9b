"""Log images, cameras and clouds of the frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import TypeAlias

import numpy as np
import rerun as rr

from hodge_pipeline.errors import SourceError
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.shapes import or_grey
from hodge_pipeline.recording.stream import Part, frame_columns, log_markdown
from hodge_pipeline.types import Camera, CloudSet, EncodedImage, Floats, Frame, Ints
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.text import counted

CHUNK_BYTES = 4_000_000
"""Images go in chunks of this size: few enough to be quick, small enough for a viewer to fetch one."""
IMAGE_PLANE_M = 0.25
POINT_BYTES = 16
MOST_POINTS = 300_000
"""Of all frames' clouds together; more says little beside the fused model."""
SIZED_FRAMES, MARGIN = 16, 1.1
"""Frames whose images are read to estimate the size of all, and the safety factor on their mean: of red kitchen's
frames the largest is 1.2 times the mean, and the mean of 16 is known to 3 %."""
Reader: TypeAlias = Callable[[], EncodedImage] | None
"""Reads an encoded image, where a frame has one."""


def log_frames(part: Part, name: str, frames: Sequence[Frame], notes: Sequence[str]) -> None:
    """Log encoded images, cameras and names of the frames; `notes` are the reader's."""
    frames = _sized_once(frames)
    stream, (rows, thinned) = part.stream, image_rows(frames, part.options)
    log_markdown(
        stream, layout.SOURCE, "\n".join([f"# {name}", counted(len(frames), "frame"), *(f"- {n}" for n in notes)])
    )
    if thinned:
        part.note(thinned)
    _log_names(stream, frames)
    _log_cameras(stream, frames)
    kept = 0
    colours, depths = ([getattr(frames[row], name) for row in rows] for name in ("encoded_colour", "encoded_depth"))
    for path, readers in ((layout.COLOUR, colours), (layout.DEPTH, depths)):
        for chunk_rows, images in _chunks(rows, readers):
            _log_images(stream, path, frame_columns(frames, len(frames), chunk_rows), images)
            kept += len(images)
    wished = sum(read is not None for read in (*colours, *depths))
    if kept < wished:
        part.note(f"{counted(wished - kept, 'image')} cannot be read and are not shown", level="WARN")


def image_rows(frames: Sequence[Frame], options: RecordingOptions) -> tuple[Ints, str]:
    """The frames whose images are kept, evenly spaced and within the size, and what that left out, in words."""
    if not options.has_images:
        return np.zeros(0, np.int64), ""
    sizes, every = _sizes(frames), 1
    while every <= len(frames) and sizes[::every].sum() > options.max_bytes("images"):
        every += 1
    rows = np.arange(0, len(frames), every) if every <= len(frames) else np.arange(0)
    told = f"images of {len(rows)} of {len(frames)} frames, to stay under {options.max_megabytes:g} MB"
    return rows, f"{told} (recording.max_megabytes)" if every > 1 else ""


def _sized_once(frames: Sequence[Frame]) -> list[Frame]:
    """The frames; those that `_sizes` reads keep their encoded images, so that these are encoded only once."""
    kept = list(frames)
    for row in evenly(len(frames), SIZED_FRAMES):
        depth, colour = kept[row].encoded_depth, kept[row].encoded_colour
        kept[row] = replace(
            kept[row], encoded_depth=depth and cache(depth), encoded_colour=colour and cache(colour)
        )  # fmt: skip
    return kept


def _sizes(frames: Sequence[Frame]) -> Floats:
    """Bytes (N,) of the frames' images; of many frames the mean of a few, with a margin, since an undistorted image is
    encoded again each time.
    """
    some = []
    for row in evenly(len(frames), SIZED_FRAMES):
        images = map(_encoded, (frames[row].encoded_colour, frames[row].encoded_depth))
        some.append(sum(len(image.contents) for image in images if image is not None))
    if len(some) == len(frames):
        return np.array(some, float)
    return np.full(len(frames), MARGIN * np.mean(some))


def log_clouds(part: Part, frames: Sequence[Frame], clouds: CloudSet) -> None:
    """Log each frame's cloud in its camera's axes."""
    stream, total = part.stream, int(clouds.offsets[-1])
    kept = part.options.count(MOST_POINTS, total, POINT_BYTES, part.options.max_bytes("clouds"))
    if not part.options.has_images or not total or not kept:
        return
    sizes = np.diff(clouds.offsets)
    parts = [
        start + evenly(int(size), int(np.floor(size * kept / total)))
        for start, size in zip(clouds.offsets, sizes, strict=False)
    ]
    picked = np.concatenate(parts)
    stream.send_columns(
        layout.CLOUD,
        indexes=frame_columns(frames, len(clouds), np.arange(len(clouds))),
        columns=rr.Points3D.columns(
            positions=np.asarray(clouds.points[picked]), colors=or_grey(np.asarray(clouds.colours[picked]), len(picked))
        ).partition([len(part) for part in parts]),
    )
    clouds.forget()
    _log_counts(stream, frames, sizes)
    if len(picked) < total:
        part.note(f"{len(picked)} of {total} cloud points")


def _log_counts(stream: rr.RecordingStream, frames: Sequence[Frame], sizes: Ints) -> None:
    """Points of each frame's cloud: 0 where a frame was skipped."""
    rows = np.arange(len(sizes))
    scalars = rr.Scalars.columns(scalars=sizes.astype(float))
    stream.send_columns(layout.under(layout.FRAME_PLOTS, "points"), frame_columns(frames, len(sizes), rows), scalars)


def _encoded(read: Reader) -> EncodedImage | None:
    """The image, None where there is none or it cannot be read: that is counted, and no reason to end a run."""
    try:
        return read() if read else None
    except (SourceError, OSError):
        return None


def _chunks(rows: Ints, readers: Sequence[Reader]) -> Iterator[tuple[Ints, list[EncodedImage]]]:
    """Rows and images, in lots of about `CHUNK_BYTES`."""
    lot: list[tuple[int, EncodedImage]] = []
    lot_bytes = 0
    for row, read in zip(rows, readers, strict=True):
        image = _encoded(read)
        if image is None:
            continue
        if lot and lot_bytes + len(image.contents) > CHUNK_BYTES:
            yield np.array([held for held, _ in lot]), [held for _, held in lot]
            lot, lot_bytes = [], 0
        lot.append((int(row), image))
        lot_bytes += len(image.contents)
    if lot:
        yield np.array([held for held, _ in lot]), [held for _, held in lot]


def _log_images(
    stream: rr.RecordingStream, path: str, indexes: list[rr.TimeColumn], images: list[EncodedImage]
) -> None:
    blobs = [np.frombuffer(image.contents, np.uint8) for image in images]
    types = [image.media_type for image in images]
    if path == layout.COLOUR:
        stream.send_columns(path, indexes, rr.EncodedImage.columns(blob=blobs, media_type=types))
        return
    metres = [image.units_per_metre or 1000.0 for image in images]
    stream.send_columns(path, indexes, rr.EncodedDepthImage.columns(blob=blobs, media_type=types, meter=metres))


def _log_names(stream: rr.RecordingStream, frames: Sequence[Frame]) -> None:
    if frames:
        stream.send_columns(
            layout.CAMERA,
            indexes=frame_columns(frames, len(frames), np.arange(len(frames))),
            columns=rr.AnyValues.columns(
                frame_id=[str(frame.frame_id) for frame in frames],
                sequence=[frame.sequence for frame in frames],
                stamp_s=[frame.stamp_s for frame in frames],
            ),
        )


def _log_cameras(stream: rr.RecordingStream, frames: Sequence[Frame]) -> None:
    """Static where all frames share one camera, which is the common case."""
    rows = np.array([row for row, frame in enumerate(frames) if frame.camera is not None], np.int64)
    cameras = [camera for frame in frames if (camera := frame.camera) is not None]
    if not cameras:
        return
    if len(set(cameras)) == 1:
        stream.send_columns(layout.PINHOLE, [], _pinholes(cameras[:1]))
    else:
        stream.send_columns(layout.PINHOLE, frame_columns(frames, len(frames), rows), _pinholes(cameras))


def _pinholes(cameras: Sequence[Camera]) -> rr.ComponentColumnList:
    """Rerun wants positive focal lengths: a negative fy becomes a camera whose y points up."""
    matrices = np.array([camera.matrix for camera in cameras])
    flipped = matrices[:, 1, 1] < 0
    matrices[:, 1, 1] = np.abs(matrices[:, 1, 1])
    axes = [rr.ViewCoordinates.RUF if flip else rr.ViewCoordinates.RDF for flip in flipped]
    return rr.Pinhole.columns(
        image_from_camera=matrices,
        resolution=[[camera.width, camera.height] for camera in cameras],
        camera_xyz=axes,
        image_plane_distance=np.full(len(cameras), IMAGE_PLANE_M),
    )

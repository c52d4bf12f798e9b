"""The cameras of image topics, by the calibrations of the recording, and of colour beside depth by its transforms."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hodge_adapters.images.camera_files import principal_point_note, resized
from hodge_adapters.images.frames import Lens
from hodge_adapters.images.pixels import same_shape
from hodge_adapters.images.second_camera import SecondCamera
from hodge_adapters.mcap.images import ImageLayout
from hodge_adapters.mcap.recording import Calibration, Recording, Seen
from hodge_adapters.mcap.topics import (
    ImageTopics,
    is_beside,
    is_rectified,
    named_topic,
    parts_shared,
    shares_grid,
    size_text,
)
from hodge_adapters.text_rows import listed
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Camera, Floats
from hodge_pipeline.types.notes import Note

_BROWN_MODELS = frozenset(("", "plumb_bob", "rational_polynomial", "brown_conrady"))
"""Whose D is OpenCV's: four, five or, with a denominator, eight numbers."""
SAME_CAMERA = 1e-3
"""Relative difference of intrinsics up to which they are copies, but for digits, as those of registered images are."""
SAME_MOTION = 1e-3
"""Metres, and of a rotation's matrix, by which the transform between two cameras of one sensor may vary: a pixel."""
_PINHOLE_MODELS = frozenset(
    (
        "", "none", "pinhole", "plumb_bob", "rational_polynomial", "brown_conrady", "modified_brown_conrady",
        "inverse_brown_conrady", "equidistant", "fisheye", "fisheye62", "kannala_brandt", "kannala_brandt4",
    )
)  # fmt: skip


def second_cameras(
    recording: Recording,
    depth: Seen[ImageLayout],
    depth_camera: Camera,
    stamps_s: Floats,
    colour: ImageTopics,
    *,
    undistort: bool,
) -> tuple[dict[str, SecondCamera], set[str]]:
    """The cameras of the colour topics that are not on the depth's grid, by their calibrations and the transforms; and
    the topics of another camera whose place is not known.
    """
    found: dict[str, SecondCamera] = {}
    unknown: set[str] = set()
    for topic, (first, *_) in colour.items():
        known = {
            name: calibration
            for name, calibration in recording.calibrations.items()
            if is_beside(name, topic) or calibration.frame_id == first.frame_id
        }
        if shares_grid(depth, first) or not first.frame_id or not known:
            continue
        own = find_camera(known, topic, first, "", [], [], undistort=undistort)
        if own is None or _is_copy(own[0], depth_camera):
            continue
        same_axes = np.broadcast_to(np.eye(4), (1, 4, 4)) if first.frame_id == depth.frame_id else None
        poses = (
            recording.transforms.lookup(first.frame_id, depth.frame_id, stamps_s) if same_axes is None else same_axes
        )
        motion = None if poses is None else _held(poses)
        if motion is None:
            unknown.add(topic)
        else:
            found[topic] = _second(own, motion, depth_camera)
    return found, unknown


def _is_copy(one: Camera, other: Camera) -> bool:
    """Whether these are the same intrinsics."""
    a, b = ((c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (one, other))
    return np.allclose(a, b, rtol=SAME_CAMERA, atol=0)


def _held(poses: Floats) -> Floats | None:
    """The motion (4, 4) that all of these known poses (N, 4, 4) are; None where they differ, or none is known."""
    known = poses[se3.has_pose(poses)]
    return known[0] if len(known) and np.ptp(known, axis=0).max() < SAME_MOTION else None


def _second(own: tuple[Camera, Lens | None], second_from_depth: Floats, depth: Camera) -> SecondCamera:
    """A camera beside that of depth, of images with no more pixels than depth has for the same angle."""
    camera, lens = own
    shrink = min(depth.fx / camera.fx, 1.0)
    size = max(round(shrink * camera.width), 1), max(round(shrink * camera.height), 1)
    return SecondCamera(resized(camera, size), tuple(second_from_depth[:3].ravel().tolist()), lens)


def find_camera(
    known: Mapping[str, Calibration],
    topic: str,
    image: Seen[ImageLayout],
    calibration_topic: str,
    notes: list[str],
    doubts: list[Note],
    *,
    undistort: bool,
) -> tuple[Camera, Lens | None] | None:
    """The camera of an image topic by its calibration, and its lens where images are to be undistorted; None, with
    notes, where none fits. One of another size is scaled where the shape is the same and its topic lies beside that of
    the images. One of another camera, by its topic and its coordinate frame, is a doubt.
    """
    if calibration_topic:
        chosen, calibration = named_topic(known, calibration_topic, "calibration_topic")
        return _camera(chosen, calibration, topic, image.layout, undistort, notes)
    for name in sorted(known):
        if known[name].model.lower() not in _PINHOLE_MODELS:
            notes.append(f"{name}: calibration left out: its model {known[name].model!r} is no pinhole camera")

    def fits(name: str, size: tuple[int, int]) -> bool:
        same = size in (image.layout.size, (0, 0))
        return same or (is_beside(name, topic) and same_shape(size, image.layout.size))

    fitting = {
        name: calibration
        for name, calibration in known.items()
        if calibration.model.lower() in _PINHOLE_MODELS and fits(name, (calibration.width, calibration.height))
    }
    if not fitting:
        if known:
            sizes = [f"{name} {known[name].width}x{known[name].height}" for name in sorted(known)]
            notes.append(
                f"no calibration fits the {size_text(image.layout)} images of {topic}: there is {listed(sizes)}"
            )
        return None

    def rank(name: str) -> tuple[bool, bool, int, str]:
        return (
            not is_beside(name, topic),
            fitting[name].frame_id != image.frame_id,
            -parts_shared(name, topic),
            name,
        )

    chosen = min(fitting, key=rank)
    frames = image.frame_id, fitting[chosen].frame_id
    if not is_beside(chosen, topic) and all(frames) and frames[0] != frames[1]:
        doubts.append(
            Note(
                "reader's doubt",
                detail=f"{topic} is of {frames[0]}, and its intrinsics are from {chosen}, of {frames[1]}: give those "
                "of its camera with --set source.reader.camera=[fx,fy,cx,cy], or name the topic: "
                "source.reader.calibration_topic",
            )
        )
    return _camera(chosen, fitting[chosen], topic, image.layout, undistort, notes)


def _camera(
    name: str, calibration: Calibration, topic: str, layout: ImageLayout, undistort: bool, notes: list[str]
) -> tuple[Camera, Lens | None]:
    p, k = calibration.p, calibration.k
    by_p = is_rectified(topic) and bool(p) and p[0] > 0 and p[5] != 0
    fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if by_p else (k[0], k[4], k[2], k[5])
    told = calibration.width, calibration.height
    size = told if any(told) else layout.size
    if not same_shape(size, layout.size):
        raise SourceError(
            f"{name}: calibrates {size[0]}x{size[1]} images, those of {topic} are {size_text(layout)}: "
            "give --set source.reader.camera=[fx,fy,cx,cy]"
        )
    camera = resized(Camera(*size, fx, fy, cx, cy), layout.size)
    if size != layout.size:
        notes.append(f"{name}: intrinsics of {size[0]}x{size[1]} are scaled to the images' {size_text(layout)}")
    notes.append(f"{topic}: intrinsics from {name}{' (rectified: P)' if by_p else ''}")
    notes.extend(filter(None, [principal_point_note(camera)]))
    if by_p or not calibration.is_distorted:
        return camera, None
    lens = _lens(camera, calibration) if undistort else None
    if lens:
        notes.append(f"{name}: its lens distortion is removed from the images (undistort)")
    else:
        notes.append(f"{name}: has lens distortion, which is not corrected: images are taken as undistorted")
    return camera, lens


def _lens(camera: Camera, calibration: Calibration) -> Lens | None:
    """The lens of a calibration; None where its model is not OpenCV's polynomial."""
    known = calibration.model.lower() in _BROWN_MODELS and len(calibration.d) in (4, 5, 8)
    if not known or not np.isfinite(calibration.d).all():
        return None
    return Lens(camera, (*calibration.d, 0.0)[: max(len(calibration.d), 5)])

"""The topics of depth, colour and calibration: by their contents, or as the options name them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from hodge_adapters.association import clock_runs
from hodge_adapters.images.camera_files import principal_point_note, resized
from hodge_adapters.images.frames import Lens
from hodge_adapters.images.pixels import same_shape
from hodge_adapters.images.second_camera import SecondCamera
from hodge_adapters.mcap.images import ImageLayout
from hodge_adapters.mcap.recording import Calibration, Recording, Seen
from hodge_adapters.text_rows import listed
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Camera, Floats
from hodge_pipeline.types.text import counted

Item = TypeVar("Item")
ImageTopics = Mapping[str, Sequence[Seen[ImageLayout]]]

_TRANSPORTS = ("/compressedDepth", "/compressed", "/raw", "/zstd", "/ffmpeg", "/theora")
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


def named_topic(topics: Mapping[str, Item], name: str, what: str) -> tuple[str, Item]:
    """The topic that an option names; raises `SourceError` that lists those there are."""
    found = next((topic for topic in topics if topic.strip("/") == name.strip("/")), None)
    if found is None:
        raise SourceError(
            f"option {what}: no messages on {name}: there are {listed(sorted(topics)) or 'no such topics'}"
        )
    return found, topics[found]


def split_depth(images: ImageTopics, notes: list[str]) -> tuple[ImageTopics, ImageTopics]:
    """(depth topics, colour topics): a topic is what most of its images are, and the others are left out."""
    depth: dict[str, Sequence[Seen[ImageLayout]]] = {}
    colour: dict[str, Sequence[Seen[ImageLayout]]] = {}
    for topic, seen in images.items():
        is_depth = sum(image.layout.is_depth for image in seen) * 2 >= len(seen)
        size = Counter(image.layout.size for image in seen if image.layout.is_depth == is_depth).most_common(1)[0][0]
        kept = [image for image in seen if image.layout.is_depth == is_depth and image.layout.size == size]
        if len(kept) < len(seen):
            notes.append(
                f"{topic}: {counted(len(seen) - len(kept), 'image')} of another size or kind than most left out"
            )
        (depth if is_depth else colour)[topic] = kept
    return depth, colour


def best_depth(depth: ImageTopics, colour: ImageTopics, notes: list[str]) -> str:
    """The depth topic that lies on a colour image's grid, else the one with most images; one of mono16, as infrared
    images are, where there is no other.
    """

    def rank(topic: str) -> tuple[bool, bool, int, bool, str]:
        first = depth[topic][0]
        registered = any(_shares_grid(first, other[0]) for other in colour.values())
        grey = first.layout.encoding == "mono16"
        return grey, not registered, -len(depth[topic]), first.layout.coding == "rvl", topic

    ranked = sorted(depth, key=rank)
    if len(ranked) > 1:
        notes.append(f"depth of {ranked[0]} taken, not of {listed(ranked[1:])}: see option depth_topic")
    return ranked[0]


def best_colour(
    colour: ImageTopics,
    depth_topic: str,
    first: Seen[ImageLayout],
    seconds: Mapping[str, SecondCamera],
    others: Collection[str],
    notes: list[str],
) -> str | None:
    """The colour topic on the same pixel grid as the depth, or of a camera that is known beside it (`seconds`); None,
    with a note, where there is none. `others` are of cameras of which it is not known where they are.
    """
    fitting = [
        topic
        for topic in colour
        if topic in seconds or (colour[topic][0].layout.size == first.layout.size and topic not in others)
    ]
    if not fitting:
        if colour:
            sizes = [f"{topic} {_size(colour[topic][0].layout)}" for topic in sorted(colour)]
            told = f"no colour: depth is {_size(first.layout)}, there is {listed(sizes)}"
            notes.append(f"{told}: record registered depth, or camera_info of both and /tf_static")
        return None

    def rank(topic: str) -> tuple[bool, bool, bool, int, int, str]:
        image = colour[topic][0]
        grey = image.layout.encoding in ("mono8", "8UC1")
        shared = len(_common_start(topic, depth_topic))
        rectified = is_rectified(topic) != is_rectified(depth_topic)
        return image.frame_id != first.frame_id, grey, rectified, -shared, -len(colour[topic]), topic

    ranked = sorted(fitting, key=rank)
    if len(ranked) > 1:
        notes.append(f"colour of {ranked[0]} taken, not of {listed(ranked[1:])}: see option colour_topic")
    return ranked[0]


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
            if _is_beside(name, topic) or calibration.frame_id == first.frame_id
        }
        if _shares_grid(depth, first) or not first.frame_id or not known:
            continue
        own = find_camera(known, topic, first, "", [], undistort=undistort)
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
    known = poses[np.isfinite(poses).all(axis=(1, 2))]
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
    *,
    undistort: bool,
) -> tuple[Camera, Lens | None] | None:
    """The camera of an image topic by its calibration, and its lens where images are to be undistorted; None, with
    notes, where none fits. One of another size is scaled where the shape is the same and its topic lies beside that of
    the images.
    """
    if calibration_topic:
        chosen, calibration = named_topic(known, calibration_topic, "calibration_topic")
        return _camera(chosen, calibration, topic, image.layout, undistort, notes)
    for name in sorted(known):
        if known[name].model.lower() not in _PINHOLE_MODELS:
            notes.append(f"{name}: calibration left out: its model {known[name].model!r} is no pinhole camera")

    def fits(name: str, size: tuple[int, int]) -> bool:
        same = size in (image.layout.size, (0, 0))
        return same or (_is_beside(name, topic) and same_shape(size, image.layout.size))

    fitting = {
        name: calibration
        for name, calibration in known.items()
        if calibration.model.lower() in _PINHOLE_MODELS and fits(name, (calibration.width, calibration.height))
    }
    if not fitting:
        if known:
            sizes = [f"{name} {known[name].width}x{known[name].height}" for name in sorted(known)]
            notes.append(f"no calibration fits the {_size(image.layout)} images of {topic}: there is {listed(sizes)}")
        return None

    def rank(name: str) -> tuple[bool, bool, int, str]:
        return (
            not _is_beside(name, topic),
            fitting[name].frame_id != image.frame_id,
            -len(_common_start(name, topic)),
            name,
        )

    chosen = min(fitting, key=rank)
    return _camera(chosen, fitting[chosen], topic, image.layout, undistort, notes)


def _is_beside(name: str, topic: str) -> bool:
    """Whether a calibration's topic lies beside that of images."""
    return name.rpartition("/")[0] == image_base(topic).rpartition("/")[0]


def is_rectified(topic: str) -> bool:
    """Whether images are undistorted, as their topic's name says."""
    return "rect" in image_base(topic).rpartition("/")[2]


def image_base(topic: str) -> str:
    """The topic without the name of its transport: `/camera/depth/image` of `/camera/depth/image/compressedDepth`."""
    return next((topic.removesuffix(end) for end in _TRANSPORTS if topic.endswith(end)), topic)


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
            f"{name}: calibrates {size[0]}x{size[1]} images, those of {topic} are {_size(layout)}: "
            "give --set source.reader.camera=[fx,fy,cx,cy]"
        )
    camera = resized(Camera(*size, fx, fy, cx, cy), layout.size)
    if size != layout.size:
        notes.append(f"{name}: intrinsics of {size[0]}x{size[1]} are scaled to the images' {_size(layout)}")
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


def one_per_stamp(topic: str, seen: Sequence[Seen[Item]], notes: list[str]) -> list[Seen[Item]]:
    """The images or clouds of a topic by stamp, the first of those with the same stamp; where a file's clock jumps
    back, those before the jump come first.

    A topic whose stamps are all the same has none that mean anything: there the log's time is taken.
    """
    if len(seen) > 1 and len({item.stamp_s for item in seen}) == 1:
        notes.append(f"{topic}: all {len(seen)} messages have the stamp {seen[0].stamp_s:.9g} s: log time is taken")
        seen = [replace(item, stamp_s=item.log_s) for item in seen]
    in_one_file = np.array([a.payload.path == b.payload.path for a, b in pairwise(seen)], bool)
    runs = clock_runs(np.array([item.stamp_s for item in seen]), in_one_file).tolist()
    if any(runs):
        jumps = counted(runs[-1], "time")
        notes.append(f"{topic}: the clock jumps back {jumps}: messages are taken in the order of the recording")
    first: dict[tuple[int, float], Seen[Item]] = {}
    for run, item in zip(runs, seen, strict=True):
        first.setdefault((run, item.stamp_s), replace(item, run=run))
    if len(first) < len(seen):
        notes.append(f"{topic}: {counted(len(seen) - len(first), 'message')} with the stamp of an earlier one left out")
    return [first[key] for key in sorted(first)]


def _shares_grid(a: Seen[ImageLayout], b: Seen[ImageLayout]) -> bool:
    return a.frame_id == b.frame_id and a.layout.size == b.layout.size


def _size(layout: ImageLayout) -> str:
    return f"{layout.width}x{layout.height}"


def _common_start(a: str, b: str) -> list[str]:
    """The leading parts that two topics share."""
    pairs = zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False)
    shared: list[str] = []
    for one, other in pairs:
        if one != other:
            break
        shared.append(one)
    return shared

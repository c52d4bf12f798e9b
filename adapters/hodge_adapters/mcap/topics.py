"""The topics of depth and colour images: by their contents, or as the options name them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, takewhile
from typing import TypeVar

import numpy as np

from hodge_adapters.association import clock_runs
from hodge_adapters.images.second_camera import SecondCamera
from hodge_adapters.mcap.images import ImageLayout
from hodge_adapters.mcap.recording import Seen
from hodge_adapters.text_rows import listed
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types.text import counted

Item = TypeVar("Item")
ImageTopics = Mapping[str, Sequence[Seen[ImageLayout]]]

_TRANSPORTS = ("/compressedDepth", "/compressed", "/raw", "/zstd", "/ffmpeg", "/theora")


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
        registered = any(shares_grid(first, other[0]) for other in colour.values())
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
            sizes = [f"{topic} {size_text(colour[topic][0].layout)}" for topic in sorted(colour)]
            told = f"no colour: depth is {size_text(first.layout)}, there is {listed(sizes)}"
            notes.append(f"{told}: record registered depth, or camera_info of both and /tf_static")
        return None

    def rank(topic: str) -> tuple[bool, bool, bool, int, int, str]:
        image = colour[topic][0]
        grey = image.layout.encoding in ("mono8", "8UC1")
        shared = parts_shared(topic, depth_topic)
        rectified = is_rectified(topic) != is_rectified(depth_topic)
        return image.frame_id != first.frame_id, grey, rectified, -shared, -len(colour[topic]), topic

    ranked = sorted(fitting, key=rank)
    if len(ranked) > 1:
        notes.append(f"colour of {ranked[0]} taken, not of {listed(ranked[1:])}: see option colour_topic")
    return ranked[0]


def is_beside(name: str, topic: str) -> bool:
    """Whether a calibration's topic lies beside that of images."""
    return name.rpartition("/")[0] == image_base(topic).rpartition("/")[0]


def is_rectified(topic: str) -> bool:
    """Whether images are undistorted, as their topic's name says."""
    return "rect" in image_base(topic).rpartition("/")[2]


def image_base(topic: str) -> str:
    """The topic without the name of its transport: `/camera/depth/image` of `/camera/depth/image/compressedDepth`."""
    return next((topic.removesuffix(end) for end in _TRANSPORTS if topic.endswith(end)), topic)


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


def shares_grid(a: Seen[ImageLayout], b: Seen[ImageLayout]) -> bool:
    """Whether two images have one coordinate frame and size: their pixels then see the same."""
    return a.frame_id == b.frame_id and a.layout.size == b.layout.size


def size_text(layout: ImageLayout) -> str:
    """Such as 640x480."""
    return f"{layout.width}x{layout.height}"


def parts_shared(a: str, b: str) -> int:
    """How many leading parts two topics share."""
    pairs = zip(a.strip("/").split("/"), b.strip("/").split("/"), strict=False)
    return sum(1 for _ in takewhile(lambda parts: parts[0] == parts[1], pairs))

"""What a recording holds, by topic: where its images and clouds lie, its calibrations, poses, fixes and transforms."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from mcap.records import Channel, Schema

from hodge_adapters.mcap.clouds import CloudLayout, foxglove_layout, livox_layout, ros_layout
from hodge_adapters.mcap.fields import (
    Decoder,
    Message,
    Payload,
    decoder_for,
    frame_id,
    numbers,
    part,
    parts,
    payload_of,
    pose_values,
    stamp_s,
    text,
    whole,
)
from hodge_adapters.mcap.fixes import Fix, fix_of
from hodge_adapters.mcap.images import ImageLayout, compressed_layout, raw_layout
from hodge_adapters.mcap.log import LogFile
from hodge_adapters.mcap.message_file import Complaints, Logged, MessageFile, Tally
from hodge_adapters.mcap.records import Malformed
from hodge_adapters.mcap.ros1_bag import MAGIC as BAG_MAGIC
from hodge_adapters.mcap.ros1_bag import BagFile
from hodge_adapters.mcap.ros_tf import PoseColumns, TransformTree
from hodge_adapters.mcap.sqlite_bag import SqliteBag
from hodge_adapters.sqlite_file import MAGIC as SQLITE_MAGIC
from hodge_pipeline.types.input_files import beginning

Layout = TypeVar("Layout")

A_MESSAGE_WITH = "a message with "
NO_PINHOLE = "a matrix K that is no pinhole camera's"


@dataclass(frozen=True)
class Seen(Generic[Layout]):
    """One image or cloud of a topic: its times and coordinate frame, how its bytes are laid out and where they lie;
    `run` counts the jumps of the clock back in time before it.
    """

    stamp_s: float
    log_s: float
    frame_id: str
    layout: Layout
    payload: Payload
    run: int = 0


@dataclass(frozen=True)
class Calibration:
    """A pinhole calibration: K and P by rows, and the distortion D as the model orders it."""

    frame_id: str
    width: int
    height: int
    k: tuple[float, ...]
    p: tuple[float, ...]
    model: str
    d: tuple[float, ...]

    @property
    def is_distorted(self) -> bool:
        """Whether the lens is said to distort."""
        return any(self.d)


@dataclass
class PoseTopic:
    """The poses of one topic, `frame_from_child`; `child` is empty where the messages do not say what moves."""

    frame: str
    child: str
    poses: PoseColumns = field(default_factory=PoseColumns)


@dataclass
class Recording:
    """Filled by `read_file`, one file after another."""

    transforms: TransformTree
    complaints: Complaints = field(default_factory=Complaints)
    images: dict[str, list[Seen[ImageLayout]]] = field(default_factory=dict)
    clouds: dict[str, list[Seen[CloudLayout]]] = field(default_factory=dict)
    calibrations: dict[str, Calibration] = field(default_factory=dict)
    poses: dict[str, PoseTopic] = field(default_factory=dict)
    topics: dict[str, str] = field(default_factory=dict)
    fixes: dict[str, list[Fix]] = field(default_factory=dict)
    tallies: dict[str, Tally] = field(default_factory=dict)
    clock_differences_s: array[float] = field(default_factory=lambda: array("d"))
    _decoders: dict[tuple[str, str], Decoder | None] = field(default_factory=dict)

    def read_file(self, path: Path) -> None:
        """Go once through a file; raises `SourceError` only where it is no recording or cannot be read."""
        for logged in _kind_of_file(path)(path, self._wants, self.complaints, tallies=self.tallies).messages():
            topic = logged.channel.topic
            try:
                self._add(path, logged)
            except Malformed as error:
                self.complaints.count(topic, A_MESSAGE_WITH + str(error))

    def contents(self) -> tuple[str, ...]:
        """Its topics with type, count and rate, and its transforms, a line each."""
        topics = ((topic, kind, self.tallies.get(topic, "no message")) for topic, kind in sorted(self.topics.items()))
        return (*(f"{topic} ({kind}): {tally}" for topic, kind, tally in topics), *self.transforms.contents())

    def _wants(self, channel: Channel, schema: Schema | None) -> bool:
        name = schema.name if schema else ""
        self.topics.setdefault(channel.topic, name or channel.message_encoding)
        if kind_of(name) is None:
            return False
        try:
            self._decoders[channel.topic, name] = decoder_for(channel, schema)
        except Malformed as error:
            self.complaints.say(f"{channel.topic}: left out: {error}")
            return False
        return True

    def _add(self, path: Path, logged: Logged) -> None:
        assert logged.schema is not None
        decoder = self._decoders[logged.channel.topic, logged.schema.name]
        add = kind_of(logged.schema.name)
        assert decoder is not None and add is not None
        add(self, decoder(logged.data), path, logged)

    def stamp(self, message: Message, logged: Logged) -> float:
        """The stamp of a message's header; the log's own time where it was never set."""
        log_s = logged.log_time_ns * 1e-9
        stamp = stamp_s(message)
        if stamp == 0:
            self.complaints.say(f"{logged.channel.topic}: has messages without a stamp: their log time is taken")
            return log_s
        self.clock_differences_s.append(log_s - stamp)
        return stamp

    def clock_note(self) -> str | None:
        """A note where header stamps and log times are of different clocks, else None."""
        if not len(self.clock_differences_s):
            return None
        difference_s = float(np.median(np.frombuffer(self.clock_differences_s, float)))
        if abs(difference_s) < 1:
            return None
        return f"header stamps are taken: the log's clock differs from them by {difference_s:.6g} s (median)"


def _kind_of_file(path: Path) -> type[MessageFile]:
    """What reads a file: by how it starts, else by its ending."""
    begins = beginning(path, len(SQLITE_MAGIC))
    if begins.startswith(BAG_MAGIC):
        return BagFile
    if begins == SQLITE_MAGIC:
        return SqliteBag
    by_ending: dict[str, type[MessageFile]] = {".bag": BagFile, ".db3": SqliteBag}
    return by_ending.get(path.suffix, LogFile)


Add = Callable[[Recording, Message, Path, Logged], None]


def kind_of(schema_name: str) -> Add | None:
    """How messages of a schema are added to a recording; None for those that are of no use here."""
    package, _, name = schema_name.replace("/msg/", "/").replace(".", "/").rpartition("/")
    return _KINDS.get((package.removesuffix("_msgs"), name))


def _adds(
    of: Callable[[Recording], dict[str, list[Seen[Layout]]]], layout_of: Callable[[Message, int, bytes], Layout]
) -> Add:
    """A function that adds an image or a cloud; `layout_of` takes the message, its payload's length and its bytes."""

    def add(recording: Recording, message: Message, path: Path, logged: Logged) -> None:
        stamp = recording.stamp(message, logged)
        payload, length = payload_of(message, path, logged.place, f"{logged.channel.topic} at {stamp:.9f} s")
        log_s, frame = logged.log_time_ns * 1e-9, frame_id(message)
        seen = Seen(stamp, log_s, frame, layout_of(message, length, logged.data), payload)
        of(recording).setdefault(logged.channel.topic, []).append(seen)

    return add


def _add_livox(recording: Recording, message: Message, path: Path, logged: Logged) -> None:
    _LIVOX_CLOUD(recording, message | {"data": message.get("points")}, path, logged)


def _add_calibration(recording: Recording, message: Message, path: Path, logged: Logged) -> None:
    topic = logged.channel.topic
    k, p, distortion = numbers(message, "k", "K"), numbers(message, "p", "P"), numbers(message, "d", "D")
    if len(k) != 9 or not np.isfinite(k).all() or k[0] <= 0 or k[4] == 0:
        raise Malformed(NO_PINHOLE)
    calibration = Calibration(
        frame_id=frame_id(message),
        width=whole(message, "width"),
        height=whole(message, "height"),
        k=tuple(k.tolist()),
        p=tuple(p.tolist()) if len(p) == 12 and np.isfinite(p).all() else (),
        model=text(message, "distortion_model"),
        d=tuple(distortion.tolist()),
    )
    if recording.calibrations.setdefault(topic, calibration) != calibration:
        recording.complaints.count(topic, "a calibration that differs from the topic's first, which all frames get")


def _add_pose(recording: Recording, message: Message, path: Path, logged: Logged) -> None:
    pose = part(message, "pose")
    pose = part(pose, "pose") if "pose" in pose else pose
    values = pose_values(part(pose, "position"), part(pose, "orientation"))
    frame, child = frame_id(message), text(message, "child_frame_id").lstrip("/")
    topic = recording.poses.setdefault(logged.channel.topic, PoseTopic(frame, child))
    if (topic.frame, topic.child) != (frame, child):
        raise Malformed(f"a pose of {child} in {frame}, others are of {topic.child} in {topic.frame}")
    topic.poses.add(recording.stamp(message, logged), values)


def _add_fix(recording: Recording, message: Message, path: Path, logged: Logged) -> None:
    found = fix_of(message, recording.stamp(message, logged))
    recording.fixes.setdefault(logged.channel.topic, []).append(found)


def _add_transforms(recording: Recording, message: Message, path: Path, logged: Logged) -> None:
    for transform in parts(message, "transforms") if "transforms" in message else [message]:
        try:
            _add_transform(recording, transform, logged)
        except Malformed as error:
            recording.complaints.count(logged.channel.topic, f"a transform with {error}")


def _add_transform(recording: Recording, transform: Message, logged: Logged) -> None:
    is_static = logged.channel.topic.endswith("tf_static")
    # A Foxglove transform is flat, a ROS one has its motion in a message of its own.
    motion = part(transform, "transform") if "transform" in transform else transform
    values = pose_values(part(motion, "translation"), part(motion, "rotation"))
    parent = text(transform, "parent_frame_id").lstrip("/") or frame_id(transform)
    child = text(transform, "child_frame_id").lstrip("/")
    if not child or parent == child:
        raise Malformed("fewer than two frames")
    # A static transform may have been sent long before, by another clock, or without a stamp: it does not matter.
    stamp = stamp_s(transform) if is_static else recording.stamp(transform, logged)
    recording.transforms.add(parent, child, stamp, values, is_static=is_static)


_IMAGES, _CLOUDS = attrgetter("images"), attrgetter("clouds")
_RAW_IMAGE = _adds(_IMAGES, lambda message, length, _: raw_layout(message, length))
_LIVOX_CLOUD = _adds(_CLOUDS, livox_layout)
_CODED_IMAGE = _adds(_IMAGES, lambda message, _, contents: compressed_layout(message, contents))
_KINDS: dict[tuple[str, str], Add] = {
    ("sensor", "Image"): _RAW_IMAGE,
    ("sensor", "CompressedImage"): _CODED_IMAGE,
    ("foxglove", "RawImage"): _RAW_IMAGE,
    ("foxglove", "CompressedImage"): _CODED_IMAGE,
    ("sensor", "PointCloud2"): _adds(_CLOUDS, lambda message, length, _: ros_layout(message, length)),
    ("foxglove", "PointCloud"): _adds(_CLOUDS, lambda message, length, _: foxglove_layout(message, length)),
    ("livox_ros_driver", "CustomMsg"): _add_livox,
    ("livox_ros_driver2", "CustomMsg"): _add_livox,
    ("livox_interfaces", "CustomMsg"): _add_livox,
    ("sensor", "CameraInfo"): _add_calibration,
    ("foxglove", "CameraCalibration"): _add_calibration,
    ("sensor", "NavSatFix"): _add_fix,
    ("foxglove", "LocationFix"): _add_fix,
    ("nav", "Odometry"): _add_pose,
    ("geometry", "PoseStamped"): _add_pose,
    ("geometry", "PoseWithCovarianceStamped"): _add_pose,
    ("foxglove", "PoseInFrame"): _add_pose,
    ("geometry", "TransformStamped"): _add_transforms,
    ("tf2", "TFMessage"): _add_transforms,
    ("tf", "tfMessage"): _add_transforms,
    ("foxglove", "FrameTransform"): _add_transforms,
    ("foxglove", "FrameTransforms"): _add_transforms,
}

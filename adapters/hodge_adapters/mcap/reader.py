"""Recordings: ROS 2 bags (MCAP, SQLite), ROS 1 bags, Foxglove logs with depth images, point clouds and poses.

A recording is gone through once when opened, without decoding an image; frames know where their bytes lie.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.association import nearest_in_runs, unpaired_doubts
from hodge_adapters.images.camera_files import Intrinsics, checked
from hodge_adapters.images.frames import Lens
from hodge_adapters.images.second_camera import SecondCamera
from hodge_adapters.mcap.cameras import find_camera, second_cameras
from hodge_adapters.mcap.clouds import is_rounded
from hodge_adapters.mcap.files import find_files, sniff_recording
from hodge_adapters.mcap.fixes import positions_of
from hodge_adapters.mcap.frames import cloud_frames, colour_frames, depth_frames
from hodge_adapters.mcap.images import ImageLayout
from hodge_adapters.mcap.poses import PoseOptions, find_poses
from hodge_adapters.mcap.recording import A_MESSAGE_WITH, NO_PINHOLE, Recording, Seen
from hodge_adapters.mcap.ros_tf import TransformTree
from hodge_adapters.mcap.topics import ImageTopics, best_colour, best_depth, named_topic, one_per_stamp, split_depth
from hodge_adapters.text_rows import listed
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Camera, Floats, Frame, Source
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted

Layout = TypeVar("Layout")

RAW_SCANS = frozenset({"VelodyneScan", "PacketMsg", "PandarScan", "RslidarPacket"})
"""Messages of Velodyne's, Ouster's, Hesai's and RoboSense's drivers that hold no PointCloud2."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class McapReader:
    """Reads an MCAP file, a `.db3` or a `.bag`, or a folder with the files of a split recording."""

    frames: Literal["auto", "depth", "points", "colour"] = Field(
        "auto", description="what makes a frame; auto: depth images if there are any, else point clouds, else colour"
    )
    depth_topic: str = Field("", description="topic of the depth images; empty: found by type, registered depth first")
    colour_topic: str = Field("", description="topic of the colour images; empty: found by type, on the depth's grid")
    points_topic: str = Field("", description="topic of the point clouds; empty: that with most messages")
    calibration_topic: str = Field("", description="topic of the calibration; empty: the one beside the images")
    camera: tuple[float, float, float, float] | None = Field(
        None, description="fx fy cx cy in pixels, for recordings without a calibration"
    )
    undistort: bool = Field(
        True,
        description="undistort depth and colour by D of the calibration, of the models plumb_bob and "
        "rational_polynomial; topics named rect are undistorted already",
    )
    colour_camera: Literal["auto", "same"] = Field(
        "auto",
        description="same: colour lies on the pixels of depth; auto: so where both have one coordinate frame and size, "
        "else it is brought there by the calibrations and transforms of both",
    )
    depth_scale: float | None = Field(
        None,
        gt=0,
        description="units per metre of depth; none: 1000 of 16-bit depth, 1 of floats, as ROS has them (REP 118)",
    )
    no_depth: tuple[int, ...] = Field((0, 65535), description="16-bit values that mean no depth; 65535 is the largest")
    max_difference_s: float = Field(
        0.02, ge=0, description="seconds between the stamps of a depth image and its colour image, as for TUM"
    )
    pose_topic: str = Field("", description="topic of odometry or poses; empty: odometry first, else transforms")
    pose_child: str = Field(
        "", description="coordinate frame that the pose topic, or transforms alone, move; empty: as messages say"
    )
    world_frame: str = Field("", description="take poses from the transforms to this frame; empty: odometry's frame")
    max_gap_s: float = Field(
        0.2, ge=0, description="seconds to the neighbours that a pose is interpolated from; odometry often has 10 Hz"
    )
    every: int = Field(1, ge=1, description="take every n-th frame")

    def sniff(self, path: Path) -> Sniff:
        """Sure where the file starts as a recording does, or the folder has some beside `metadata.yaml`."""
        return sniff_recording(Path(path))

    def open(self, path: Path) -> Source:
        """Frames in order of their header stamps, and odometry (moved to the camera where possible) as trajectory.

        `frame_id` is the row among the frames before `every`.
        """
        path = Path(path)
        notes: list[str] = []
        listing = find_files(path, notes)
        recording = Recording(TransformTree(self.max_gap_s))
        for file in listing.logs:
            if len(listing.logs) > 1 and not file.stat().st_size:
                recording.complaints.loses(file, f"{file.name}: the file is empty")
            else:
                recording.read_file(file)
        notes += recording.complaints.notes()
        notes += filter(None, [recording.clock_note()])
        if recording.transforms.other_parents:
            notes.append(f"{recording.transforms.other_parents} transforms of frames with two parents left out")
        if recording.transforms.replaced:
            notes.append(f"{counted(recording.transforms.replaced, 'static transform')} replaced by a later, other one")
        doubts = [Note("recording incomplete", len(damaged))] if (damaged := recording.complaints.damaged) else []
        frames, camera_frame = self._frames(path, recording, notes, doubts)
        frames = frames[:: self.every]
        stamps_s = np.array([frame.stamp_s for frame in frames], float)
        options = PoseOptions(self.pose_topic, self.pose_child, self.world_frame, self.max_gap_s)
        poses = find_poses(recording, camera_frame, stamps_s, options, notes)
        positions = positions_of(recording.fixes, notes)
        if not frames and poses.trajectory is None and positions is None:
            raise _nothing(path, recording)
        return Source(
            name=path.stem if path.is_file() else path.resolve().name,
            path=path,
            frames=tuple(
                replace(frame, world_from_cam=pose) if np.isfinite(pose).all() else frame
                for frame, pose in zip(frames, poses.of_frames, strict=True)
            ),
            trajectory=poses.trajectory,
            notes=tuple(notes),
            doubts=tuple(doubts),
            files=listing.all,
            contents=recording.contents(),
            positions=positions,
        )

    def _frames(
        self, path: Path, recording: Recording, notes: list[str], doubts: list[Note]
    ) -> tuple[list[Frame], str]:
        """All frames, and the coordinate frame of their camera."""
        depth, colour = split_depth(recording.images, notes)
        kind = self.frames
        if kind == "auto":
            kind = "depth" if depth else "points" if recording.clouds else "colour"
            if depth and recording.clouds:
                notes.append(f"point clouds of {listed(sorted(recording.clouds))} not taken: see option frames")
        if kind == "depth" and depth:
            return self._depth_frames(path, recording, depth, colour, notes, doubts)
        if kind == "points" and recording.clouds:
            return self._cloud_frames(recording, notes)
        if kind == "colour" and colour:
            return self._colour_frames(recording, colour, notes, doubts)
        if self.frames != "auto":
            raise SourceError(f"{path}: no {kind} in it (option frames): it has {_topics(recording)}")
        return [], ""

    def _depth_frames(
        self,
        path: Path,
        recording: Recording,
        depth: ImageTopics,
        colour: ImageTopics,
        notes: list[str],
        doubts: list[Note],
    ) -> tuple[list[Frame], str]:
        named = named_topic(depth, self.depth_topic, "depth_topic")[0] if self.depth_topic else ""
        topic = named or best_depth(depth, colour, notes)
        images = one_per_stamp(topic, depth[topic], notes)
        before = len(notes)
        found = self._camera(recording, topic, images[0], notes, doubts)
        if found is None:
            reasons = [*notes[before:], *recording.complaints.counted(A_MESSAGE_WITH + NO_PINHOLE)]
            why = "".join(f"; {note}" for note in reasons)
            raise SourceError(f"{path}: no calibration for {topic}{why}: give --set source.reader.camera=[fx,fy,cx,cy]")
        camera, lens = found
        if self.colour_topic:
            colour = dict([named_topic(colour, self.colour_topic, "colour_topic")])
        seconds, others = self._second_cameras(recording, images, camera, colour)
        colour_topic = best_colour(colour, topic, images[0], seconds, others, notes)
        second = seconds.get(colour_topic or "")
        coloured = self._associated(topic, images, colour_topic, colour, second, notes)
        if colour_topic:
            doubts += unpaired_doubts([image is not None for image in coloured])
        scale = self.depth_scale
        frames = depth_frames(images, coloured, camera, lens, second, depth_scale=scale, no_depth=self.no_depth)
        return frames, _coordinate_frame(topic, images, notes)

    def _second_cameras(
        self, recording: Recording, images: Sequence[Seen[ImageLayout]], camera: Camera, colour: ImageTopics
    ) -> tuple[dict[str, SecondCamera], set[str]]:
        if self.colour_camera == "same":
            return {}, set()
        return second_cameras(recording, images[0], camera, _stamps(images), colour, undistort=self.undistort)

    def _associated(
        self,
        topic: str,
        images: Sequence[Seen[ImageLayout]],
        colour_topic: str | None,
        colour: ImageTopics,
        second: SecondCamera | None,
        notes: list[str],
    ) -> list[Seen[ImageLayout] | None]:
        """The colour image of each depth image by header stamp, None where none is near."""
        if colour_topic is None:
            if not colour:
                notes.append("no colour images: frames have no colour")
            return [None] * len(images)
        others = one_per_stamp(colour_topic, colour[colour_topic], notes)
        runs = [np.array([item.run for item in items]) for items in (images, others)]
        columns = nearest_in_runs(_stamps(images), runs[0], _stamps(others), runs[1], self.max_difference_s)
        without = int((columns < 0).sum())
        if without:
            hint = ": are they on another clock?" if without == len(images) else ""
            limit = f"{self.max_difference_s:g} s by header stamp"
            notes.append(f"{without} depth images of {topic} have no colour of {colour_topic} within {limit}{hint}")
        if second:
            notes.append(
                f"{colour_topic}: is of another camera than depth, and brought onto its pixels by the calibrations and "
                "transforms of both (colour_camera=same takes it as registered)"
            )
        elif others[0].frame_id != images[0].frame_id:
            frames = f"{images[0].frame_id or 'no frame'}, colour in {others[0].frame_id or 'no frame'}"
            notes.append(f"depth is in {frames}: colour is off by as much as these differ")
        return [others[column] if column >= 0 else None for column in columns.tolist()]

    def _cloud_frames(self, recording: Recording, notes: list[str]) -> tuple[list[Frame], str]:
        topic = self._pick(recording.clouds, self.points_topic, "points_topic", notes)
        clouds = one_per_stamp(topic, recording.clouds[topic], notes)
        if is_rounded(clouds[0].payload, clouds[0].layout):
            notes.append(
                f"{topic}: its points lie far from zero and are rounded, since 32-bit numbers lose digits there"
            )
        return cloud_frames(clouds), _coordinate_frame(topic, clouds, notes)

    def _colour_frames(
        self, recording: Recording, colour: ImageTopics, notes: list[str], doubts: list[Note]
    ) -> tuple[list[Frame], str]:
        topic = self._pick(colour, self.colour_topic, "colour_topic", notes)
        images = one_per_stamp(topic, colour[topic], notes)
        camera, lens = self._camera(recording, topic, images[0], notes, doubts) or (None, None)
        notes.append(f"frames are the images of {topic} alone: there is neither depth nor a point cloud")
        return colour_frames(images, camera, lens), _coordinate_frame(topic, images, notes)

    def _camera(
        self, recording: Recording, topic: str, image: Seen[ImageLayout], notes: list[str], doubts: list[Note]
    ) -> tuple[Camera, Lens | None] | None:
        if self.camera is not None:
            return checked(Intrinsics(*self.camera), "option camera").camera(image.layout.size), None
        return find_camera(
            recording.calibrations, topic, image, self.calibration_topic, notes, doubts, undistort=self.undistort
        )

    def _pick(self, topics: Mapping[str, Sequence[object]], name: str, what: str, notes: list[str]) -> str:
        if name:
            return named_topic(topics, name, what)[0]
        ranked = sorted(topics, key=lambda topic: (-len(topics[topic]), topic))
        if len(ranked) > 1:
            notes.append(f"{ranked[0]} taken, not {listed(ranked[1:])}: see option {what}")
        return ranked[0]


def _stamps(seen: Sequence[Seen[Layout]]) -> Floats:
    return np.array([item.stamp_s for item in seen], float)


def _coordinate_frame(topic: str, seen: Sequence[Seen[Layout]], notes: list[str]) -> str:
    """The coordinate frame that most messages of a topic are in."""
    (frame, count), *others = Counter(item.frame_id for item in seen).most_common()
    if others:
        notes.append(
            f"{topic}: {counted(len(seen) - count, 'message is|messages are')} not in {frame}: taken as if it were"
        )
    return frame


def _topics(recording: Recording) -> str:
    return listed([f"{topic} ({name})" for topic, name in sorted(recording.topics.items())])


def _nothing(path: Path, recording: Recording) -> SourceError:
    why = "".join(f"; {note}" for note in recording.complaints.notes())
    remedy = "record depth images, point clouds or odometry"
    if any(name.rpartition("/")[2] in RAW_SCANS for name in recording.topics.values()):
        remedy = "these are a scanner's own packets: record its driver's PointCloud2"
    elif moving := recording.transforms.moving():
        remedy = f"transforms move {listed(moving)}: name one for its poses, --set source.reader.pose_child={moving[0]}"
    if not recording.topics:
        return SourceError(f"{path}: holds no message{why}: {remedy}")
    return SourceError(f"{path}: no depth, clouds, images or poses in {_topics(recording)}{why}: {remedy}")

"""Poses of the camera: from odometry or pose topics, moved from body to camera by /tf, or from /tf alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_adapters.mcap.recording import Recording
from hodge_adapters.mcap.topics import named_topic
from hodge_adapters.text_rows import listed
from hodge_pipeline import se3
from hodge_pipeline.types import Floats, Trajectory


@dataclass(frozen=True)
class Poses:
    """Poses (N, 4, 4) of the frames, NaN where there is none, the whole trajectory, and whether it is the camera's."""

    of_frames: Floats
    trajectory: Trajectory | None
    linked: bool = True


@dataclass(frozen=True)
class PoseOptions:
    """The reader's options about poses, see there."""

    topic: str
    child: str
    world_frame: str
    max_gap_s: float


def find_poses(
    recording: Recording, camera_frame: str, stamps_s: Floats, options: PoseOptions, notes: list[str]
) -> Poses:
    """Poses of the camera at the stamps, from what the recording has; `camera_frame` is empty where it is unknown."""
    if options.topic or (recording.poses and not options.world_frame):
        topic = _choose(recording, options.topic, camera_frame, stamps_s, notes)
        poses = _from_topic(recording, topic, camera_frame, stamps_s, options, notes)
    else:
        poses = _from_transforms(recording, camera_frame, stamps_s, options, notes)
    without = int(np.isnan(poses.of_frames[:, 0, 0]).sum())
    if without and poses.trajectory is not None and poses.linked:
        hint = ": are they on another clock?" if without == len(stamps_s) else ""
        limit = f"{options.max_gap_s:g} s of their stamp"
        notes.append(f"{without} of {len(stamps_s)} frames have no pose within {limit}{hint}")
    return poses


def _choose(recording: Recording, name: str, camera_frame: str, stamps_s: Floats, notes: list[str]) -> str:
    topics = recording.poses
    if name:
        return named_topic(topics, name, "pose_topic")[0]

    def rank(topic: str) -> tuple[bool, bool, int, str]:
        # Odometry says what moves; of a bare pose it has to be assumed. Of several robots only one carries the camera.
        body = topics[topic].child
        apart = body != camera_frame and recording.transforms.lookup(body, camera_frame, stamps_s) is None
        return not body, apart, -len(topics[topic].poses), topic

    ranked = sorted(topics, key=rank)
    if len(ranked) > 1:
        notes.append(f"poses of {ranked[0]} taken, not of {listed(ranked[1:])}: see option pose_topic")
    return ranked[0]


def _from_topic(
    recording: Recording, name: str, camera_frame: str, stamps_s: Floats, options: PoseOptions, notes: list[str]
) -> Poses:
    topic = recording.poses[name]
    body = options.child or topic.child
    parsed = topic.poses.ordered()
    trajectory = parsed.trajectory
    notes += [f"{name}: {note}" for note in parsed.notes]
    of_frames = se3.poses_at(trajectory, stamps_s, options.max_gap_s)
    if not len(stamps_s):
        notes.append(f"trajectory of {body or 'what it moves'} in {topic.frame or 'its world'} from {name}")
        return Poses(of_frames, trajectory)
    body_from_cam = _body_from_cam(recording, name, body, camera_frame, stamps_s, notes)
    if body_from_cam is None:
        return Poses(np.full_like(of_frames, np.nan), trajectory, linked=False)
    along = recording.transforms.lookup(body, camera_frame, trajectory.stamps_s) if body != camera_frame else None
    if along is not None:
        trajectory = _finite(Trajectory(trajectory.stamps_s, trajectory.world_from_cam @ along))
    notes.append(f"poses of the camera in {topic.frame or 'its world'} from {name}")
    return Poses(of_frames @ body_from_cam, trajectory)


def _body_from_cam(
    recording: Recording,
    name: str,
    body: str,
    camera_frame: str,
    stamps_s: Floats,
    notes: list[str],
) -> Floats | None:
    """The camera in the body (N, 4, 4) or (1, 4, 4), None where nothing says where it sits."""
    if not body or not camera_frame:
        what = "the messages do not say what moves" if not body else "the images do not say their frame"
        notes.append(f"{name}: taken as poses of the camera itself: {what} (option pose_child)")
        return np.eye(4)[None]
    if body == camera_frame:
        return np.eye(4)[None]
    found = recording.transforms.lookup(body, camera_frame, stamps_s)
    if found is None:
        notes.append(
            f"no transform leads from {body} of {name} to {camera_frame}: frames have no pose, "
            f"the trajectory is of {body}: record /tf_static, or give --set source.reader.pose_child={camera_frame}"
        )
    return found


def _from_transforms(
    recording: Recording, camera_frame: str, stamps_s: Floats, options: PoseOptions, notes: list[str]
) -> Poses:
    tree = recording.transforms
    none = Poses(np.full((len(stamps_s), 4, 4), np.nan), None)
    camera_frame = camera_frame or options.child
    of_camera = f"{camera_frame}, the camera's frame" if camera_frame else "the camera"
    unlinked = f"no poses: no transform leads from {listed(tree.moving())} to {of_camera}: record /tf_static too"
    if camera_frame not in tree:
        notes.append(unlinked if tree.moving() else "no poses: neither odometry nor transforms of the camera")
        return none
    world = options.world_frame or tree.root(camera_frame)
    moving_s = tree.moving_stamps(world, camera_frame)
    of_frames, along = tree.lookup(world, camera_frame, stamps_s), tree.lookup(world, camera_frame, moving_s)
    if of_frames is None or along is None or not len(moving_s):
        is_apart = bool(tree.moving()) and not options.world_frame
        notes.append(unlinked if is_apart else f"no poses: no transforms in time lead from {world} to {camera_frame}")
        return none
    notes.append(f"poses of {camera_frame} in {world} from the transforms")
    return Poses(of_frames, _finite(Trajectory(moving_s, along)))


def _finite(trajectory: Trajectory) -> Trajectory:
    good = se3.is_motion(trajectory.world_from_cam)
    return Trajectory(trajectory.stamps_s[good], trajectory.world_from_cam[good])

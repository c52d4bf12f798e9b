from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.mcap.reader import McapReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.sources.inspect import inspect
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Floats
from mcap_data import (
    COLOUR,
    OPTICAL,
    SECOND,
    Log,
    depth_log,
    foxglove_header,
    odometry,
    pose_message,
    raw_image,
    ros_header,
    some_images,
    transforms,
)
from mcap_encoding import CDR, ENCODINGS, PROTOBUF
from readers_data import HEIGHT, WIDTH, some_poses
from synthetic import tiny_sequence  # noqa: F401


def camera_on_body() -> Floats:
    """The optical axes of a camera that looks along a body's x, 10 cm ahead: z ahead, x right, y down."""
    rotation = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return se3.from_parts(rotation, np.array([0.1, 0, 0.2]))


def test_odometry_moved_to_the_optical_frame(tmp_path: Path) -> None:
    log, poses = depth_log(some_images(4)), some_poses(4)
    base_from_link = se3.from_parts(np.eye(3), np.array([0.0, 0.0, 0.3]))
    links = [(0.0, "link", OPTICAL, camera_on_body()), (0.0, "base_link", "link", base_from_link)]
    log.add("/tf_static", "tf2_msgs/msg/TFMessage", transforms(*links), CDR)
    for row, pose in enumerate(poses):
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(100.05 + row / 10, pose), CDR)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    base_from_cam = base_from_link @ camera_on_body()
    assert source.frames[0].world_from_cam is None, "before the first odometry"
    for row in (1, 2, 3):
        world_from_base = se3.interpolate(poses[row - 1], poses[row], np.array(0.5))
        np.testing.assert_allclose(source.frames[row].world_from_cam, world_from_base @ base_from_cam, atol=1e-6)
    np.testing.assert_allclose(source.trajectory.world_from_cam, poses @ base_from_cam, atol=1e-9)
    assert "1 of 4 frames have no pose within 0.2 s of their stamp" in source.notes


def test_odometry_on_another_clock_is_asked_about(tmp_path: Path) -> None:
    log = depth_log(some_images(2))
    for row, pose in enumerate(some_poses(4)):
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(7300 + row / 10, pose, child=OPTICAL), CDR)
    notes = McapReader().open(log.write(tmp_path / "log.mcap")).notes
    assert "2 of 2 frames have no pose within 0.2 s of their stamp: are they on another clock?" in notes


@pytest.mark.parametrize("mounts", [(), ((100, "camera_link", OPTICAL, np.eye(4)),)])
def test_transforms_that_nothing_links_to_the_camera_ask_for_the_static_ones(tmp_path: Path, mounts) -> None:
    log = depth_log(some_images(2))
    log.add("/tf_static", "tf2_msgs/msg/TFMessage", transforms(*mounts), CDR)
    for row, pose in enumerate(some_poses(2)):
        log.add("/tf", "tf2_msgs/msg/TFMessage", transforms((100 + row / 10, "odom", "base_link", pose)), CDR)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert all(frame.world_from_cam is None for frame in source.frames)
    told = f"no poses: no transform leads from base_link to {OPTICAL}, the camera's frame: record /tf_static too"
    assert told in source.notes


def test_odometry_of_a_body_that_nothing_links_to_the_camera(tmp_path: Path) -> None:
    log = depth_log(some_images(2))
    for row, pose in enumerate(some_poses(2)):
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(100 + row / 10, pose), CDR)
    path = log.write(tmp_path / "log.mcap")
    source = check_reader(McapReader(), path)
    assert all(frame.world_from_cam is None for frame in source.frames) and len(source.trajectory) == 2
    assert any("no transform leads from base_link of /odom to cam_optical" in note for note in source.notes)
    assert not any("of their stamp" in note for note in source.notes), "stamps are not what is wrong"
    told = check_reader(McapReader(pose_child=OPTICAL), path)
    np.testing.assert_allclose(told.frames[1].world_from_cam, some_poses(2)[1], atol=1e-9)


def test_of_two_robots_the_one_that_carries_the_camera_gives_the_poses(tmp_path: Path) -> None:
    log, poses = depth_log(some_images(2)), some_poses(4)
    log.add("/tf_static", "tf2_msgs/msg/TFMessage", transforms((0.0, "b/base_link", OPTICAL, np.eye(4))), CDR)
    for row, pose in enumerate(poses):
        name, at = ("b", row - 2) if row >= 2 else ("a", row)
        message = odometry(100 + at / 10, pose, child=f"{name}/base_link")
        log.add(f"/{name}/odom", "nav_msgs/msg/Odometry", message, CDR)
    source = McapReader().open(log.write(tmp_path / "log.mcap"))
    np.testing.assert_allclose([frame.world_from_cam for frame in source.frames], poses[2:], atol=1e-9)
    assert "poses of /b/odom taken, not of /a/odom: see option pose_topic" in source.notes


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_bare_poses_are_of_the_camera(tmp_path: Path, encoding: str) -> None:
    log, poses = depth_log(some_images(3), encoding=encoding), some_poses(3)
    for row, pose in enumerate(poses):
        head = foxglove_header(100 + row / 10, "map")
        log.add("/pose", "foxglove.PoseInFrame", {**head, "pose": pose_message(pose)}, encoding)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    for frame, pose in zip(source.frames, poses, strict=True):
        np.testing.assert_allclose(frame.world_from_cam, pose, atol=1e-9)
    assert any("taken as poses of the camera itself" in note for note in source.notes)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_transforms_in_time_are_interpolated_along_the_chain(tmp_path: Path, encoding: str) -> None:
    log, poses = depth_log(some_images(3), encoding=encoding), some_poses(4, seed=1)
    links = [(99.95 + row / 10, "odom", "base", pose) for row, pose in enumerate(poses)]
    map_from_odom = some_poses(1, seed=2)[0]
    fixed = [(5.0, "base", OPTICAL, camera_on_body()), (5.0, "map", "odom", map_from_odom)]
    if encoding == CDR:
        log.add("/tf_static", "tf2_msgs/msg/TFMessage", transforms(*fixed), CDR)
        for link in links:
            log.add("/tf", "tf2_msgs/msg/TFMessage", transforms(link), CDR)
    else:
        for seconds, parent, child, pose in [*links, *fixed]:
            head = foxglove_header(seconds, "")
            names = {"timestamp": head["timestamp"], "parent_frame_id": parent, "child_frame_id": child}
            motion = pose_message(pose)
            parts = {"translation": motion["position"], "rotation": motion["orientation"]}
            if encoding == PROTOBUF:
                log.add("/tf", "foxglove.FrameTransform", {**names, **parts}, encoding)
            else:
                log.add("/tf", "foxglove.FrameTransforms", {"transforms": [{**names, **parts}]}, encoding)
    path = log.write(tmp_path / "log.mcap")
    in_map = check_reader(McapReader(), path)
    in_odom = check_reader(McapReader(world_frame="odom"), path)
    for row in range(3):
        odom_from_base = se3.interpolate(poses[row], poses[row + 1], np.array(0.5))
        expected = odom_from_base @ camera_on_body()
        np.testing.assert_allclose(in_odom.frames[row].world_from_cam, expected, atol=1e-6)
        np.testing.assert_allclose(in_map.frames[row].world_from_cam, map_from_odom @ expected, atol=1e-6)
    assert len(in_map.trajectory) == 4
    assert "poses of cam_optical in map from the transforms" in in_map.notes


def test_of_transforms_alone_the_frames_that_move_are_named(tmp_path: Path) -> None:
    log, poses = Log(), some_poses(2, seed=1)
    fixed = (5.0, "map", "dock", poses[0])
    log.add(
        "/tf", "tf2_msgs/msg/TFMessage", transforms(fixed, *((row, "map", "base", poses[row]) for row in (0, 1))), CDR
    )
    path = log.write(tmp_path / "log.mcap")
    with pytest.raises(SourceError, match="transforms move base: name one for its poses, --set .*pose_child=base$"):
        McapReader().open(path)
    trajectory = McapReader(pose_child="base").open(path).trajectory
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.world_from_cam, poses, atol=1e-9)


def test_odometry_of_a_real_robot(data_dir: Path) -> None:
    source = check_reader(McapReader(), data_dir / "mcap/evo_nav2_turtlebot/nav2_turtlebot.mcap")
    assert len(source.trajectory) == 2639 and not source.frames
    assert "poses of /odom taken, not of /amcl_pose: see option pose_topic" in source.notes
    assert any("the log's clock differs" in note for note in source.notes)
    amcl = McapReader(pose_topic="/amcl_pose").open(data_dir / "mcap/evo_nav2_turtlebot/nav2_turtlebot.mcap")
    # The localised and the dead-reckoned path of one robot are the same curve but for drift.
    lengths = [
        np.linalg.norm(np.diff(s.trajectory.world_from_cam[:, :3, 3], axis=0), axis=1).sum() for s in (source, amcl)
    ]
    assert len(amcl.trajectory) == 135 and abs(lengths[1] / lengths[0] - 1) < 0.2


def test_ros_headers(tmp_path: Path) -> None:
    log = depth_log(some_images(1))
    image = {"header": ros_header(100, "/" + OPTICAL), **raw_image(np.full((HEIGHT, WIDTH, 3), 9, np.uint8), "rgb8")}
    log.add(COLOUR, "sensor_msgs/msg/Image", image, CDR)
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert (source.frames[0].read_colour() == 9).all(), "a leading slash of a frame is the same frame"
    assert not any("colour is off" in note for note in source.notes)


def test_topics_and_transforms_are_listed_with_counts_and_rates(tmp_path: Path) -> None:
    """Those that are not taken too: ten messages of a type that no frame is made of, five a second."""
    log = Log()
    poses = some_poses(4)
    for number in range(10):
        log.add("/chatter", "foxglove.PackedElementField", {"name": "x"}, "json", number * SECOND // 5)
    for number, pose in enumerate(poses):
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(1.0 + number, pose), "cdr", number * SECOND)
    log.add("/tf", "tf2_msgs/msg/TFMessage", transforms((1.0, "map", "odom", poses[0])), "cdr", SECOND)
    contents = McapReader().open(log.write(tmp_path / "log.mcap")).contents
    assert contents == (
        "/chatter (foxglove.PackedElementField): 10 messages, 5 a second",
        "/odom (nav_msgs/msg/Odometry): 4 messages, 1 a second",
        "/tf (tf2_msgs/msg/TFMessage): 1 message",
        "tf map -> odom: 1 pose",
    )
    assert inspect(tmp_path / "log.mcap")["contents"] == list(contents)


def test_a_bad_transform_is_left_out_alone(tmp_path: Path) -> None:
    log, poses = depth_log(some_images(2)), some_poses(2)
    for row, pose in enumerate(poses):
        both = transforms((100 + row / 10, "map", "bad", pose), (100 + row / 10, "map", OPTICAL, pose))
        both["transforms"][0]["transform"]["rotation"] = dict.fromkeys("xyzw", 0.0)
        log.add("/tf", "tf2_msgs/msg/TFMessage", both, CDR)
    source = McapReader().open(log.write(tmp_path / "log.mcap"))
    np.testing.assert_allclose([frame.world_from_cam for frame in source.frames], poses, atol=1e-9)
    assert "/tf: 2 left out: a transform with a pose that is no rigid motion" in source.notes


def test_poses_out_of_order_and_with_one_stamp_are_told(tmp_path: Path) -> None:
    log, poses = Log(), some_poses(5)
    for stamp, pose in zip((100, 101, 101, 50, 102), poses, strict=True):
        log.add("/odom", "nav_msgs/msg/Odometry", odometry(stamp, pose), CDR)
    source = McapReader().open(log.write(tmp_path / "log.mcap"))
    np.testing.assert_allclose(source.trajectory.world_from_cam, poses[[3, 0, 1, 4]], atol=1e-9)
    assert "/odom: 1 pose with the stamp of an earlier one left out" in source.notes
    assert "/odom: poses were not in order of time: sorted" in source.notes


@pytest.mark.parametrize("again", [0, 1])
def test_of_static_transforms_the_last_one_sent_holds(tmp_path: Path, again: int) -> None:
    log, poses = depth_log(some_images(2)), some_poses(4)
    for stamp, link in ((200, poses[2]), (50, poses[2 + again])):
        log.add("/tf_static", "tf2_msgs/msg/TFMessage", transforms((stamp, "base", OPTICAL, link)), CDR)
    for row, pose in enumerate(poses[:2]):
        log.add("/tf", "tf2_msgs/msg/TFMessage", transforms((100 + row / 10, "map", "base", pose)), CDR)
    source = McapReader().open(log.write(tmp_path / "log.mcap"))
    expected = poses[:2] @ poses[2 + again]
    np.testing.assert_allclose([frame.world_from_cam for frame in source.frames], expected, atol=1e-9)
    assert ("1 static transform replaced by a later, other one" in source.notes) == bool(again)

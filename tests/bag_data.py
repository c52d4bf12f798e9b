"""The messages of a recording as ROS 2 SQLite bags and ROS 1 bags, by the writers of `rosbags`."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from mcap_data import Log

rosbag1 = pytest.importorskip("rosbags.rosbag1")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

LEFT_OUT = {"nav_msgs/msg/Odometry": 336, "sensor_msgs/msg/CameraInfo": 21}
"""Bytes of the last fields, all zero, that the shorter definitions of `mcap_encoding` leave out."""


def _whole(schema: str, data: bytes) -> bytes:
    return data + bytes(LEFT_OUT.get(schema, 0))


def write_db3(log: Log, folder: Path, *, definitions: bool = True) -> Path:
    """A bag folder with one `.db3`; without `definitions` as ROS 2 before Iron wrote it."""
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        known: dict[str, object] = {}
        for topic, schema, _, log_ns, data in log.messages:
            if topic not in known:
                known[topic] = writer.add_connection(topic, schema, typestore=store)
            writer.write(known[topic], log_ns, _whole(schema, data))
    if not definitions:
        with closing(sqlite3.connect(next(folder.glob("*.db3")))) as database:
            database.execute("DROP TABLE message_definitions")
            database.commit()
    return folder


def write_bag(log: Log, path: Path, compression: str = "") -> Path:
    """A ROS 1 bag; `compression` BZ2 or LZ4."""
    store, ros2 = (typesys.get_typestore(one) for one in (typesys.Stores.ROS1_NOETIC, typesys.Stores.ROS2_HUMBLE))
    name = "tf2_msgs/msg/TFMessage"
    store.register(typesys.get_types_from_msg("geometry_msgs/TransformStamped[] transforms", name))
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = rosbag1.Writer(path)
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        known: dict[str, object] = {}
        for topic, schema, _, log_ns, data in log.messages:
            if topic not in known:
                known[topic] = writer.add_connection(topic, schema, typestore=store)
            writer.write(known[topic], log_ns, bytes(ros2.cdr_to_ros1(_whole(schema, data), schema)))
    return path


WRITERS: dict[str, Callable[[Log, Path], Path]] = {
    "db3": lambda log, folder: write_db3(log, folder / "bag"),
    "db3 before Iron": lambda log, folder: write_db3(log, folder / "bag", definitions=False),
    "bag": lambda log, folder: write_bag(log, folder / "a.bag"),
    "bag bz2": lambda log, folder: write_bag(log, folder / "a.bag", "BZ2"),
    "bag lz4": lambda log, folder: write_bag(log, folder / "a.bag", "LZ4"),
}

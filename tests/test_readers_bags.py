"""ROS 2 SQLite bags and ROS 1 bags: what an MCAP file of the same messages gives, damaged ones told."""

from __future__ import annotations

import bz2
import sqlite3
import struct
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from bag_data import WRITERS, rosbag1, typesys, write_bag, write_db3
from hodge_adapters.mcap import ros1_bag
from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.mcap.ros_definitions import TYPES, definition
from hodge_adapters.mcap.writer import McapWriter
from hodge_pipeline import se3
from hodge_pipeline.cli.convert import convert
from hodge_pipeline.errors import SourceError
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.sources.opening import guess_reader
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Frame, PointCloud, Source
from mcap_scene import everything
from synthetic import tiny_sequence  # noqa: F401 - a fixture


@pytest.mark.parametrize("options", [{"frames": "depth", "depth_topic": "/raw"}, {"frames": "points"}])
@pytest.mark.parametrize("kind", WRITERS)
def test_a_bag_gives_what_an_mcap_file_gives(tmp_path: Path, kind: str, options: dict[str, str]) -> None:
    log = everything()
    reader = McapReader(**options)  # type: ignore[arg-type]
    wanted = reader.open(log.write(tmp_path / "a.mcap"))
    path = WRITERS[kind](log, tmp_path / "bags")
    assert isinstance(guess_reader(path), McapReader)
    found = check_reader(reader, path)
    assert [line.replace("_msgs/msg/", "_msgs/") for line in wanted.contents] == [
        line.replace("_msgs/msg/", "_msgs/") for line in found.contents
    ]
    assert len(found.frames) == 3
    assert [note for note in found.notes if "finished" not in note] == list(wanted.notes)
    for one, other in zip(found.frames, wanted.frames, strict=True):
        assert one.stamp_s == other.stamp_s and one.camera == other.camera
        assert one.world_from_cam == pytest.approx(other.world_from_cam)
        for name in ("read_depth", "read_colour"):
            read, expected = getattr(one, name), getattr(other, name)
            assert (read is None) == (expected is None)
            assert read is None or np.array_equal(read(), expected())
        if one.read_points is not None and other.read_points is not None:
            assert np.array_equal(one.read_points().points_in_cam, other.read_points().points_in_cam)


@pytest.mark.parametrize("name", TYPES)
def test_definitions_are_the_standard_ones(name: str) -> None:
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    full = name.replace("/", "/msg/")
    ours, _ = store.generate_msgdef(full, ros_version=2)
    known = typesys.get_types_from_msg(definition(full), full)
    theirs = typesys.get_types_from_msg(ours, full)
    assert {one: fields[1] for one, fields in known.items()} == {one: theirs[one][1] for one in known}


def test_a_bag_that_breaks_off_gives_what_there_is(tmp_path: Path) -> None:
    whole = write_bag(everything(count=40), tmp_path / "a.bag")
    contents = whole.read_bytes()
    cut = tmp_path / "cut.bag"
    cut.write_bytes(contents[: len(contents) // 2])
    found = McapReader(frames="points").open(cut)
    assert 3 < len(found.frames) < 40
    assert any("cut off at byte" in note for note in found.notes)


@pytest.mark.parametrize(
    ("old", "new", "note"),
    [
        (b"compression=bz2", b"compression=bz3", "only bz2, lz4 and none are known"),
        (b"size=", struct.pack("<I", 0xFFFFFFF0), "may expand to"),
    ],
)
def test_a_chunk_that_lies_is_left_out(tmp_path: Path, old: bytes, new: bytes, note: str) -> None:
    path = write_bag(everything(), tmp_path / "a.bag", "BZ2")
    contents = path.read_bytes()
    at = contents.index(old)
    at += 0 if len(old) == len(new) else len(old)
    path.write_bytes(contents[:at] + new + contents[at + len(new) :])
    with pytest.raises(SourceError, match=note):
        McapReader().open(path)


def bag_record(data: bytes, **header: bytes) -> bytes:
    fields = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value for name, value in header.items()
    )
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(data)) + data


def test_zeroed_bytes_and_chunks_in_chunks_end_a_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record, read = ros1_bag._record, list[int]()
    monkeypatch.setattr(ros1_bag, "_record", lambda *given: (read.append(1), record(*given))[1])
    deep = b""
    for _ in range(2000):
        deep = bag_record(deep, op=b"\5", compression=b"none")
    zeros = bag_record(bz2.compress(bytes(1 << 24)), op=b"\5", compression=b"bz2", size=struct.pack("<I", 1 << 24))
    for contents in (deep, zeros):
        path = tmp_path / "a.bag"
        path.write_bytes(b"#ROSBAG V2.0\n" + contents)
        with pytest.raises(SourceError, match="holds no message"):
            McapReader().open(path)
    assert len(read) < 10, "of two million empty records, or two thousand levels"


def test_a_definition_in_a_bag_executes_nothing(tmp_path: Path) -> None:
    evil = f"string data\nuint8 X=__import__('pathlib').Path({str(tmp_path / 'done')!r}).touch()\n"
    store = typesys.get_typestore(typesys.Stores.ROS1_NOETIC)
    path = write_bag(everything(), tmp_path / "a.bag")
    with rosbag1.Writer(tmp_path / "b.bag") as writer:
        writer.add_connection("/evil", "sensor_msgs/msg/Image", msgdef=evil, md5sum="0" * 32, typestore=store)
    folder = write_db3(everything(), tmp_path / "bag")
    with closing(sqlite3.connect(next(folder.glob("*.db3")))) as database:
        database.execute("UPDATE message_definitions SET encoded_message_definition = ?", (evil,))
        database.commit()
    for one in (path, tmp_path / "b.bag", folder):
        try:
            McapReader().open(one)
        except SourceError as error:
            assert "\n" not in str(error)
    assert not (tmp_path / "done").exists()


@pytest.mark.parametrize(
    "hostile",
    [
        "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE n(id) AS "
        "(SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n",
        "UPDATE messages SET data = 5, timestamp = 'soon'",
        "UPDATE topics SET name = x'ff', type = 7",
        "DROP TABLE topics",
    ],
)
def test_a_hostile_database_is_told(tmp_path: Path, hostile: str) -> None:
    folder = write_db3(everything(), tmp_path / "bag")
    with closing(sqlite3.connect(next(folder.glob("*.db3")))) as database:
        database.executescript(hostile)
    with pytest.raises(SourceError) as refused:
        McapReader().open(folder)
    assert "\n" not in str(refused.value)


def test_messages_beside_the_database_are_told(tmp_path: Path) -> None:
    folder = write_db3(everything(), tmp_path / "bag")
    database = next(folder.glob("*.db3"))
    Path(f"{database}-wal").write_bytes(b"x" * 100)
    assert any("-wal: messages in it left out" in note for note in McapReader(frames="points").open(folder).notes)


def read_back(path: Path) -> dict[str, list[object]]:
    """The messages of an MCAP file by topic, decoded by another library's standard definitions."""
    from mcap.reader import make_reader

    store, found = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), dict[str, list[object]]()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None and schema.encoding == "ros2msg" and channel.message_encoding == "cdr"
            found.setdefault(channel.topic, []).append(store.deserialize_cdr(message.data, schema.name))
    return found


def posed(tmp_path: Path) -> Source:
    rng = np.random.default_rng(0)
    clouds = [rng.normal(size=(row, 3)).astype(np.float32) for row in (5, 0, 3)]
    poses = se3.exp(rng.normal(size=(3, 6)))
    frames = tuple(
        Frame(row, 1.6e9 + row / 7, read_points=partial(PointCloud, cloud, None, (cloud * 9).astype(np.uint8)),
              world_from_cam=pose)
        for row, (cloud, pose) in enumerate(zip(clouds, poses, strict=True))
    )  # fmt: skip
    return Source("a", tmp_path, frames)


def test_an_mcap_file_is_read_by_others(tmp_path: Path) -> None:
    source, path = posed(tmp_path), tmp_path / "a.mcap"
    McapWriter().write(path, source)
    found = read_back(path)
    for frame, moved, cloud in zip(source.frames, found["/tf"], found["/points"], strict=True):
        (one,) = moved.transforms  # type: ignore[attr-defined]
        pose = one.transform
        moved_by, turned_by = pose.translation, pose.rotation
        place, turn = [getattr(moved_by, axis) for axis in "xyz"], [getattr(turned_by, axis) for axis in "xyzw"]
        assert np.allclose(se3.from_quat_xyzw(np.array(place), np.array(turn)), frame.world_from_cam, atol=1e-12)
        stamp = one.header.stamp
        assert stamp.sec + stamp.nanosec * 1e-9 == pytest.approx(frame.stamp_s, abs=1e-6)
        assert (one.header.frame_id, one.child_frame_id, cloud.header.frame_id) == ("map", "camera", "camera")  # type: ignore[attr-defined]
        assert frame.read_points is not None
        points = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)[:, :3]  # type: ignore[attr-defined]
        assert np.array_equal(points, frame.read_points().points_in_cam) and cloud.is_dense  # type: ignore[attr-defined]


def test_an_mcap_file_is_read_by_mcap_ros2_support(tmp_path: Path) -> None:
    decoder = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    from mcap.reader import make_reader

    McapWriter().write(tmp_path / "a.mcap", posed(tmp_path))
    with (tmp_path / "a.mcap").open("rb") as file:
        messages = [message for *_, message in make_reader(file, decoder_factories=[decoder]).iter_decoded_messages()]
    assert sum(hasattr(message, "transforms") for message in messages) == 3
    assert sorted(message.width for message in messages if hasattr(message, "width")) == [0, 3, 5]


def test_times_of_points_come_back_from_an_mcap_file(tmp_path: Path) -> None:
    cloud = PointCloud(np.ones((5, 3), np.float32), times_s=np.linspace(0, 0.1, 5, dtype=np.float32), first_s=1.6e9)
    frame = Frame(0, 1.6e9, read_points=lambda: cloud, world_from_cam=np.eye(4))
    McapWriter().write(tmp_path / "a.mcap", Source("a", tmp_path, (frame,)))
    read = McapReader().open(tmp_path / "a.mcap").frames[0].read_points
    assert read is not None and read().times_s == pytest.approx(cloud.times_s, abs=1e-6)
    assert read().first_s == pytest.approx(1.6e9, abs=1e-6)


def test_an_mcap_file_comes_back(tmp_path: Path) -> None:
    source = posed(tmp_path)
    McapWriter().write(tmp_path / "a.mcap", source)
    back = McapReader().open(tmp_path / "a.mcap")
    assert len(back.frames) == 3
    for one, other in zip(back.frames, source.frames, strict=True):
        assert one.world_from_cam == pytest.approx(other.world_from_cam, abs=1e-6)
        assert one.read_points is not None and other.read_points is not None
        again, first = one.read_points(), other.read_points()
        assert np.array_equal(again.points_in_cam, first.points_in_cam)
        assert not len(first) or np.array_equal(again.colours, first.colours)  # type: ignore[arg-type]


def test_a_run_becomes_an_mcap_file(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    options = ("clouds.voxel_m=0.1", "executor.workers=0", "recording.level=off", "fusion=[]", "start.whole_up_to=1")
    run = hodge_pipeline.run(load_recipe("demo", options, tiny_sequence), tmp_path / "run")
    convert(tmp_path / "run", tmp_path / "a.mcap")
    found = read_back(tmp_path / "a.mcap")
    assert len(found["/tf"]) == len(run.poses)
    assert [cloud.width for cloud in found["/points"]] == [len(cloud) for cloud in run.clouds]  # type: ignore[attr-defined]

from __future__ import annotations

import pickle
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType

from hodge_adapters.mcap.reader import McapReader
from hodge_pipeline.errors import SourceError
from hodge_pipeline.testing import check_reader
from mcap_data import (
    CALIBRATION,
    DEPTH,
    INFO,
    OPTICAL,
    RAW,
    Log,
    calibration,
    depth_log,
    foxglove_header,
    some_images,
    write_depth_log,
)
from mcap_encoding import CDR, PROTOBUF
from readers_data import HEIGHT, WIDTH, depth_values
from synthetic import tiny_sequence  # noqa: F401


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunk_size": 1},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False, "index_types": IndexType.NONE, "use_statistics": False},
        {"enable_crcs": False},
    ],
    ids=["default", "chunk for each message", "no chunks", "no index", "no summary", "no checksums"],
)
def test_every_kind_of_file(tmp_path: Path, compression: CompressionType, options: dict[str, Any]) -> None:
    path = write_depth_log(tmp_path / "log.mcap", some_images(), compression=compression, **options)
    source = check_reader(McapReader(), path)
    for row, frame in enumerate(source.frames):
        assert np.array_equal(frame.read_depth(), depth_values(row).astype(np.float32) * np.float32(1e-3))
    assert len(source.frames) == 3
    assert not any("left out" in note or "cut off" in note for note in source.notes)


def split_bag(folder: Path) -> list[bytes]:
    """Three files of one frame each, the transforms of all in the first."""
    for row in range(3):
        log = Log()
        if row == 0:
            log.add(
                INFO, CALIBRATION, {**foxglove_header(100, OPTICAL), **calibration(WIDTH, HEIGHT, 10, 11, 4, 3)}, CDR
            )
        log.add(DEPTH, RAW, {**foxglove_header(100 + row, OPTICAL), **some_images(3)[row]}, CDR)
        log.write(folder / f"bag_{row}.mcap")
    return [file.read_bytes() for file in sorted(folder.glob("*.mcap"))]


def metadata(*names: str) -> str:
    files = "".join(f"  - {name}\n" for name in names)
    return f"rosbag2_bagfile_information:\n  storage_identifier: mcap\n  relative_file_paths:\n{files}"


def test_a_split_bag(tmp_path: Path) -> None:
    split_bag(tmp_path)
    plain = check_reader(McapReader(), tmp_path)
    assert [frame.stamp_s for frame in plain.frames] == [100.0, 101.0, 102.0] and len(plain.files) == 3
    (tmp_path / "metadata.yaml").write_text(metadata("bag_0.mcap", "bag_2.mcap", "bag_9.mcap", "../../etc/passwd"))
    source = check_reader(McapReader(), tmp_path)
    assert len(source.frames) == 3 and tmp_path / "metadata.yaml" in source.files
    assert "metadata.yaml: 1 file not there left out: bag_9.mcap" in source.notes
    assert "metadata.yaml: 1 file outside of the folder left out" in source.notes
    assert "1 file that metadata.yaml does not list read as well: bag_1.mcap" in source.notes
    (tmp_path / "metadata.yaml").write_text("{broken: [")
    assert any("metadata.yaml cannot be read" in note for note in check_reader(McapReader(), tmp_path).notes)


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_an_empty_file_costs_a_split_bag_nothing_else(tmp_path: Path, suffix: str) -> None:
    """A recorder that is killed leaves its last file so."""
    split_bag(tmp_path)
    (tmp_path / f"bag_9{suffix}").touch()
    (tmp_path / "metadata.yaml").write_text(metadata("bag_0.mcap", "bag_1.mcap", "bag_2.mcap", f"bag_9{suffix}"))
    source = check_reader(McapReader(), tmp_path)
    assert len(source.frames) == 3 and f"bag_9{suffix}: the file is empty" in source.notes
    assert [note.kind for note in source.doubts] == ["recording incomplete"]


@pytest.mark.parametrize(
    ("files", "remedy"),
    [
        ({}, "give the folder"),
        ({"bag_0.mcap.zstd": b""}, r"unpack bag_0\.mcap\.zstd first"),
        ({"bag_0.db3": b"SQLite"}, "not a whole SQLite bag"),
        ({"metadata.yaml": metadata("bag_0.mcap").encode()}, "lists no .mcap or .db3 file that is there"),
        ({"a.mcap": b""}, "does not start as an MCAP file"),
        ({"a.bag": b"#ROSBAG V1.2\n"}, "does not start as a ROS 1 bag"),
    ],
)
def test_what_is_no_recording(tmp_path: Path, files: dict[str, bytes], remedy: str) -> None:
    for name, contents in files.items():
        (tmp_path / name).write_bytes(contents)
    with pytest.raises(SourceError, match=remedy) as raised:
        McapReader().open(tmp_path)
    assert str(tmp_path) in str(raised.value) and "\n" not in str(raised.value)


def test_packets_of_a_scanner_name_what_to_record(tmp_path: Path) -> None:
    log = Log()
    log.add_bytes("/packets", "velodyne_msgs/msg/VelodyneScan", CDR, b"\0\1\0\0\5\0\0\0text\0")
    with pytest.raises(SourceError, match=r"/packets \(velodyne_msgs/msg/VelodyneScan\): .* PointCloud2$"):
        McapReader().open(log.write(tmp_path / "log.mcap"))


def test_a_recording_of_other_things_names_its_topics(tmp_path: Path) -> None:
    log = Log()
    log.add_bytes("/chatter", "std_msgs/msg/String", CDR, b"\0\1\0\0\5\0\0\0text\0")
    with pytest.raises(SourceError, match=r"no depth, clouds, images or poses in /chatter \(std_msgs/msg/String\)"):
        McapReader().open(log.write(tmp_path / "log.mcap"))


def test_schemas_that_are_not_read_are_named(tmp_path: Path) -> None:
    log = depth_log(some_images(1))
    log.add_bytes("/idl", "sensor_msgs/msg/Image", "cbor", b"")
    source = check_reader(McapReader(), log.write(tmp_path / "log.mcap"))
    assert any(note.startswith("/idl: left out: cbor messages") for note in source.notes)


def test_a_pickled_frame_is_small_and_needs_no_schema(tmp_path: Path) -> None:
    path = write_depth_log(tmp_path / "log.mcap", some_images(1), encoding=PROTOBUF)
    frame = McapReader().open(path).frames[0]
    assert len(pickle.dumps(frame)) < 2000


def test_a_file_that_changed_after_it_was_opened(tmp_path: Path) -> None:
    path = write_depth_log(tmp_path / "log.mcap", some_images(2))
    frame = McapReader().open(path).frames[1]
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(SourceError, match=r"log\.mcap: /cam/depth/image at 100\.1"):
        frame.read_depth()
    path.unlink()
    with pytest.raises(SourceError, match=r"log\.mcap: cannot be read"):
        frame.read_depth()


def test_the_start_of_a_real_bag_of_point_clouds(data_dir: Path, tmp_path: Path) -> None:
    archive = data_dir / "mcap/pointcloud_transport_tutorial/rosbag2_2023_08_05-16_08_51.tar.xz"
    with tarfile.open(archive, "r|xz") as packed:
        member = next(member for member in packed if member.name.endswith(".mcap"))
        (tmp_path / "bag.mcap").write_bytes(packed.extractfile(member).read(8 << 20))
    source = check_reader(McapReader(), tmp_path / "bag.mcap")
    assert len(source.frames) == 12 and 202 < source.frames[0].stamp_s < 221
    cloud = source.frames[0].read_points()
    assert 31376 <= len(cloud) <= 42772 and cloud.points_in_cam[:, 2].min() > 0.1, "the camera looks along z"
    assert any(note.startswith("bag.mcap: cut off: whole records up to byte ") for note in source.notes)


def test_real_foxglove_images(data_dir: Path) -> None:
    source = check_reader(McapReader(), data_dir / "mcap/small_misc/custom-camera-model.mcap")
    assert len(source.frames) == 10 and source.frames[0].read_colour().shape == (360, 520, 3)
    assert any("'CylinderCameraModel' is no pinhole camera" in note for note in source.notes)
    assert any("log time is taken" in note for note in source.notes)


@pytest.mark.parametrize(
    "name",
    ["rosbag2_tests/wbag", "rosbag2_tests/talker", "rosbag2_tests/convert_a", "rosbag2_tests/convert_b",
     "rosbag2_tests/reindex_test_bags/multiple_files", "small_misc/example.mcap", "small_misc/example_logs.mcap"],
)  # fmt: skip
def test_real_bags_without_frames_or_poses(data_dir: Path, name: str) -> None:
    assert McapReader().sniff(data_dir / "mcap" / name).confidence >= 0.7
    with pytest.raises(SourceError, match="no depth, clouds, images or poses in"):
        McapReader().open(data_dir / "mcap" / name)

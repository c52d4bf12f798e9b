"""Recordings that are cut, damaged or lie: read as far as they go, or refused in one line; never more memory than said.

`HODGE_MCAP_CASES` sets how many random damages are tried (144).
"""

from __future__ import annotations

import os
import struct
import tracemalloc
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType

from hodge_adapters.mcap import records as mcap_records
from hodge_adapters.mcap.reader import McapReader
from hodge_adapters.mcap.records import MAGIC
from hodge_pipeline.errors import SourceError
from mcap_data import (
    Log,
    calibration,
    raw_image,
    read_all,
    resident_peak,
    ros_header,
)
from mcap_encoding import CDR, JSON, PROTOBUF
from mcap_scene import everything
from readers_data import HEIGHT, WIDTH, depth_values

CASES = int(os.environ.get("HODGE_MCAP_CASES", "144"))
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"


def try_all(path: Path) -> None:
    """Open and read by every topic; only `SourceError` in one line may come of it."""
    for reader in (McapReader(), McapReader(depth_topic="/rvl"), McapReader(frames="points")):
        try:
            read_all(reader.open(path))
        except SourceError as error:
            assert "\n" not in str(error) and str(path) in str(error) or "option" in str(error)


def damaged(contents: bytes, seed: int) -> bytes:
    """The same file with one random damage: bits flipped, cut, bytes removed or put in, a number made huge."""
    rng = np.random.default_rng(seed)
    out, at = bytearray(contents), int(rng.integers(len(contents)))
    kind = seed % 6
    if kind == 0:
        out[at] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        for place in rng.integers(len(out), size=20):
            out[place] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        del out[at:]
    elif kind == 3:
        del out[at : at + int(rng.integers(1, 40))]
    elif kind == 4:
        out[at : at + 4] = b"\xff\xff\xff\x7f"
    else:
        out[at:at] = rng.bytes(int(rng.integers(1, 40)))
    return bytes(out)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    """Without checksums, so that damage comes through to what they would protect."""
    folder = tmp_path_factory.mktemp("damage")
    ways = [
        (CDR, CompressionType.NONE, {}),
        (CDR, CompressionType.NONE, {"use_chunking": False}),
        (PROTOBUF, CompressionType.NONE, {"chunk_size": 1000}),
        (JSON, CompressionType.NONE, {"chunk_size": 1000}),
        (CDR, CompressionType.ZSTD, {"chunk_size": 4000}),
        (CDR, CompressionType.LZ4, {"chunk_size": 4000}),
    ]
    paths = [
        everything(encoding).write(folder / f"{n}.mcap", compression, enable_crcs=False, **options)
        for n, (encoding, compression, options) in enumerate(ways)
    ]
    return [path.read_bytes() for path in paths]


def test_random_damage_never_gets_out(recordings: list[bytes], tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    before = resident_peak()
    for seed in range(CASES):
        path.write_bytes(damaged(recordings[seed // 6 % len(recordings)], seed))
        try_all(path)
    assert resident_peak() - before < 100e6


def record_ends(contents: bytes) -> Iterator[tuple[int, int]]:
    """(opcode, end) of each record at the top of a file."""
    at = len(MAGIC)
    while at + 9 <= len(contents) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", contents, at)
        at += 9 + length
        yield opcode, at


@pytest.mark.parametrize("compression", list(CompressionType))
def test_cut_at_every_record(tmp_path: Path, compression: CompressionType) -> None:
    log = Log()
    log.add("/info", "foxglove.CameraCalibration", calibration(WIDTH, HEIGHT, 9, 9, 4, 3), CDR)
    for row in range(5):
        message = {"header": ros_header(100 + row, "cam"), **raw_image(depth_values(row), "16UC1")}
        log.add("/raw", IMAGE, message, CDR)
    contents = log.write(tmp_path / "whole.mcap", compression, chunk_size=1).read_bytes()
    path, chunks, has_all = tmp_path / "cut.mcap", 0, False
    for opcode, end in record_ends(contents):
        chunks, has_all = chunks + (opcode == Opcode.CHUNK), has_all or opcode == Opcode.DATA_END
        path.write_bytes(contents[:end])
        if chunks < 2:
            with pytest.raises(SourceError, match="no depth, clouds, images or poses|holds no message"):
                McapReader().open(path)
            continue
        source = McapReader().open(path)
        assert len(source.frames) == chunks - 1 and not read_all(source)
        unfinished = f"cut.mcap: not finished by its recorder: all {end} bytes were read"
        assert (unfinished in source.notes) != has_all, "all data is there once its end is"
        path.write_bytes(contents[: end + 5])
        cut_off = f"cut.mcap: cut off: whole records up to byte {end} of {end + 5} were read, with"
        assert any(note.startswith(cut_off) for note in McapReader().open(path).notes) != has_all


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_chunk_that_is_cut_is_read_as_far_as_it_goes(tmp_path: Path, compression: CompressionType) -> None:
    rng = np.random.default_rng(0)
    log = Log()
    log.add("/info", "foxglove.CameraCalibration", calibration(160, 120, 9, 9, 4, 3), CDR)
    images = [rng.integers(1, 60000, (120, 160)).astype(np.uint16) for _ in range(8)]
    for row, image in enumerate(images):
        log.add("/raw", IMAGE, {"header": ros_header(100 + row, "cam"), **raw_image(image, "16UC1")}, CDR)
    contents = log.write(tmp_path / "whole.mcap", compression, chunk_size=1 << 30).read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(contents[: len(contents) * 2 // 3])
    # A compressed chunk gives nothing of the block that it breaks off in: 128 KiB for zstd, more for lz4.
    source = McapReader().open(path)
    assert 3 <= len(source.frames) <= 5
    for frame, image in zip(source.frames, images, strict=False):
        assert np.array_equal(frame.read_depth(), image.astype(np.float32) * np.float32(1e-3))
    assert any("cut off" in note for note in source.notes)


def test_damage_in_the_middle_costs_one_chunk(tmp_path: Path) -> None:
    path = everything(count=6).write(tmp_path / "log.mcap", CompressionType.ZSTD, chunk_size=1)
    contents = bytearray(path.read_bytes())
    whole = McapReader().open(path)
    starts = [0, *(end for _, end in record_ends(bytes(contents)))]
    chunks = [start for start in starts if start and contents[start : start + 1] == bytes([Opcode.CHUNK])]
    flipped = contents.copy()
    flipped[chunks[20] + 60] ^= 0x10
    path.write_bytes(flipped)
    flipped_source = McapReader().open(path)
    assert any("log.mcap: 1 left out: a chunk" in note for note in flipped_source.notes)
    assert not whole.doubts
    assert [(doubt.kind, doubt.count) for doubt in flipped_source.doubts] == [("recording incomplete", 1)]
    longer = contents.copy()
    longer[chunks[20] + 6] = 0x7F  # The record's length, now past the end of the file.
    path.write_bytes(longer)
    source = McapReader().open(path)
    assert any(f"damaged at byte {chunks[20]}: went on at byte {chunks[21]}" in note for note in source.notes)
    assert len(source.frames) >= len(whole.frames) - 1


def test_checksums_tell_damage_that_nothing_else_would(tmp_path: Path) -> None:
    log = everything()
    path = log.write(tmp_path / "log.mcap", CompressionType.NONE, chunk_size=1)
    contents = bytearray(path.read_bytes())
    at = contents.index(depth_values(1).tobytes())
    contents[at + 20] ^= 1
    path.write_bytes(contents)
    source = McapReader(depth_topic="/raw").open(path)
    assert [frame.stamp_s for frame in source.frames] == [100.0, 102.0]
    assert "log.mcap: 1 left out: a chunk whose checksum does not hold" in source.notes


def test_memory_is_that_of_a_chunk(tmp_path: Path) -> None:
    """Forty megabytes of frames are opened, and each one read, in far less."""
    rng = np.random.default_rng(0)
    log = Log()
    log.add("/info", "foxglove.CameraCalibration", calibration(640, 480, 500, 500, 320, 240), CDR)
    for row in range(64):
        image = raw_image(rng.integers(1, 60000, (480, 640)).astype(np.uint16), "16UC1")
        log.add("/raw", IMAGE, {"header": ros_header(100 + row, "cam"), **image}, CDR)
    path = log.write(tmp_path / "log.mcap", CompressionType.ZSTD)
    del log
    tracemalloc.start()
    try:
        source = McapReader().open(path)
        for frame in source.frames:
            frame.read_depth()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(source.frames) == 64 and peak < 10e6, f"{peak / 1e6:.1f} MB"


def test_limits_are_what_the_documentation_says() -> None:
    assert mcap_records.MAX_CHUNK_BYTES == 256 << 20


def test_sniffing_never_raises(tmp_path: Path, recordings: list[bytes]) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "short.mcap").write_bytes(MAGIC[:5])
    (tmp_path / "good.mcap").write_bytes(recordings[0])
    assert McapReader().sniff(tmp_path / "good.mcap").confidence == 1
    for name in ("loop", "short.mcap", "absent"):
        assert McapReader().sniff(tmp_path / name).confidence == 0
        with suppress(SourceError):
            McapReader().open(tmp_path / name)
            raise AssertionError(name)

"""A recording of 245 MB is opened, and every image decoded, in less than 200 MB."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from mcap_data import CALIBRATION, DEPTH, INFO, OPTICAL, RAW, calibration, foxglove_header, raw_image
from mcap_encoding import CDR, ROS_FROM_FOXGLOVE, as_ros, encode_cdr, schema_bytes

MESSAGES = 400
READ = r"""
import re, sys
from pathlib import Path
from hodge_adapters.mcap.reader import McapReader
frames = McapReader().open(sys.argv[1]).frames
depth = [float(frame.read_depth()[0, 0]) for frame in frames]
assert len(set(depth)) > 100
status = Path("/proc/self/status").read_text()  # getrusage's peak counts that of the process which started this one
print(len(frames), int(re.search(r"VmHWM:\s+(\d+) kB", status)[1]) / 1024)
"""


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak of memory is read from /proc")
@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4], ids=["none", "lz4"])
def test_memory_of_a_large_recording(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "large.mcap"
    noise = np.random.default_rng(0).integers(500, 4000, (480, 640)).astype(np.uint16)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, enable_crcs=False)
        writer.start(profile="ros2", library="tests")
        channels = {}
        for topic, schema in ((INFO, CALIBRATION), (DEPTH, RAW)):
            name = ROS_FROM_FOXGLOVE[schema]
            channels[topic] = writer.register_channel(
                topic, CDR, writer.register_schema(name, *schema_bytes(name, CDR))
            )
        for row in range(MESSAGES):
            head = foxglove_header(100 + row / 30, OPTICAL)
            noise[0, 0] = 1000 + row
            messages = {
                INFO: (CALIBRATION, calibration(640, 480, 500, 500, 320, 240)),
                DEPTH: (RAW, raw_image(noise, "16UC1")),
            }
            for topic, (schema, message) in messages.items():
                data = encode_cdr(ROS_FROM_FOXGLOVE[schema], as_ros(schema, {**head, **message}))
                writer.add_message(channels[topic], row, data, row)
        writer.finish()
    assert path.stat().st_size > 240e6
    done = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True)
    path.unlink()
    count, peak_mb = done.stdout.split()
    assert int(count) == MESSAGES and float(peak_mb) < 200, f"{peak_mb} MB"

"""What reading costs: `python benchmarks/readers.py SEQUENCE` (a 7-Scenes sequence), each figure in its own process.

- `hodge inspect SEQUENCE`
- every frame to a cloud of 3 cm, on one core
- an MCAP of 450 MB made of the sequence's depth images, opened and every image decoded: the most memory ever held
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

LARGE_BYTES = 450e6


def inspected(path: Path) -> str:
    from hodge_pipeline.sources.inspect import inspect

    return f"{inspect(path)['frames']} frames"


def clouds(path: Path) -> str:
    from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
    from hodge_pipeline.sources.inspect import guess_reader

    options = CloudOptions(voxel_m=0.03)
    made = [make_cloud(frame, options)[0] for frame in guess_reader(path).open(path).frames]
    return f"{len(made)} clouds of {sum(map(len, made)) // len(made)} points"


def recording(path: Path) -> str:
    from hodge_adapters.mcap.reader import McapReader

    frames = McapReader().open(path).frames
    for frame in frames:
        assert frame.read_depth is not None
        frame.read_depth()
    return f"{len(frames)} images of {path.stat().st_size / 1e6:.0f} MB"


TASKS: dict[str, Callable[[Path], str]] = {"inspect": inspected, "clouds": clouds, "mcap": recording}


def write_large(sequence: Path, path: Path) -> Path:
    """Raw depth images, again and again until the file is large, in chunks without compression."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    import cv2
    import numpy as np
    from mcap.writer import CompressionType, Writer

    from hodge_pipeline.sources.inspect import guess_reader
    from mcap_data import DEPTH, INFO, OPTICAL, calibration, raw_image, ros_header
    from mcap_encoding import CDR, encode_cdr, schema_bytes

    frames = guess_reader(sequence).open(sequence).frames
    camera = frames[0].camera
    assert camera is not None
    info = calibration(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="benchmark")
        channels = {
            topic: writer.register_channel(topic, CDR, writer.register_schema(name, *schema_bytes(name, CDR)))
            for topic, name in ((DEPTH, "sensor_msgs/msg/Image"), (INFO, "sensor_msgs/msg/CameraInfo"))
        }
        row = 0
        while stream.tell() < LARGE_BYTES:
            encoded = frames[row % len(frames)].encoded_depth
            assert encoded is not None
            image = cv2.imdecode(np.frombuffer(encoded().contents, np.uint8), cv2.IMREAD_UNCHANGED)
            head = {"header": ros_header(1000 + row / 30, OPTICAL)}
            lower = {name.lower(): value for name, value in info.items()}
            for topic, name, message in (
                (INFO, "sensor_msgs/msg/CameraInfo", lower),
                (DEPTH, "sensor_msgs/msg/Image", raw_image(image, "16UC1")),
            ):
                log_ns = round((1000 + row / 30) * 1e9)
                writer.add_message(channels[topic], log_ns, encode_cdr(name, {**head, **message}), log_ns)
            row += 1
        writer.finish()
    return path


def main() -> None:
    if len(sys.argv) == 3:
        cpu_s = time.process_time()
        result = TASKS[sys.argv[1]](Path(sys.argv[2]))
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(json.dumps([result, time.process_time() - cpu_s, peak_mb]))
        return
    sequence = Path(sys.argv[1])
    print("| task | what | CPU s | peak MB |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for task in TASKS:
            path = write_large(sequence, Path(folder) / "large.mcap") if task == "mcap" else sequence
            done = subprocess.run([sys.executable, __file__, task, path], check=True, capture_output=True, text=True)
            result, cpu_s, peak_mb = json.loads(done.stdout.splitlines()[-1])
            print(f"| {task} | {result} | {cpu_s:.1f} | {peak_mb:.0f} |", flush=True)


if __name__ == "__main__":
    main()

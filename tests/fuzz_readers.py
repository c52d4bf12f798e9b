"""Every reader against damaged files: `python tests/fuzz_readers.py 2000` (`make fuzz`); 200 cases each in the tests.

Each case damages one file of good data in one way. A reader may refuse it with `SourceError`; what it opens instead
must be sound: finite, rigid, of the stated size. Memory is limited, so that a lie about a size shows at once.
"""

from __future__ import annotations

import os
import random
import re
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hodge_adapters.clouds import CloudFolderReader
from hodge_adapters.colmap import ColmapReader
from hodge_adapters.euroc import EurocReader, EurocWriter
from hodge_adapters.g2o import G2oReader, G2oWriter
from hodge_adapters.icl_nuim import IclNuimReader
from hodge_adapters.log_text import LogReader, LogWriter
from hodge_adapters.mcap import McapReader
from hodge_adapters.nerfstudio import NerfstudioReader, NerfstudioWriter
from hodge_adapters.open3d_json import Open3dPoseGraphWriter, Open3dReader, Open3dTrajectoryWriter
from hodge_adapters.pair_log import PairLogReader
from hodge_adapters.ply_points import write_ply
from hodge_adapters.poses_text import KittiWriter, TumWriter
from hodge_adapters.seven_scenes import SevenScenesReader
from hodge_adapters.toro import ToroReader
from hodge_adapters.trajectory_files import KittiPosesReader, TumPosesReader
from hodge_adapters.tum import TumReader
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import FrameReader
from hodge_pipeline.testing import check_trajectory, check_view_graph
from hodge_pipeline.types import Camera, Frame, PointCloud, Source, Trajectory, ViewGraph
from mcap_data import some_images, write_depth_log
from readers_data import seven_scenes_sequence, some_poses, tum_folder, tum_line, write_colour, write_depth

MAX_SECONDS = 5.0
MAX_EXTRA_BYTES = 2 << 30
ABSURD = (
    b"\xff" * 4,
    b"\xff" * 8,
    b"\xff\xff\xff\x7f",
    b"\0\0\0\0\0\0\0\x80",
    b"\0" * 4,
    b"\xfe\xff\xff\xff" + b"\xff" * 4,
)
WORDS = (
    b"nan",
    b"inf",
    b"-inf",
    b"-1",
    b"1e308",
    b"1e-320",
    b"9" * 30,
    b"",
    b"0",
    b"../../../etc/passwd",
    b"/etc/passwd",
    b"x\0y",
)
_NUMBER = re.compile(rb"[-+0-9][-+0-9.eE]*")


@dataclass(frozen=True)
class Target:
    """A reader, what makes good data for it and gives the path to open, and how many images of that are refused."""

    reader: FrameReader
    make: Callable[[Path], Path]
    refused: int = 0


def poses_source(count: int = 4) -> Source:
    poses = some_poses(count)
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)
    frames = tuple(Frame(f"{row}.png", float(row), camera, world_from_cam=pose) for row, pose in enumerate(poses))
    edges = np.array([(row, row + 1) for row in range(count - 1)])
    graph = ViewGraph.from_edges(np.arange(count), edges, se3.inverse(poses[:-1]) @ poses[1:])
    return Source("made", Path("made"), frames, Trajectory(np.arange(count) + 100.5, poses), graph)


def written(writer: object, name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        writer.write(folder / name, poses_source())
        return folder / name

    return make


def icl(folder: Path) -> Path:
    for number in range(1):
        write_depth(folder / f"depth/{number}.png", np.full((480, 640), 5000, np.uint16))
        write_colour(folder / f"rgb/{number}.png", size=(480, 640))
    (folder / "associations.txt").write_text("".join(f"{n} depth/{n}.png {n} rgb/{n}.png\n" for n in range(1)))
    (folder / "a.gt.freiburg").write_text("".join(tum_line(n, pose) for n, pose in enumerate(some_poses(3))))
    return folder


def pov(folder: Path) -> Path:
    text = "cam_pos = [1, 2, 3]';\ncam_dir = [0, 0, 1]';\ncam_up = [0, 1, 0]';\ncam_right = [1.33, 0, 0]';\n"
    for number in range(2):
        stem = folder / f"scene_00_{number:04d}"
        stem.with_suffix(".txt").write_text(text)
        stem.with_suffix(".depth").write_text("100.5\n" * 60)
    return folder


def redwood(folder: Path) -> Path:
    for number in range(1):
        write_depth(folder / f"depth/{number:05d}.png", np.full((480, 640), 1000, np.uint16))
        write_colour(folder / f"image/{number:05d}.jpg", size=(480, 640))
    LogWriter().write(
        folder / "trajectory.log", Source("a", folder, trajectory=Trajectory(np.arange(3.0), some_poses(3)))
    )
    return folder


def pairs(folder: Path) -> Path:
    some = some_poses(3)
    graph = ViewGraph.from_edges(np.arange(3), np.array([[0, 1], [1, 2], [2, 0]]), np.stack(list(some)))
    LogWriter().write(folder / "a.log", Source("pairs", folder, graph=graph))
    return folder / "a.log"


def toro(folder: Path) -> Path:
    lines = [
        "VERTEX2 0 0 0 0",
        "VERTEX2 1 1 0 0.1",
        "EDGE2 0 1 1 0 0.1 500 0 500 5000 0 0",
        "EDGE2 1 0 -1 0 -0.1 500 0 500 5000 0 0",
    ]
    (folder / "a.graph").write_text("\n".join(lines) + "\n")
    return folder / "a.graph"


def colmap(form: str, points: int = 0) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import pycolmap

        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 3
        options.num_points3D = points or 5
        pycolmap.set_random_seed(0)
        base = pycolmap.Database.open(folder / "database.db") if points else None
        model = pycolmap.synthesize_dataset(options, base) if base else pycolmap.synthesize_dataset(options)
        if base:
            base.close()
        (folder / "sparse").mkdir()
        (model.write_text if form == "txt" else model.write_binary)(folder / "sparse")
        for image in model.images.values():
            write_depth(folder / "depth" / image.name, np.full((768 // 64, 1024 // 64), 1000, np.uint16))
        return folder

    return make


def ply(ascii: bool) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        cloud = PointCloud(np.random.default_rng(0).normal(0, 1, (8, 3)).astype(np.float32))
        write_ply(folder / "cloud_0.ply", cloud)
        if ascii:
            header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
            (folder / "cloud_0.ply").write_text(header + "end_header\n1 2 3\n4 5 6\n7 8 9\n")
        pose = Trajectory(np.zeros(1), some_poses(1))
        LogWriter().write(folder / "all.log", Source("a", folder, trajectory=pose))
        return folder

    return make


def pcd(kind: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        points = np.arange(24, dtype="<f4").reshape(8, 3)
        body = (
            "\n".join(" ".join(map(str, row)) for row in points).encode() + b"\n"
            if kind == "ascii"
            else points.tobytes()
        )
        if kind == "binary_compressed":
            raw = points.T.tobytes()
            packed = b"".join(bytes([len(raw[at : at + 32]) - 1]) + raw[at : at + 32] for at in range(0, len(raw), 32))
            body = np.array([len(packed), len(raw)], "<u4").tobytes() + packed
        header = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 8\nHEIGHT 1\nPOINTS 8\n"
        (folder / "a.pcd").write_bytes(f"{header}DATA {kind}\n".encode() + body)
        return folder

    return make


TARGETS: dict[str, Target] = {
    "seven_scenes": Target(SevenScenesReader(), lambda folder: seven_scenes_sequence(folder / "seq-01", 2)),
    "tum": Target(TumReader(), tum_folder),
    "icl_lists": Target(IclNuimReader(), icl),
    "icl_pov": Target(IclNuimReader(), pov, refused=2),
    "icl_redwood": Target(IclNuimReader(), redwood),
    "mcap": Target(McapReader(), lambda folder: write_depth_log(folder / "a.mcap", some_images(2))),
    "colmap_bin": Target(ColmapReader(edges="none"), colmap("bin")),
    "colmap_txt": Target(ColmapReader(edges="none"), colmap("txt")),
    "colmap_database": Target(ColmapReader(edges="database", min_shared=8), colmap("bin", 12)),
    "ply_binary": Target(CloudFolderReader(), ply(False)),
    "ply_ascii": Target(CloudFolderReader(), ply(True)),
    "pcd_ascii": Target(CloudFolderReader(), pcd("ascii")),
    "pcd_binary": Target(CloudFolderReader(), pcd("binary")),
    "pcd_compressed": Target(CloudFolderReader(), pcd("binary_compressed")),
    "nerfstudio": Target(NerfstudioReader(), written(NerfstudioWriter(), "transforms.json")),
    "open3d_graph": Target(Open3dReader(), written(Open3dPoseGraphWriter(), "graph.json")),
    "open3d_cameras": Target(Open3dReader(), written(Open3dTrajectoryWriter(), "cameras.json")),
    "euroc": Target(EurocReader(), written(EurocWriter(), "data.csv")),
    "log": Target(LogReader(), written(LogWriter(), "a.log")),
    "pair_log": Target(PairLogReader(), pairs),
    "tum_poses": Target(TumPosesReader(), written(TumWriter(), "a.tum")),
    "kitti_poses": Target(KittiPosesReader(), written(KittiWriter(), "a.txt")),
    "g2o": Target(G2oReader(), written(G2oWriter(), "a.g2o")),
    "toro": Target(ToroReader(), toro),
}


def damage(contents: bytes, rng: random.Random) -> bytes:
    """The contents, damaged in one way."""
    ways = (_cut, _flip, _absurd, _word, _word, _remove, _repeat, _insert, _text_form, _zero_line, _swap_lines)
    return rng.choice(ways)(contents, rng)


def _at(contents: bytes, rng: random.Random) -> int:
    # Headers are where the lies hurt: half of all damage is done near the beginning.
    return rng.randrange(min(len(contents), 200) if rng.random() < 0.5 else len(contents)) if contents else 0


def _cut(contents: bytes, rng: random.Random) -> bytes:
    borders = [match.end() for match in re.finditer(rb"[\n\0]", contents)] or [0]
    return contents[: rng.choice(borders) if rng.random() < 0.5 else _at(contents, rng)]


def _flip(contents: bytes, rng: random.Random) -> bytes:
    out = bytearray(contents)
    for _ in range(rng.randint(1, 8) if out else 0):
        out[_at(contents, rng)] ^= 1 << rng.randrange(8)
    return bytes(out)


def _absurd(contents: bytes, rng: random.Random) -> bytes:
    at, value = _at(contents, rng) // 4 * 4, rng.choice(ABSURD)
    return contents[:at] + value + contents[at + len(value) :]


def _word(contents: bytes, rng: random.Random) -> bytes:
    found = list(_NUMBER.finditer(contents))
    if not found:
        return _flip(contents, rng)
    match = rng.choice(found)
    return contents[: match.start()] + rng.choice(WORDS) + contents[match.end() :]


def _remove(contents: bytes, rng: random.Random) -> bytes:
    at = _at(contents, rng)
    return contents[:at] + contents[at + rng.randint(1, 64) :]


def _repeat(contents: bytes, rng: random.Random) -> bytes:
    at = _at(contents, rng)
    end = at + rng.randint(1, 200)
    return contents[:end] + contents[at:]


def _insert(contents: bytes, rng: random.Random) -> bytes:
    at = _at(contents, rng)
    return contents[:at] + rng.randbytes(rng.randint(1, 32)) + contents[at:]


def _text_form(contents: bytes, rng: random.Random) -> bytes:
    forms = (
        contents.replace(b".", b","),
        contents.replace(b"\n", b"\r\n"),
        contents.replace(b"\n", b"\r"),
        b"\xef\xbb\xbf" + contents,
        contents.decode("latin-1").encode("utf-16"),
        contents.replace(b" ", b", "),
        b"",
    )
    return rng.choice(forms)


def _zero_line(contents: bytes, rng: random.Random) -> bytes:
    lines = contents.split(b"\n")
    row = rng.randrange(len(lines))
    lines[row] = _NUMBER.sub(b"0", lines[row])
    return b"\n".join(lines)


def _swap_lines(contents: bytes, rng: random.Random) -> bytes:
    lines = contents.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    return b"\n".join(lines)


def check_sound(source: Source) -> int:
    """How many images were refused, after asserting that what was opened and read is sound."""
    refused = 0
    assert len(source.frames) or source.trajectory is not None or source.graph is not None, "nothing, silently"
    if source.trajectory is not None:
        check_trajectory(source.trajectory)
    if source.graph is not None:
        check_view_graph(source.graph)
    assert len({frame.frame_id for frame in source.frames}) == len(source.frames), "frame ids repeat"
    for frame in source.frames[:4]:
        assert np.isfinite(frame.stamp_s)
        assert frame.world_from_cam is None or se3.is_motion(frame.world_from_cam, 1e-6)
        for read in filter(None, (frame.read_depth, frame.read_colour, frame.read_points, frame.encoded_depth)):
            try:
                image = read()
            except SourceError:
                refused += 1
                continue
            if read is frame.read_depth:
                assert image.shape == (frame.camera.height, frame.camera.width)
                assert np.isfinite(image).all() and (image >= 0).all()
            if isinstance(image, PointCloud):
                assert np.isfinite(image.points_in_cam).all()
    return refused


@contextmanager
def limited_memory() -> Iterator[None]:
    """Little more memory than there is in use now."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MAX_EXTRA_BYTES, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def fuzz(name: str, cases: int, folder: Path, seed: int = 0) -> Counter[str]:
    """How many cases were read and refused. Raises `AssertionError` that names the case for anything else."""
    target = TARGETS[name]
    path = target.make(folder)
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    originals = {file: file.read_bytes() for file in files}
    outcomes: Counter[str] = Counter()
    assert check_sound(target.reader.open(path)) == target.refused, f"{name}: the good data is refused"
    with limited_memory():
        for case in range(cases):
            rng = random.Random(f"{name} {seed} {case}")
            file = rng.choice(files)
            _put(file, originals[file], rng)
            start = time.process_time()
            try:
                assert 0 <= target.reader.sniff(path).confidence <= 1
                refused = check_sound(target.reader.open(path))
                outcomes["refused in part" if refused > target.refused else "read"] += 1
            except SourceError as error:
                assert str(error).strip() and "\n" not in str(error), f"{name} case {case}: no line: {error!r}"
                outcomes["refused"] += 1
            except BaseException as error:
                raise AssertionError(f"{name} case {case} of seed {seed} ({file.name}): {error!r}") from error
            assert time.process_time() - start < MAX_SECONDS, f"{name} case {case} takes too long"
            file.unlink(missing_ok=True)
            file.write_bytes(originals[file])
    return outcomes


def _put(file: Path, original: bytes, rng: random.Random) -> None:
    if rng.random() < 0.01:
        file.unlink()
        if rng.random() < 0.5:
            file.symlink_to(file)
        return
    file.write_bytes(damage(original, rng))


def main() -> None:
    cases = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    for name in sys.argv[2:] or TARGETS:
        with tempfile.TemporaryDirectory() as folder:
            start = time.process_time()
            outcomes = fuzz(name, cases, Path(folder), seed=int(os.environ.get("HODGE_FUZZ_SEED", "0")))
            print(f"{name:<16} {dict(outcomes)} {time.process_time() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()

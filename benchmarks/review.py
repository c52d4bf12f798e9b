"""A large review without a browser: `python benchmarks/review.py` measures memory, what a page is sent, and a decision.

5000 key frames in a spiral, 50,000 edges, 20 million points, as arrays of a run; a client that reads what viser sends.
"""

from __future__ import annotations

import asyncio
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.review.opening import Viewer
from hodge_pipeline.review.scene import Scene
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.subject import Subject
from hodge_pipeline.types import CloudSet, Edges, Floats, Solution, Source, ViewGraph

FRAMES, EDGES, POINTS = 5000, 50_000, 20_000_000
QUIET_S = 3.0
"""Without a byte for so long all is sent."""


def poses_on_a_spiral() -> Floats:
    """Cameras (N, 4, 4) that go round and round, ten times."""
    angle = np.linspace(0, 20 * np.pi, FRAMES)
    turn = se3.so3_exp(np.outer(angle, [0, 0, 1.0]))
    return se3.from_parts(turn, np.stack([20 * np.cos(angle), 20 * np.sin(angle), angle], axis=1))


def large_subject(folder: Path) -> Subject:
    """The arrays of a run of this size; its clouds are mapped from files, as a run's are."""
    rng, poses = np.random.default_rng(0), poses_on_a_spiral()
    step = np.arange(1, 11)
    pairs = np.stack(np.broadcast_arrays(np.arange(FRAMES)[:, None], np.arange(FRAMES)[:, None] + step), axis=-1)
    pairs = pairs.reshape(-1, 2)
    far = np.stack([np.arange(FRAMES - 500), np.arange(FRAMES - 500) + 500], axis=1)  # the round before
    pairs = np.concatenate([pairs[pairs[:, 1] < FRAMES], far])[:EDGES]
    noise = se3.exp(rng.normal(0, 0.003, (len(pairs), 6)))
    motions = se3.inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]] @ noise
    graph = ViewGraph.from_edges(np.arange(FRAMES), pairs, motions, np.tile(np.eye(6) / 0.003**2, (len(pairs), 1, 1)))
    edges = Edges.measured(graph)
    solution = Solution(poses, np.zeros(FRAMES, np.int64), np.ones(len(pairs)))
    none = np.full((FRAMES, 4, 4), np.nan)
    return Subject(
        folder, "large", edges, graph, solution, folder / "edits.json", folder / "log.csv", none,
        Source("large", folder, ()), clouds=_clouds(folder, rng),
    )  # fmt: skip


def _clouds(folder: Path, rng: np.random.Generator) -> CloudSet:
    each = POINTS // FRAMES
    np.save(folder / "offsets.npy", np.arange(FRAMES + 1) * each)
    np.save(folder / "marks.npy", np.zeros(FRAMES + 1, np.int64))
    for name, kind, shape in (
        ("points", np.float32, (POINTS, 3)), ("normals", np.float32, (POINTS, 3)), ("colours", np.uint8, (POINTS, 3)),
        ("mark_points", np.float32, (0, 3)), ("mark_descriptors", np.uint8, (0, 128)),
        ("mark_pixel_rad", np.float32, (0,)),
    ):  # fmt: skip
        np.save(folder / f"{name}.npy", np.zeros(shape, kind))
    block = rng.normal(0, 2, (each, 3)).astype(np.float32)
    points = np.load(folder / "points.npy", mmap_mode="r+")
    colours = np.load(folder / "colours.npy", mmap_mode="r+")
    for row in range(FRAMES):
        points[row * each : (row + 1) * each] = block
        colours[row * each : (row + 1) * each] = 40 + row % 200
    del points, colours
    return CloudSet.open(folder)


async def received(socket: Path) -> tuple[int, float]:
    """The bytes that a page is sent at first, and the seconds until the last of them."""
    import viser
    from websockets.asyncio.client import unix_connect

    size, began, last = 0, time.perf_counter(), 0.0
    protocol = f"viser-v{viser.__version__}"
    async with unix_connect(str(socket), uri="ws://127.0.0.1/", subprotocols=[protocol], max_size=None) as page:
        while True:
            try:
                size += len(await asyncio.wait_for(page.recv(), QUIET_S))
            except TimeoutError:
                return size, last
            last = time.perf_counter() - began


def memory_mb() -> float:
    """What this process holds now, without the pages of mapped files."""
    text = Path("/proc/self/status").read_text()
    return int(next(line for line in text.splitlines() if line.startswith("RssAnon")).split()[1]) / 1024


def main() -> None:
    """Print what was measured, a line each."""
    with tempfile.TemporaryDirectory() as name:
        subject = large_subject(Path(name))
        print(f"{subject.graph.edge_count} edges, {len(subject.clouds or ())} frames; arrays {memory_mb():.0f} MB")
        began, cpu = time.perf_counter(), time.process_time()
        session, viewer = Session(subject), Viewer()
        scene = Scene(session, viewer.server)
        print(f"server ready: {time.perf_counter() - began:.1f} s, {time.process_time() - cpu:.1f} s of CPU")
        size, seconds = asyncio.run(received(viewer.path))
        print(f"a page is sent {size / 1e6:.1f} MB in {seconds:.1f} s; server {memory_mb():.0f} MB")
        cpu = time.process_time()
        session.wait()
        print(f"verdicts after {time.process_time() - cpu:.1f} s of CPU more")
        for row in (7, 20_000, len(subject.edges) - 5):
            cpu, began = time.process_time(), time.perf_counter()
            session.decide(session.decisions.revision, "disable", [row])
            session.quick.wait()
            spent = time.process_time() - cpu
            print(f"disable row {row}: {spent:.2f} s of CPU, {time.perf_counter() - began:.2f} s")
            session.wait()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"server {memory_mb():.0f} MB now; {peak:.0f} MB at most, mapped files included")
        scene.close()
        viewer.close()
        session.close()


if __name__ == "__main__":
    main()

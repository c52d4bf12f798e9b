"""Which pairs are worth trying: recall of truly overlapping pairs and CPU seconds, beside trying them all.

`python benchmarks/candidates.py SCENE [EVERY]`, a 7-Scenes folder with true poses. Truly overlapping: a voxel IoU
(0.1 m) above 0.3 under the true poses, more than 5 frames apart. The drifted poses are those of odometry. "One in
reach" counts a pair as found where one within 5 frames of it is, since the rounds find its neighbours then.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.pairs.drift import DriftEdges
from hodge_pipeline.pairs.overlap import OverlapEdges
from hodge_pipeline.registration.cloud_set import prepare_clouds
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.global_landmarks import LandmarkConsensus
from hodge_pipeline.registration.global_pairs import describe_clouds, match_pairs
from hodge_pipeline.registration.global_registrars import FpfhConsensus
from hodge_pipeline.registration.odometry import OdometryOptions, odometry
from hodge_pipeline.stages import GlobalRegistrar, Workers
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.start.unordered.start import SIMILARITY_VOXEL_M, LocalDescriptors, all_pairs, similar_pairs
from hodge_pipeline.types import Ints

REACH = 5
TIMED_PAIRS = 200


def far(pairs: Ints) -> Ints:
    return pairs[pairs[:, 1] - pairs[:, 0] > REACH]


def recall(true: Ints, found: Ints, count: int, slack: int) -> float:
    hit = np.zeros((count, count), bool)
    for i, j in found.tolist():
        hit[max(0, i - slack) : i + slack + 1, max(0, j - slack) : j + slack + 1] = True
    return float(hit[true[:, 0], true[:, 1]].mean())


def timed(work: Callable[[], Ints]) -> tuple[Ints, float]:
    start = time.process_time()
    return work(), time.process_time() - start


def matching_s(folder: Path, registrar: GlobalRegistrar, pairs: Ints, workers: Workers) -> float:
    some = pairs[:: max(1, len(pairs) // TIMED_PAIRS)]
    start = time.process_time()
    match_pairs(folder, registrar, some, workers)
    return (time.process_time() - start) / len(some)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path, help="a 7-Scenes folder")
    parser.add_argument("every", type=int, nargs="?", default=1, help="take every n-th frame")
    given = parser.parse_args()
    frames = SevenScenesReader().open(given.sequence).frames[:: given.every]
    options, rows = GlobalStart(), np.arange(len(frames))
    truth = np.array([frame.world_from_cam for frame in frames])
    with tempfile.TemporaryDirectory() as name, LocalExecutor(workers=0).open() as workers:
        folder = Path(name)
        clouds, _ = prepare_clouds(frames, CloudOptions(landmarks=1000), workers, folder)
        stamps = np.array([frame.stamp_s for frame in frames])
        drifted = odometry(folder, [rows], stamps, OdometryOptions(), workers).world_from_cam
        true = far(OverlapEdges(min_iou=0.3).propose(frames, clouds, truth).pairs)
        print(f"{len(frames)} frames, {len(true)} truly overlapping pairs, {len(far(all_pairs(rows)))} in all\n")
        print(
            "| candidates | pairs | recall | one in reach | CPU s to find | CPU s to match |\n|---|---|---|---|---|---|"
        )

        def row(what: str, pairs: Ints, find_s: float, match_s: float) -> None:
            pairs = far(pairs)
            shares = (f"{recall(true, pairs, len(frames), slack):.2f}" for slack in (0, REACH))
            print(
                f"| {what} | {len(pairs)} | {' | '.join(shares)} | {find_s:.1f} | {match_s * len(pairs):.0f} |",
                flush=True,
            )

        cost = {}
        registrars: dict[str, GlobalRegistrar] = {"landmarks": LandmarkConsensus(), "FPFH": FpfhConsensus()}
        for kind, registrar in registrars.items():
            own = folder / kind
            describe_clouds(folder, registrar, rows, own, workers)
            local = LocalDescriptors(own, clouds, SIMILARITY_VOXEL_M)
            found, seconds = timed(lambda local=local: similar_pairs(local, rows, options, True))  # type: ignore[misc]
            cost[kind] = matching_s(own, registrar, all_pairs(rows), workers)
            row(f"all, matched by {kind}", all_pairs(rows), 0.0, cost[kind])
            row(f"{options.similar_per_frame} most similar by {kind}", found, seconds, cost[kind])
            if kind == "landmarks":
                similar = found
        for iou, voxel_m in ((0.3, 0.1), (0.3, 0.3)):
            builder = OverlapEdges(min_iou=iou, voxel_m=voxel_m)
            pairs, seconds = timed(lambda builder=builder: builder.propose(frames, clouds, drifted).pairs)  # type: ignore[misc]
            row(f"overlap of drifted poses, voxels of {voxel_m:g} m", pairs, seconds, cost["landmarks"])
        pairs, seconds = timed(lambda: DriftEdges().propose(frames, clouds, drifted).pairs)
        row("drifted poses with a growing tolerance", pairs, seconds, cost["landmarks"])
        both = np.unique(np.concatenate([pairs, similar]), axis=0)
        row("these and the most similar by landmarks", both, seconds, cost["landmarks"])


if __name__ == "__main__":
    main()

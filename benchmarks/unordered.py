"""Registration with no guess beside open3d's RANSAC over FPFH at its defaults, same clouds, same run.

`python benchmarks/unordered.py FRAGMENTS GT_LOG`, such as 3DMatch's red kitchen with its `gt.log`. For each registrar:
the listed pairs that its match puts within 0.3 m and 15°, those that GICP then brings within 6 cm and 2°, the pairs
that are not listed and would be accepted, and the CPU seconds with the features.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from itertools import combinations
from pathlib import Path

import numpy as np
from global_peers import FpfhFgr, FpfhRansac, KissMatcher

from hodge_adapters.clouds.reader import CloudFolderReader
from hodge_adapters.trajectories.log import read_log_file
from hodge_pipeline import se3
from hodge_pipeline.registration.clouds import CloudOptions, make_cloud
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.global_registrars import FpfhConsensus
from hodge_pipeline.stages import GlobalRegistrar
from hodge_pipeline.start.unordered.options import HypothesisLimits
from hodge_pipeline.types import Floats, PointCloud, number_of

REFINE = Gicp(distances_m=(0.3, 0.1, 0.05), source_points=(2000, 4000, 8000))


def off_by(found: Floats, truth: Floats) -> tuple[float, float]:
    error = se3.inverse(truth) @ found
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(np.linalg.norm(se3.so3_log(error[:3, :3]))))


def row(registrar: GlobalRegistrar, clouds: list[PointCloud], truth: dict[tuple[int, int], Floats]) -> str:
    start = time.process_time()
    described = [registrar.describe(cloud) for cloud in clouds]
    pairs = list(combinations(range(len(clouds)), 2))
    matches = {(i, j): registrar.match(described[i], described[j]) for i, j in pairs}
    seconds = time.process_time() - start
    prepared = [REFINE.prepare(cloud) for cloud in clouds]
    near = close = extra = 0
    for (i, j), match in matches.items():
        refined = REFINE.register(prepared[i], prepared[j], match.i_from_j)
        enough = match.inliers >= HypothesisLimits().min_inliers and refined.fitness >= HypothesisLimits().min_overlap
        if (i, j) in truth:
            metres, degrees = off_by(match.i_from_j, truth[i, j])
            near += metres < 0.3 and degrees < 15
            metres, degrees = off_by(refined.i_from_j, truth[i, j])
            close += metres < 0.06 and degrees < 2
        else:
            extra += enough
    return (
        f"| {type(registrar).__name__} | {near} of {len(truth)} | {close} of {len(truth)} | {extra} | {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fragments", type=Path)
    parser.add_argument("gt_log", type=Path)
    options = parser.parse_args()
    frames = CloudFolderReader(log="").open(options.fragments).frames
    clouds_of = CloudOptions(voxel_m=0.03, min_range_m=0.0, max_range_m=200.0)
    clouds = [make_cloud(frame, clouds_of)[0] for frame in frames]
    listed = read_log_file(options.gt_log)
    row_of = {number_of(frame): at for at, frame in enumerate(frames)}
    truth = {
        (row_of[i], row_of[j]): motion
        for (i, j), motion in zip(listed.pairs.tolist(), listed.i_from_j, strict=True)
        if i in row_of and j in row_of
    }
    registrars: list[GlobalRegistrar] = [FpfhConsensus(), FpfhRansac(), FpfhFgr()]
    if importlib.util.find_spec("kiss_matcher"):
        registrars.append(KissMatcher())
    print("| registrar | matched | after GICP | not listed, accepted | CPU s |\n|---|---|---|---|---|")
    for registrar in registrars:
        print(row(registrar, clouds, truth), flush=True)


if __name__ == "__main__":
    main()

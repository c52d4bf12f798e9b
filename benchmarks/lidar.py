"""The demo street by seeds and beams: what a sweep costs, how far the result is off, whether streets alike stay apart.

    OMP_NUM_THREADS=1 python benchmarks/lidar.py [--seeds 0 1] [--beams 16] [--sweeps 780]

Beside `hodge demo --lidar`, on the same files: KISS-ICP's own pipeline (its defaults and its deskewing) and Open3D's
multiway registration (sweep to sweep, loops by position, its line process). CPU seconds include reading the files.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d

import hodge_pipeline
from hodge_adapters.clouds.fragments import Fragment, read_fragment
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import make_sequence
from hodge_pipeline.demo.street import Road
from hodge_pipeline.demo.sweeps import FARTHEST_M, NEAREST_M, REVOLUTION_S, StreetOptions
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.scene import choose_key_frames
from hodge_pipeline.start.sweeps import KEY_FRAMES_IN_REACH
from hodge_pipeline.types import Floats, Ints
from hodge_pipeline.types.edges import USED

GLUED_M = 10.0
"""An edge that is off by more joins places that are not the same: loops of this road are off by centimetres."""
VOXEL_M = 0.5
"""Of Open3D's clouds; distances follow as in its tutorial, 15 and 1.5 times as far."""
DRIFT_SHARE, LOOPS_EACH, APART = 0.05, 2, 20
"""What the recipe `lidar` allows: drift of the way, loops a key frame; key frames from one to the other of a loop."""
HEADER = ("beams", "seed", "", "odometry, CPU s a sweep", "all, CPU s a sweep", "ATE m", "largest m", "pieces", "alike")


@dataclass(frozen=True)
class Outcome:
    """Poses (N, 4, 4) of sweeps, `late_s` after each began; CPU seconds; edges (E, 2) between sweeps that count."""

    name: str
    poses: Floats
    odometry_s: float
    total_s: float
    pieces: int = 1
    pairs: Ints | None = None
    i_from_j: Floats | None = None
    late_s: float = 0.0


def ours(folder: Path, out: Path) -> Outcome:
    """The whole job of the recipe `lidar`, with report and recording."""
    before = os.times()
    done = hodge_pipeline.run(load_recipe("lidar", [], folder), out)
    after = os.times()
    total_s = sum(after[:4]) - sum(before[:4])
    odometry_s = sum(stage.cpu_s for stage in done.report.stages if stage.name in ("sweeps", "odometry"))
    used = done.edges.select(done.edges.status == USED)
    graph = done.report.graph
    assert graph is not None
    return Outcome(
        "hodge", done.poses, odometry_s, total_s, len(graph.components),
        done.key_frames.rows[used.pairs], used.i_from_j,
    )  # fmt: skip


def kiss_icp(files: list[Path]) -> Outcome:
    """KISS-ICP's own loop: its pose is that at the end of a sweep, which it deskews to."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.min_range, config.data.max_range = NEAREST_M, FARTHEST_M
    config.mapping.voxel_size = FARTHEST_M / 100  # as its load_config does
    config.registration.max_num_threads = 1
    begin, tracker, poses = time.process_time(), KissICP(config), []
    for file in files:
        cloud = read_fragment(Fragment(file))
        assert cloud.times_s is not None
        tracker.register_frame(cloud.points_in_cam.astype(float), cloud.times_s / cloud.times_s.max())
        poses.append(np.array(tracker.last_pose))
    seconds = time.process_time() - begin
    return Outcome("KISS-ICP's pipeline", np.array(poses), seconds, seconds, late_s=REVOLUTION_S)


def multiway(files: list[Path]) -> Outcome:
    """Open3D: point-to-plane ICP from sweep to sweep, a pose graph of key frames with loops by position."""
    begin = time.process_time()
    clouds = [_open3d_cloud(file) for file in files]
    poses, step = [np.eye(4)], np.eye(4)
    for before, cloud in zip(clouds, clouds[1:], strict=False):
        step = _icp(cloud, before, 1.5 * VOXEL_M, _icp(cloud, before, 3 * VOXEL_M, step))
        poses.append(poses[-1] @ step)
    odometry, odometry_s = np.array(poses), time.process_time() - begin
    every = (np.arange(len(files)),)
    rows = choose_key_frames(odometry, every, FARTHEST_M / KEY_FRAMES_IN_REACH, 15.0, 0)
    graph = o3d.pipelines.registration.PoseGraph()
    graph.nodes.extend(o3d.pipelines.registration.PoseGraphNode(pose) for pose in odometry[rows])
    for i, j in [*((k, k + 1) for k in range(len(rows) - 1)), *_loops(odometry[rows])]:
        target, source = clouds[rows[i]], clouds[rows[j]]
        motion = se3.inverse(odometry[rows[i]]) @ odometry[rows[j]]
        if j > i + 1:
            motion = _icp(source, target, 1.5 * VOXEL_M, _icp(source, target, 15 * VOXEL_M, motion))
        known = o3d.pipelines.registration.get_information_matrix_from_point_clouds(
            source, target, 1.5 * VOXEL_M, motion
        )
        graph.edges.append(o3d.pipelines.registration.PoseGraphEdge(j, i, motion, known, uncertain=j > i + 1))
    o3d.pipelines.registration.global_optimization(
        graph,
        o3d.pipelines.registration.GlobalOptimizationLevenbergMarquardt(),
        o3d.pipelines.registration.GlobalOptimizationConvergenceCriteria(),
        o3d.pipelines.registration.GlobalOptimizationOption(
            max_correspondence_distance=1.5 * VOXEL_M, edge_prune_threshold=0.25, reference_node=0
        ),
    )
    anchor = np.searchsorted(rows, np.arange(len(files)), side="right") - 1
    solved = np.array([node.pose for node in graph.nodes])[anchor]
    result = solved @ se3.inverse(odometry[rows[anchor]]) @ odometry
    pairs = rows[np.array([(edge.target_node_id, edge.source_node_id) for edge in graph.edges])]
    motions = np.array([edge.transformation for edge in graph.edges])
    total_s = time.process_time() - begin
    return Outcome("Open3D multiway", result, odometry_s, total_s, 1, pairs, motions)


def _open3d_cloud(file: Path) -> o3d.geometry.PointCloud:
    points = o3d.utility.Vector3dVector(read_fragment(Fragment(file)).points_in_cam.astype(float))
    cloud = o3d.geometry.PointCloud(points).voxel_down_sample(VOXEL_M)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=4 * VOXEL_M, max_nn=30))
    return cloud


def _icp(source: o3d.geometry.PointCloud, target: o3d.geometry.PointCloud, distance_m: float, guess: Floats) -> Floats:
    plane = o3d.pipelines.registration.TransformationEstimationPointToPlane()
    found = o3d.pipelines.registration.registration_icp(source, target, distance_m, guess, plane)
    return np.array(found.transformation)


def _loops(poses: Floats) -> Iterator[tuple[int, int]]:
    """Pairs of key frames that drift may have kept apart: the nearest few earlier ones of each."""
    way = np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1))
    for j in range(APART, len(poses)):
        away = np.linalg.norm(poses[: j - APART + 1, :3, 3] - poses[j, :3, 3], axis=1)
        near = away < DRIFT_SHARE * (way[j] - way[: j - APART + 1])
        for i in np.argsort(away)[:LOOPS_EACH]:
            if near[i]:
                yield int(i), j


def row(beams: int, seed: int, found: Outcome) -> str:
    """The row of a table. `alike`: apart, or how many edges glue places that are not the same."""
    number = np.arange(len(found.poses))
    truth = Road(StreetOptions().speed_m_s).world_from_car(np.asarray(number * REVOLUTION_S + found.late_s, float))
    error = absolute_error(found.poses, truth)
    alike = "–"
    if found.pairs is not None and found.i_from_j is not None:
        exact = se3.inverse(truth[found.pairs[:, 0]]) @ truth[found.pairs[:, 1]]
        off_m = np.linalg.norm((se3.inverse(found.i_from_j) @ exact)[:, :3, 3], axis=1)
        glued = int((off_m > GLUED_M).sum())
        alike = f"glued by {glued} edges" if glued else "apart"
    costs = [f"{seconds / len(number):.3f}" for seconds in (found.odometry_s, found.total_s)]
    return " | ".join(
        [
            f"| {beams} | {seed} | {found.name}",
            *costs,
            f"{error.rmse_m:.2f}",
            f"{error.max_m:.2f}",
            str(found.pieces),
            f"{alike} |",
        ]
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--beams", type=int, nargs="+", default=[16])
    parser.add_argument("--sweeps", type=int, default=StreetOptions().frames)
    options = parser.parse_args()
    if not importlib.util.find_spec("kiss_icp"):
        parser.error("the peer is not installed: pip install kiss-icp, best into an environment of its own")
    print("| " + " | ".join(HEADER) + " |\n|" + "---|" * len(HEADER))
    for beams in options.beams:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                world = StreetOptions(frames=options.sweeps, beams=beams, seed=seed)
                street = make_sequence(Path(folder) / "street", world)
                files = sorted(street.glob("*.pcd"))
                for found in (ours(street, Path(folder) / "run"), kiss_icp(files), multiway(files)):
                    print(row(beams, seed, found), flush=True)
    print(f"\n{sum(os.times()[:4]):.0f} CPU s in all")


if __name__ == "__main__":
    main()

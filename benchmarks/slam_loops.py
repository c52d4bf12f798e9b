"""Graphs that SLAM leaves, a right odometry and loops most of which are wrong, beside two other programs.

    python -m benchmarks.slam_loops                   # ../shared/data/pose_graphs/slam_loops
    python -m benchmarks.slam_loops FOLDER --json slam_loops.json --runs 1

Errors are of positions, metres RMS, after a rigid fit. A loop is right where its ends lie within 1.5 m (Bicocca, planar
pose) or 5 m (RobotCar, distance of the places alone) of where the truth says; loops without truth are not counted. AUC
is of the probability that a loop is right. GTSAM's GNC is told that consecutive edges are right, and so is Open3D's
line process; GNC has the information that the graphs state. Each row's peers run in the same process, one after the
other; errors and CPU seconds are the medians of three runs (GTSAM may be another environment's of the same Python: its
folder `site-packages` last in PYTHONPATH). One set of defaults.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from edge_scores import area_under_roc
from edges_peers import consecutive, gtsam_gnc, installed_peers, open3d_line_process

from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.solvers.backbone.chain import make_chain
from hodge_pipeline.solvers.backbone.sequence import linear_forest, sequential_edges
from hodge_pipeline.types import Floats, ViewGraph

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data" / "pose_graphs" / "slam_loops"
BICOCCA_M, ROBOTCAR_M = 1.5, 5.0
STAMP_S = 0.2
MOST_OF_OPEN3D = 1000
"""Vertices that Open3D's line process is given: it holds a dense matrix, of 20 GB for 8358 of them."""
COLUMNS = ("graph", "loops, right", "odometry", "diagnosis", "CPU s", "used, wrong, lost", "AUC")


def position_error(positions: Floats, truth: Floats) -> float:
    """RMS metres after a rigid fit, over the vertices whose truth is known."""
    known = np.isfinite(truth[:, 0])
    a, b = positions[known, : truth.shape[1]], truth[known]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    turn = u @ np.diag([1.0] * (len(u) - 1) + [np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.sqrt((((a - a.mean(0)) @ turn.T + b.mean(0) - b) ** 2).sum(axis=1).mean()))


def bicocca(folder: Path, graph: ViewGraph) -> tuple[Floats, Floats]:
    """True positions (V, 2), and how far each edge (E,) is from them; NaN where no stamp is near."""
    stamps, rows = np.loadtxt(folder / "stamps.txt"), np.loadtxt(folder / "truth.csv", delimiter=",")
    nearest = np.array([np.argmin(np.abs(rows[:, 0] - stamps[vertex])) for vertex in graph.vertex_ids])
    x, y, heading = rows[nearest, 1:4].T
    known = np.abs(rows[nearest, 0] - stamps[graph.vertex_ids]) < STAMP_S
    places = np.where(known[:, None], np.stack([x, y], axis=1), np.nan)
    i, j = graph.edges.T
    apart = places[j] - places[i]
    cos, sin = np.cos(heading[i]), np.sin(heading[i])
    ahead = np.stack([cos * apart[:, 0] + sin * apart[:, 1], -sin * apart[:, 0] + cos * apart[:, 1]], axis=1)
    return places, np.linalg.norm(ahead - graph.i_from_j[:, :2, 3], axis=1)


def robotcar(folder: Path, graph: ViewGraph) -> tuple[Floats, Floats]:
    """True positions (V, 3), and how far the length of each edge (E,) is from that between them."""
    rows = np.loadtxt(folder / "truth_xyz.txt")
    places = np.full((graph.vertex_count, 3), np.nan)
    places[rows[:, 0].astype(int)] = rows[:, 1:4]
    apart = np.linalg.norm(places[graph.edges[:, 0]] - places[graph.edges[:, 1]], axis=1)
    return places, np.abs(apart - np.linalg.norm(graph.i_from_j[:, :3, 3], axis=1))


def odometry(graph: ViewGraph) -> Floats:
    """The poses (V, 4, 4) of the consecutive edges alone."""
    chain = make_chain(graph, linear_forest(graph.edges, graph.vertex_count, sequential_edges(graph)))
    poses = np.empty((graph.vertex_count, 4, 4))
    poses[chain.order] = chain.poses
    return poses


def timed(call: Callable[[], Floats], places: Floats, runs: int) -> tuple[float, float]:
    """The medians over the runs of the position error in metres and of CPU seconds."""
    errors, seconds = [], []
    for _ in range(runs):
        before = time.process_time()
        poses = call()
        seconds.append(time.process_time() - before)
        errors.append(position_error(poses[:, :3, 3], places))
    return float(np.median(errors)), float(np.median(seconds))


def line(
    name: str, graph: ViewGraph, places: Floats, off_m: Floats, limit_m: float, peers: dict[str, str], runs: int
) -> dict[str, Any]:
    """One row of the table."""
    loops, right = ~consecutive(graph) & np.isfinite(off_m), off_m < limit_m
    found = diagnose(graph)
    error, seconds = timed(lambda: diagnose(graph).world_from_cam, places, runs)
    used = found.kept & loops
    both = right[loops].any() and not right[loops].all()
    score = np.nan_to_num(found.probability[loops], nan=0.5)
    row: dict[str, Any] = {
        "graph": name,
        "loops": int(loops.sum()),
        "right": int((right & loops).sum()),
        "odometry_m": position_error(odometry(graph)[:, :3, 3], places),
        "diagnosis_m": error,
        "cpu_s": seconds,
        "used": int(used.sum()),
        "wrong": int((used & ~right).sum()),
        "lost": int((~used & right & loops).sum()),
        "auc": area_under_roc(score, right[loops]) if both else float("nan"),
    }
    calls: dict[str, Callable[[], Floats]] = {
        "GTSAM GNC": lambda: gtsam_gnc(graph, True, stated=True)[1],
        "Open3D line process": lambda: open3d_line_process(graph)[1],
    }
    for peer, reason in peers.items():
        if peer.startswith("Open3D") and graph.vertex_count > MOST_OF_OPEN3D:
            reason = f"not run: {graph.vertex_count} vertices"
        row[peer] = reason or "{:.2f} ({:.1f} s)".format(*timed(calls[peer], places, runs))
    return row


def peers_at_hand() -> dict[str, str]:
    """The other programs, each with why it is left out, empty where it is not."""
    installed = " ".join(installed_peers()).lower()
    return {
        peer: "" if word in installed else f"not installed: {word}"
        for peer, word in (("GTSAM GNC", "gtsam"), ("Open3D line process", "open3d"))
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=SHARED)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--alone", action="store_true", help="without the other programs")
    parser.add_argument("--runs", type=int, default=3, help="whose medians are given")
    arguments = parser.parse_args()
    peers = {} if arguments.alone else peers_at_hand()
    rows = []
    print(f"| {' | '.join((*COLUMNS, *peers))} |\n|{'---|' * (len(COLUMNS) + len(peers))}")
    graphs = [(path, bicocca, BICOCCA_M, path.parent) for path in sorted((arguments.folder / "bicocca").glob("*.g2o"))]
    graphs += [
        (path, robotcar, ROBOTCAR_M, path.parent)
        for path in sorted((arguments.folder / "robotcar").glob("*/graph.g2o"), reverse=True)
    ]
    for path, truth, limit_m, folder in graphs:
        graph = read_graph(path).graph
        assert graph is not None
        places, off_m = truth(folder, graph)
        name = path.stem if path.stem != "graph" else f"RobotCar {folder.name}"
        row = line(name, graph, places, off_m, limit_m, peers, arguments.runs)
        rows.append(row)
        cells = [
            row["graph"],
            f"{row['loops']}, {row['right']}",
            f"{row['odometry_m']:.2f}",
            f"{row['diagnosis_m']:.2f}",
            f"{row['cpu_s']:.2f}",
            f"{row['used']}, {row['wrong']}, {row['lost']}",
            f"{row['auc']:.3f}",
            *(row[peer] for peer in peers),
        ]
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()

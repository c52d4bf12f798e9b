"""Which edges of real pairwise estimates are wrong: every method x scene of a folder, beside two other programs.

    python benchmarks/edges.py                              # ../shared/data/fragments/pair_estimates
    python benchmarks/edges.py FOLDER --json edges.json     # folders SCENE/{METHOD.log, gt.log, gt.info} of 3DMatch

A pair is right when eᵀ Λ e / Λ[0,0] ≤ (0.2 m)², e = (t, q_vec) of inv(gt) · estimate, Λ from gt.info; a pair that
gt.log does not list when it agrees with the chained true poses within 0.3 m and 10°. `pose recall` is the same test on
the relative poses of the solution, over all pairs of gt.log; pairs in two pieces fail. AUC is of the probability that
an edge is right. The oracle is told which edges are right. CPU seconds of one call; set OMP_NUM_THREADS=1.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from edge_scores import PairTruth, area_under_roc, pose_recall, precision_and_recall, read_estimates
from edges_peers import LEVER_M, Answer, Peer, installed_peers

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Bools, Floats, ViewGraph

COLUMNS = ("method", "precision", "recall", "pose recall", "AUC", "untestable", "pieces", "CPU s")


def diagnosis(graph: ViewGraph) -> tuple[Answer, Floats]:
    """The diagnosis with its defaults."""
    found = diagnose(graph)
    return (found.kept, found.world_from_cam, found.piece), found.probability


def oracle(graph: ViewGraph, right: Bools) -> Answer:
    """What the right edges alone give."""
    chosen = graph.select(np.flatnonzero(right))
    information = np.diag([LEVER_M**2] * 3 + [1.0] * 3)
    chosen = replace(chosen, information=np.tile(information, (chosen.edge_count, 1, 1)))
    poses = solve(chosen, objective="isotropic").world_from_cam
    return right, poses, connected_components(chosen.edges, graph.vertex_count)


def row(name: str, call: Callable[[], tuple[Answer, Floats | None]], truth: PairTruth, right: Bools) -> dict[str, Any]:
    """One line: what a method keeps and where it puts the views."""
    start = time.process_time()
    (kept, poses, piece), probability = call()
    seconds = time.process_time() - start
    precision, recall = precision_and_recall(kept, right)
    return {
        "method": name,
        "precision": precision,
        "recall": recall,
        "pose recall": pose_recall(truth, poses, piece),
        "AUC": None if probability is None else area_under_roc(probability, right),
        "untestable": None if probability is None else int(np.isnan(probability).sum()),
        "pieces": sorted(np.bincount(piece).tolist(), reverse=True),
        "CPU s": seconds,
    }


def scene(log: Path, peers: dict[str, Peer]) -> dict[str, Any]:
    """The table of one graph."""
    graph, truth, right = read_estimates(log)
    rows = [row("hodge diagnosis", lambda: diagnosis(graph), truth, right)]
    for name, peer in peers.items():
        rows.append(row(name, lambda peer=peer: (peer(graph), None), truth, right))
    rows.append(row("oracle", lambda: (oracle(graph, right), None), truth, right))
    name = f"{log.parent.name.removesuffix('-evaluation')} {log.stem}"
    return {
        "scene": name,
        "vertices": graph.vertex_count,
        "edges": graph.edge_count,
        "right": int(right.sum()),
        "rows": rows,
    }


def shown(value: Any) -> str:
    """A cell of the table."""
    if value is None:
        return ""
    if isinstance(value, list):
        return " + ".join(map(str, value[:6])) + (f" + {len(value) - 6} more" if len(value) > 6 else "")
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def print_scene(found: dict[str, Any]) -> None:
    """The Markdown table of one graph."""
    print(
        f"\n**{found['scene']}**: {found['vertices']} views, {found['edges']} edges, {found['right']} of them right\n"
    )
    print("|" + "|".join(COLUMNS) + "|", "|" + "---|" * len(COLUMNS), sep="\n")
    for line in found["rows"]:
        print("|" + "|".join(shown(line[column]) for column in COLUMNS) + "|", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data = Path(os.environ.get("HODGE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    parser.add_argument("folder", nargs="?", type=Path, default=data / "fragments" / "pair_estimates")
    parser.add_argument("--json", type=Path, help="write all numbers there too")
    parser.add_argument("--only", default="", help="graphs whose path contains this")
    parser.add_argument("--no-peers", action="store_true", help="without Open3D and GTSAM")
    options = parser.parse_args()
    logs = [log for log in sorted(options.folder.rglob("*.log")) if log.stem != "gt" and options.only in str(log)]
    logs = [log for log in logs if (log.parent / "gt.log").is_file() and (log.parent / "gt.info").is_file()]
    if not logs:
        parser.error(f"{options.folder}: no SCENE/METHOD.log beside a gt.log and gt.info in it")
    peers = {} if options.no_peers else installed_peers()
    found = []
    for log in logs:
        found.append(scene(log, peers))
        print_scene(found[-1])
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

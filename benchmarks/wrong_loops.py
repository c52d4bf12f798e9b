"""What wrong edges do to graphs whose right answer is known: one line for each graph, and sums of each kind.

    python -m benchmarks.wrong_loops random              # every loop of the SLAM graphs replaced: the odometry stays
    python -m benchmarks.wrong_loops replaced            # and of graphs of the literature, by groups that agree
    python -m benchmarks.wrong_loops breaks              # one step of a path broken by 5 m and 30°, at 20 places
    python -m benchmarks.wrong_loops classical           # loops put into graphs of the literature
    python -m benchmarks.wrong_loops clean               # graphs that nobody spoilt: how many edges are blamed
    python -m benchmarks.wrong_loops simulated --seed 1  # walks with 0 to 200 wrong loops, alone and in groups
    python -m benchmarks.wrong_loops short --seed 1      # walks of 15 to 95 steps with few loops, some steps wrong
    python -m benchmarks.wrong_loops mistaken --seed 1   # walks with a loop a step, many of them mistaken in one way
    python -m benchmarks.wrong_loops alike --seed 1      # storeys, decks and rows taken for the next
    python -m benchmarks.wrong_loops biased --seed 1     # odometry that turns too far at each step
    python -m benchmarks.wrong_loops drifting --seed 1   # and whose turns drift
    python -m benchmarks.wrong_loops closing --seed 1    # rings that close at one place, wrong loops as in Vertigo
    python -m benchmarks.wrong_loops lattices --seed 1   # cylinders and grids with 1 to 20 % of all edges wrong
    python -m benchmarks.wrong_loops windows --seed 1    # walks with edges over two steps to ten: a sliding window
    python -m benchmarks.wrong_loops sessions --seed 1   # walks cut into two to five sessions that loops alone join

Errors are metres RMS of positions after a rigid fit: to the truth, or for graphs of the literature to their own
solution without the injected loops. WORSE: than 1.02 × the odometry, each path of it fitted by itself, since nothing
says where paths lie that no loop joins. `--only WORD` takes the graphs whose name has the word.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from alike_worlds import alike_cases
from biased_worlds import biased_cases, drifting_cases
from closing_worlds import closing_cases
from edges_peers import consecutive as steps
from slam_loops import odometry, position_error
from spoilt_graphs import KINDS, Case

from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Floats, ViewGraph

MORE = 1.02


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    more = {"alike": alike_cases, "biased": biased_cases, "drifting": drifting_cases, "closing": closing_cases}
    kinds = {**KINDS, **more}
    parser.add_argument("kind", choices=kinds)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="graphs whose name has this word")
    arguments = parser.parse_args()
    print("graph | edges, wrong | odometry m | right alone m | result m | wrong kept, right blamed | CPU s", flush=True)
    cases = [case for case in kinds[arguments.kind](arguments.seed) if arguments.only in case.name]
    total, worse, kept, blamed = 0.0, 0, 0, 0
    for case in cases:
        before = time.process_time()
        found = diagnose(case.graph)
        seconds = time.process_time() - before
        chain = odometry(case.graph)
        error, bare = (position_error(poses[:, :3, 3], case.places) for poses in (found.world_from_cam, chain))
        alone = right_alone(case)
        false, lost = int((found.kept & ~case.right).sum()), int((~found.kept & case.right).sum())
        total, kept, blamed = total + seconds, kept + false, blamed + lost
        bad = by_path(found.world_from_cam, case) > MORE * by_path(chain, case)
        worse += bad
        wrong = int((~case.right).sum())
        cells = case.name, f"{len(case.right)}, {wrong}", f"{bare:.2f}", f"{alone:.2f}", f"{error:.2f}"
        print(" | ".join((*cells, f"{false}, {lost}", f"{seconds:.1f}")), "WORSE" if bad else "", flush=True)
    counts = f"{kept} wrong edges kept, {blamed} right ones not"
    print(f"{len(cases)} graphs, {total:.0f} CPU s; {counts}; {worse} worse than the odometry")


def by_path(poses: Floats, case: Case) -> float:
    """The error of poses (V, 4, 4) with each path of the consecutive edges fitted to the truth by itself."""
    path = connected_components(case.graph.edges[steps(case.graph)], case.graph.vertex_count)
    path = np.where(np.isfinite(case.places[:, 0]), path, -1)
    squares = 0.0
    for rows in (np.flatnonzero(path == number) for number in range(path.max() + 1)):
        if len(rows) > 1:
            squares += len(rows) * position_error(poses[rows, :3, 3], case.places[rows]) ** 2
    return float(np.sqrt(squares / (path >= 0).sum()))


def right_alone(case: Case) -> float:
    """The error of a solve with the right edges alone; infinite where they leave the graph in pieces."""
    rows, graph = np.flatnonzero(case.right), case.graph
    motions, information = graph.i_from_j[rows], graph.information[rows]
    alone = ViewGraph.from_edges(graph.vertex_ids, graph.edges[rows], motions, information=information)
    try:
        return position_error(solve(alone).world_from_cam[:, :3, 3], case.places)
    except GraphError:
        return float("inf")


if __name__ == "__main__":
    main()

"""The same ω through the embedding surface and through the plain graph Laplacian: accuracy, spread, size, time.

    python -m benchmarks.paper.surface runs/paper/redkitchen-distance [round]

reads the registered edges of a finished run (its first round, unless another is given) and prints a Markdown table.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.paper.sequences import recipe_file
from hodge_paper.minimum_cycles import shortest_loops
from hodge_paper.solver import PaperSolver
from hodge_pipeline.evaluation.scores import score_table
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import true_poses
from hodge_pipeline.solvers import poisson
from hodge_pipeline.solvers.poisson import PoissonSolver
from hodge_pipeline.stages import ConsistencySolver
from hodge_pipeline.types import Floats, Solution, ViewGraph

SEEDS = 20
SCORED_SEEDS = 3  # a score costs ten CPU seconds for each set of poses, an ATE nothing


@dataclass(frozen=True)
class Problem:
    """One round's edges, the poses it started from, the truth."""

    graph: ViewGraph
    start: Floats
    truth: Floats
    clouds: Path


def read_problem(run: Path, round_number: int) -> Problem:
    """The problem that a round of a finished run solved."""
    found = Run.load(run)
    solved = found.rounds[round_number]
    graph = solved.edges.as_graph(solved.vertex_ids, solved.edges.counts)
    truth, clouds = true_poses(found.source)[found.key_frames.rows], found.clouds.folder
    assert clouds is not None
    return Problem(graph, found.rounds[round_number - 1].world_from_cam, truth, clouds)


def solve_all(problem: Problem, make: Callable[[int], ConsistencySolver], seeds: int) -> tuple[list[Solution], float]:
    """The solutions for each seed, and the mean CPU seconds of one."""
    begin = time.process_time()
    solutions = [make(seed).solve(problem.graph, problem.start) for seed in range(seeds)]
    return solutions, (time.process_time() - begin) / seeds


def spread(values: list[float], digits: int) -> str:
    """Mean, and the range where there are several."""
    mean = f"{np.mean(values):.{digits}f}"
    return mean if len(values) == 1 else f"{mean} ({min(values):.{digits}f}–{max(values):.{digits}f})"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a finished run")
    parser.add_argument("round", type=int, nargs="?", default=1)
    given = parser.parse_args()
    poisson.tree_loops = shortest_loops  # D of both solvers over the same loops
    problem = read_problem(given.run, given.round)
    makers: dict[str, tuple[Callable[[int], ConsistencySolver], int]] = {
        "graph, pairing": (lambda seed: PoissonSolver(log="pairing"), 1),
        "graph, se(3)": (lambda seed: PoissonSolver(), 1),
        "surface, random, pairing": (lambda seed: PaperSolver(seed=seed), SEEDS),
        "surface, random, se(3)": (lambda seed: PaperSolver(seed=seed, log="se3"), SEEDS),
        "surface, angular, pairing": (lambda seed: PaperSolver(rotation="angular"), 1),
        "surface, angular, se(3)": (lambda seed: PaperSolver(rotation="angular", log="se3"), 1),
    }
    found = {name: solve_all(problem, *make) for name, make in makers.items()}
    sets = {"truth": problem.truth}
    for name, (solutions, _) in found.items():
        sets |= {f"{name} {seed}": solution.world_from_cam for seed, solution in enumerate(solutions[:SCORED_SEEDS])}
    with load_recipe(recipe_file("distance")).executor.open() as workers:
        table = score_table(problem.clouds, sets, "truth", workers)
    scores = {graph.kind: dict(zip(table.names, graph.mean_score, strict=True)) for graph in table.graphs}
    truth = ", ".join(f"{kind} {score['truth']:.4f}" for kind, score in scores.items())
    print(f"V {problem.graph.vertex_count}, E {problem.graph.edge_count}; scores of the true poses: {truth}\n")
    print("| solver | ATE, m | score, distance | score, IoU | D, step 1 | cells | genus | longest cell | CPU, s |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name, (solutions, cpu_s) in found.items():
        errors = [absolute_error(one.world_from_cam, problem.truth).rmse_m for one in solutions]
        of = {
            kind: [score[f"{name} {seed}"] for seed in range(min(len(solutions), SCORED_SEEDS))]
            for kind, score in scores.items()
        }
        first = [one.history[0].metrics["loop_deviation_sum"] for one in solutions]
        sizes = [
            spread([one.metrics[key] for one in solutions], 0) if key in solutions[0].metrics else "–"
            for key in ("cells", "genus", "longest_cell")
        ]
        cells = (spread(errors, 4), spread(of["distance"], 4), spread(of["iou"], 4), spread(first, 3), *sizes)
        print(f"| {name} | {' | '.join(cells)} | {cpu_s:.2f} |")


if __name__ == "__main__":
    main()

"""Whether the probability of an edge is one: how many edges of a probability are right; and right graphs left in peace.

    python -m benchmarks.reliability                 # 60 simulated graphs, and the real ones of shared/data
    python -m benchmarks.reliability --right 200     # simulated graphs without a wrong edge: in how many is one blamed?

The expected calibration error (ECE) is the mean distance of ten classes' probability from the share that is right, each
class by its edges; untestable edges have no probability. The form of the probability was compared with others on such
simulations, of other seeds, and on the real graphs.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from benchmarks.edge_scores import read_estimates
from benchmarks.simulated_edges import several
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.types import Bools, Floats

CLASSES = 10


def classes(probability: Floats, right: Bools) -> list[tuple[int, float, float]]:
    """(edges, mean probability, share that is right) of each class of probability that has any."""
    known = np.isfinite(probability)
    row = np.minimum((CLASSES * probability[known]).astype(int), CLASSES - 1)
    count = np.bincount(row, minlength=CLASSES)
    sums = (np.bincount(row, values, CLASSES) for values in (probability[known], right[known].astype(float)))
    mean, share = (total / np.maximum(count, 1) for total in sums)
    return [(int(count[k]), float(mean[k]), float(share[k])) for k in range(CLASSES) if count[k]]


def expected_calibration_error(probability: Floats, right: Bools) -> float:
    """ECE; NaN where no edge has a probability."""
    found = classes(probability, right)
    total = sum(count for count, _, _ in found)
    return sum(count * abs(mean - share) for count, mean, share in found) / total if total else float("nan")


def _report(name: str, graphs: list[tuple[Floats, Bools]]) -> None:
    each = [expected_calibration_error(*graph) for graph in graphs]
    pooled = np.concatenate([p for p, _ in graphs]), np.concatenate([r for _, r in graphs])
    print(f"\n**{name}**: {len(graphs)} graphs, ECE of all edges {expected_calibration_error(*pooled):.3f}, ", end="")
    print(f"mean of graphs {np.nanmean(each):.3f}, worst {np.nanmax(each):.3f}\n")
    print("| edges | probability | right | |\n|---:|---:|---:|---|")
    for count, mean, share in classes(*pooled):
        print(f"| {count} | {mean:.2f} | {share:.2f} | {'#' * round(20 * share)} |", flush=True)


def _real(folder: Path) -> list[tuple[Floats, Bools]]:
    out = []
    for log in sorted(folder.rglob("*.log")):
        if log.stem == "gt" or not (log.parent / "gt.info").is_file():
            continue
        graph, _, right = read_estimates(log)
        out.append((diagnose(graph).probability, right))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--graphs", type=int, default=60, help="simulated graphs")
    parser.add_argument(
        "--right", type=int, default=0, help="instead, so many graphs of either law without a wrong edge"
    )
    options = parser.parse_args()
    if options.right:
        for law, heavy_tails in (("Gaussian", False), ("Student's t, 4 degrees of freedom", True)):
            graphs = several(range(options.right), 0.0, heavy_tails)
            found = [(kind, int((~diagnose(graph).kept & right).sum())) for kind, graph, right in graphs]
            blamed = [each for each in found if each[1]]
            print(
                f"errors {law}: right edges are blamed in {len(blamed)} of {options.right} graphs: {blamed}", flush=True
            )
        return
    simulations: dict[str, list[tuple[Floats, Bools]]] = {}
    for kind, graph, right in several(range(options.graphs)):
        simulations.setdefault(f"simulated, {kind}", []).append((diagnose(graph).probability, right))
    for kind, graphs in simulations.items():
        _report(kind, graphs)
    data = Path(os.environ.get("HODGE_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    real = _real(data / "fragments" / "pair_estimates")
    if real:
        _report("real fragments of rooms", real)


if __name__ == "__main__":
    main()

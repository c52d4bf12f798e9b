"""Wrong edges put into good graphs: how well the diagnosis tells them from the others, before any solve.

    python benchmarks/injected_edges.py runs/kitchen                 # a finished run, or a pose graph
    python benchmarks/injected_edges.py runs/kitchen --plot roc.png --json injected.json

A share of the loop edges (those between frames that do not follow each other) gets another motion, the pairs stay:

- random: each that of two other frames, drawn at random, as when a place is taken for another;
- consistent: of the loop edges between two places (frames 20 apart at least) neighbouring ones in groups of 20, all
  of a group displaced by one wrong motion, as when a whole place looks like another: they agree with each other;
- near: the same of the loop edges between frames less than 20 apart, as when one shelf looks like the next;
- slight: near, by 10 to 30 cm and 5 to 10° about the place.

AUC: the probability that an edge which was left alone has the higher probability of being right; the original graph
counts as right, edges without a probability are left out and counted. `found`: the share of the wrong edges that is
below a threshold which 1 % (5 %) of the others are below. Means of the seeds, the worst AUC beside.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from edge_scores import area_under_roc, precision_and_recall

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph
from hodge_pipeline.uses.diagnosed import open_subject

SHARES = (0.01, 0.05, 0.2, 0.5)
GROUP = 20
PLACES_APART = 20
NEVER_NEAR_RAD, NEVER_NEAR = 0.35, 0.25
"""A wrong motion is at least so far from the right one: 20°, or this share of the scene's extent."""
COLUMNS = ("wrong", "injected", "AUC", "worst", "found at 1 %", "found at 5 %", "kept, right", "untestable", "CPU s")
Inject = Callable[[ViewGraph, Floats, Ints, int, np.random.Generator], ViewGraph]
Motion = Callable[[Floats, float, np.random.Generator], Floats]


def is_wrong(motion: Floats, other: Floats, extent_m: float) -> bool:
    """Whether two motions differ by more than any noise."""
    left = se3.inverse(motion) @ other
    angle = float(np.linalg.norm(se3.so3_log(left[None, :3, :3])))
    return angle > NEVER_NEAR_RAD or float(np.linalg.norm(left[:3, 3])) > NEVER_NEAR * extent_m


def random(graph: ViewGraph, poses: Floats, loops: Ints, count: int, rng: np.random.Generator) -> ViewGraph:
    """The graph with the motions of two other frames in `count` loop edges."""
    motions, extent_m = graph.i_from_j.copy(), float(np.ptp(poses[:, :3, 3], axis=0).max())
    for row in rng.choice(loops, count, replace=False).tolist():
        while not is_wrong(graph.i_from_j[row], motions[row], extent_m):
            a, b = rng.choice(len(poses), 2, replace=False)
            motions[row] = se3.inverse(poses[a]) @ poses[b]
    return replace(graph, i_from_j=motions)


def large(centre: Floats, extent_m: float, rng: np.random.Generator) -> Floats:
    """A motion (4, 4) of the world as when a place is taken for any other."""
    axis = rng.normal(size=3)
    turn = axis / np.linalg.norm(axis) * rng.uniform(0.5, np.pi)
    return se3.from_parts(se3.so3_exp(turn), rng.uniform(-0.5, 0.5, 3) * extent_m)


def small(centre: Floats, extent_m: float, rng: np.random.Generator) -> Floats:
    """A motion (4, 4) of the world as when a place is taken for the one beside it."""
    axis, aside = rng.normal(size=(2, 3))
    turn = se3.so3_exp(axis / np.linalg.norm(axis) * np.radians(rng.uniform(5, 10)))
    return se3.from_parts(turn, centre - turn @ centre + aside / np.linalg.norm(aside) * rng.uniform(0.1, 0.3))


def in_groups(
    graph: ViewGraph, poses: Floats, loops: Ints, count: int, rng: np.random.Generator, motion: Motion = large
) -> ViewGraph:
    """The graph with `count` loop edges in groups, each displaced by one wrong motion of the world."""
    motions, extent_m = graph.i_from_j.copy(), float(np.ptp(poses[:, :3, 3], axis=0).max())
    i, j = graph.edges[loops].T
    low, high = np.minimum(i, j), np.maximum(i, j)
    free = np.ones(len(loops), bool)
    while count:
        seed = rng.choice(np.flatnonzero(free))
        away = np.abs(low - low[seed]) + np.abs(high - high[seed])
        group = np.flatnonzero(free)[np.argsort(away[free], kind="stable")[: min(GROUP, count)]]
        displaced = motion(poses[high[seed], :3, 3], extent_m, rng)
        at = poses[low[group]]
        low_from_high = np.where((i < j)[group, None, None], motions[loops[group]], se3.inverse(motions[loops[group]]))
        moved = se3.inverse(at) @ displaced @ at @ low_from_high
        motions[loops[group]] = np.where((i < j)[group, None, None], moved, se3.inverse(moved))
        free[group] = False
        count -= len(group)
    return replace(graph, i_from_j=motions)


KINDS: dict[str, Inject] = {
    "random": random,
    "consistent": in_groups,
    "near": in_groups,
    "slight": partial(in_groups, motion=small),
}


def candidates(graph: ViewGraph, kind: str) -> Ints:
    """The rows of the edges that this kind replaces some of."""
    gap = np.abs(graph.edges[:, 1] - graph.edges[:, 0])
    if kind in ("near", "slight"):
        return np.flatnonzero((gap > 1) & (gap < PLACES_APART))
    return np.flatnonzero(gap >= PLACES_APART if kind == "consistent" else gap > 1)


def found_at(score: Floats, right: Bools, lost: float) -> float:
    """The share of the wrong edges below the threshold that this share of the right ones is below."""
    known = ~np.isnan(score)
    limit = np.quantile(score[known & right], lost)
    return float((score[known & ~right] < limit).mean())


def curve(score: Floats, right: Bools) -> tuple[Floats, Floats]:
    """The share of right edges lost, and of wrong edges found, at every threshold."""
    known = ~np.isnan(score)
    order = np.argsort(score[known], kind="stable")
    good = right[known][order]
    return np.cumsum(good) / max(good.sum(), 1), np.cumsum(~good) / max((~good).sum(), 1)


def measure(graph: ViewGraph, poses: Floats, kind: str, share: float, seeds: int) -> dict[str, Any]:
    """One line of the table."""
    loops = candidates(graph, kind)
    count = max(1, round(share * len(loops)))
    found: list[dict[str, Any]] = []
    for seed in range(seeds):
        spoiled = KINDS[kind](graph, poses, loops, count, np.random.default_rng(seed))
        right = (spoiled.i_from_j == graph.i_from_j).all(axis=(1, 2))
        start = time.process_time()
        told = diagnose(spoiled)
        seconds = time.process_time() - start
        score = told.probability
        one = {"AUC": area_under_roc(score, right), "found at 1 %": found_at(score, right, 0.01)}
        one |= {"found at 5 %": found_at(score, right, 0.05), "kept, right": precision_and_recall(told.kept, right)[0]}
        found.append({**one, "untestable": int(np.isnan(score).sum()), "CPU s": seconds, "curve": curve(score, right)})
    means = {name: float(np.mean([one[name] for one in found])) for name in found[0] if name != "curve"}
    worst = min(one["AUC"] for one in found)
    return {"kind": kind, "share": share, "injected": count, "worst": worst, "curve": found[0]["curve"], **means}


def plot(path: Path, rows: list[dict[str, Any]], title: str) -> None:
    """The ROC of each line, of its first seed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 6.4), layout="constrained")
    FigureCanvasAgg(figure)
    styles = ("-", "--", "-.", ":")
    for axes, kind in zip(figure.subplots(2, 2, sharey=True).flat, KINDS, strict=True):
        for row, style in zip([row for row in rows if row["kind"] == kind], styles, strict=True):
            label = f"{100 * row['share']:g} %: AUC {row['AUC']:.3f}"
            axes.plot(*row["curve"], style, label=label, linewidth=1.6)
        axes.set_xscale("symlog", linthresh=0.01)
        axes.set_xticks([0, 0.01, 0.1, 1], ["0", "1 %", "10 %", "100 %"])
        axes.set_xlim(0, 1)
        axes.set_title(f"{title}: {kind}", fontsize=9)
        axes.set_xlabel("right edges lost")
        axes.legend(loc="lower right", fontsize=8, frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_ylabel("wrong edges found")
    figure.savefig(path, dpi=140, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graphs", nargs="+", type=Path, help="finished runs, or pose graphs")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--plot", type=Path, help="write the ROC curves of the first graph there")
    parser.add_argument("--json", type=Path, help="write all numbers there too")
    options = parser.parse_args()
    everything: dict[str, list[dict[str, Any]]] = {}
    for path in options.graphs:
        subject = open_subject(path)
        poses = diagnose(subject.graph).world_from_cam
        print(f"\n**{subject.name}**: {subject.graph.vertex_count} frames, {subject.graph.edge_count} edges\n")
        print("|" + "|".join(COLUMNS) + "|", "|" + "---|" * len(COLUMNS), sep="\n")
        rows = []
        for kind in KINDS:
            for share in SHARES:
                rows.append(measure(subject.graph, poses, kind, share, options.seeds))
                cells = [f"{100 * share:g} % {kind}", str(rows[-1]["injected"])]
                cells += [f"{rows[-1][name]:.3f}" for name in COLUMNS[2:]]
                print("|" + "|".join(cells) + "|", flush=True)
        if options.plot and not everything:
            plot(options.plot, rows, subject.name)
        everything[subject.name] = [{k: v for k, v in row.items() if k != "curve"} for row in rows]
    if options.json:
        options.json.write_text(json.dumps(everything, indent=1) + "\n")


if __name__ == "__main__":
    main()

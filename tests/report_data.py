"""A small report to judge and to render, and pages read back."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.evaluation.residuals import edge_residuals, with_residuals
from hodge_pipeline.evaluation.scores import GraphScores, ScoreTable
from hodge_pipeline.report.contents import (
    LoopRow,
    Path3D,
    Pictures,
    Report,
    Residuals,
    SourceSummary,
    StageRow,
    TrajectoryRow,
)
from hodge_pipeline.report.summary import graph_summary, trajectory_rows, worst_edges
from hodge_pipeline.types import Edges, Floats, ViewGraph
from hodge_pipeline.types.notes import Note

VOID = {"meta", "img", "br"}


def circle(count: int = 20) -> Floats:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    zeros = np.zeros(count)
    turned = se3.exp(np.stack([zeros, zeros, angle, zeros, zeros, zeros], axis=1))
    turned[:, :3, 3] = np.stack([np.cos(angle), np.sin(angle), zeros], axis=1)
    return turned


def shaken(poses: Floats, size: float) -> Floats:
    return poses @ se3.exp(np.random.default_rng(0).normal(scale=size, size=(len(poses), 6)))


def ring(poses: Floats) -> ViewGraph:
    """Each frame with the next, measured exactly, but for one edge that is 0.5 m off."""
    count = len(poses)
    edges = np.array([(k, (k + 1) % count) for k in range(count)])
    i_from_j = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
    i_from_j[7, 0, 3] += 0.5
    return ViewGraph.from_edges(np.arange(100, 100 + count), edges, i_from_j, source="sequential")


def scored(*mean_distances_m: float) -> ScoreTable:
    distances_m = np.outer(mean_distances_m, [0.9, 1.0, 1.1])
    pairs = np.array([(0, 1), (1, 2), (2, 3)])
    graphs = (GraphScores("distance", pairs, distances_m), GraphScores("iou", pairs, distances_m))
    return ScoreTable(("truth", "odometry", "result"), "truth", graphs)


def make_report() -> Report:
    truth = circle()
    sets = {"odometry": shaken(truth, 0.03), "result": shaken(truth, 0.003)}
    graph = ring(truth)
    weights = np.ones(20)
    weights[3] = 0
    edges = with_residuals(Edges.measured(graph), sets["result"], weights)
    rejected = Edges.of([[0, 5]] * 5).put(slice(None), status="rejected", why="fitness below 0.3")
    return Report(
        title="A <ring> & its loop",
        source=SourceSummary(
            "seven_scenes", "data/ring", 20, 20, ("one", "two"), ("1 frame was unreadable: left out",)
        ),
        scores=scored(0.010, 0.020, 0.012),
        trajectories=trajectory_rows(sets, truth),
        loops=(LoopRow("measured", 4, 2.0), LoopRow("step 1", 4, 1e-3)),
        graph=graph_summary(Edges.joined([edges, rejected]), graph.vertex_ids, np.zeros(20, np.int64)),
        worst_edges=worst_edges(edges, graph.vertex_ids, 3),
        stages=(StageRow("read", 1.0, 0.5, 100.0), StageRow("solve", 2.0, 3.5, 300.0)),
        notes=(Note("solver", detail="2 pairs were tried twice"),),
        versions={"hodge-pipeline": "0.1.0"},
        recipe="reader: seven_scenes  # <ring>\n",
        pictures=Pictures(
            paths=tuple(Path3D(name, poses[:, :3, 3]) for name, poses in {"truth": truth, **sets}.items()),
            component=np.zeros(20, np.int64),
            residuals=tuple(Residuals(name, *edge_residuals(graph, poses)) for name, poses in sets.items()),
            graph=graph,
            convergence={"first": (10.0, 2.0, 1.9)},
        ),
    )


class WellFormed(HTMLParser):
    """Fails on an element that is closed out of order; collects text and addresses."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.addresses: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name == "src"]
        self.links += [value or "" for name, value in attrs if name == "href"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def read_page(path: Path) -> tuple[str, list[str]]:
    page = WellFormed()
    page.feed(path.read_text("utf-8"))
    assert not page.open and all(link.startswith("#") for link in page.links)
    return "".join(page.text), page.addresses


def told(before_m: tuple[float, float], after_m: tuple[float, float], extent_m: float = 4.0) -> Report:
    """A report of ATE and RPE before and after alone, along a path of this extent."""
    rows = tuple(
        TrajectoryRow(name, 20, 0, ate, ate, ate, rpe, 0.2)
        for name, (ate, rpe) in (("odometry", before_m), ("result", after_m))
    )
    path = Path3D("result", np.array([[0.0, 0, 0], [extent_m, 0, 0]]))
    return Report("r", SourceSummary("tum", "x", 20), trajectories=rows, pictures=Pictures(paths=(path,)))

"""Log the edges by verdict, an entity for each verdict so that the viewer can show one alone."""

from __future__ import annotations

import numpy as np
import rerun as rr

from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import Part, log_markdown
from hodge_pipeline.types import Edges, Floats, ViewGraph
from hodge_pipeline.types.text import markdown_table

RADII = {CONSISTENT: -0.4, UNTESTABLE: -0.6, SUSPECT: -1.2, WRONG: -1.6}
"""Of the lines, in points of the screen (negative in Rerun): the worse the thicker."""
BYTES_EACH = 160
"""Of a recorded edge with its label."""
LISTED = 40
"""Edges in the table, the least likely first."""


def log_diagnosis(part: Part, graph: ViewGraph, world_from_cam: Floats, edges: Edges) -> None:
    """Log the edges by verdict, with probability and reason as label."""
    log_markdown(part.stream, layout.DIAGNOSIS, summary(graph, edges))
    lines = shapes.segments(world_from_cam, graph.edges)
    drawable = np.isfinite(lines).all(axis=(1, 2))
    for name in sorted(set(edges.verdict.tolist()) | set(shapes.VERDICT_COLOURS)):
        rows = np.flatnonzero((edges.verdict == name) & drawable)
        max_bytes, what = part.options.max_bytes("solver") / 2, f"edges called {name} drawn"
        rows = rows[part.some(len(rows), shapes.MOST_LINES, BYTES_EACH, max_bytes, what)]
        labels = [_label(graph, edges, int(row)) for row in rows]
        colour, radius = shapes.VERDICT_COLOURS.get(name, shapes.RESULT_COLOUR), RADII.get(name, -0.8)
        strips = rr.LineStrips3D(lines[rows], colors=[colour], radii=[radius], labels=labels, show_labels=False)
        part.stream.log(layout.verdict(name), strips, static=True)


def summary(graph: ViewGraph, edges: Edges) -> str:
    """The verdicts counted, and the least probable edges with their reasons, as Markdown."""
    counted = zip(*np.unique(edges.verdict, return_counts=True), strict=True)
    text = f"# Which edge is wrong\n\n{markdown_table(('verdict', 'edges'), counted)}"
    if not (listed := _least_probable(edges)):
        return text
    rows = [
        (f"{i} – {j}", edges.verdict[row], _percent(edges.probability[row]), edges.why[row])
        for row in listed
        for i, j in [graph.vertex_ids[graph.edges[row]]]
    ]
    table = markdown_table(("edge", "verdict", "right with", "why"), rows)
    return f"{text}\n\n## The least probable\n\n{table}"


def _least_probable(edges: Edges) -> list[int]:
    rows = np.flatnonzero(np.isin(edges.verdict, (WRONG, SUSPECT)))
    chosen: list[int] = rows[np.argsort(edges.probability[rows], kind="stable")][:LISTED].tolist()
    return chosen


def _label(graph: ViewGraph, edges: Edges, row: int) -> str:
    i, j = graph.vertex_ids[graph.edges[row]]
    right = _percent(edges.probability[row])
    return f"{i} – {j}: {graph.source[row]}, {edges.verdict[row]}, {right}: {edges.why[row]}"


def _percent(probability: float) -> str:
    return "–" if np.isnan(probability) else f"{100 * probability:.3g} %"

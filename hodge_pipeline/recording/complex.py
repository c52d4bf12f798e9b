"""Log the complex of a round: triangles coloured by curl, and the energies of the parts of the 1-form."""

from __future__ import annotations

import numpy as np
import rerun as rr

from hodge_pipeline.complex.cech import SimplicialComplex
from hodge_pipeline.complex.parts import decompose, flag_of, one_form
from hodge_pipeline.errors import GraphError
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.curl import ALPHA, log_triangles, triangle_curl_m
from hodge_pipeline.recording.stream import log_markdown, log_notes
from hodge_pipeline.types import Floats, Ints, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly

TRIANGLE_BYTES, COLUMN_BYTES = 60, 28


def log_complex(
    stream: rr.RecordingStream,
    outer: int,
    graph: ViewGraph,
    start: Floats,
    solution: Solution,
    options: RecordingOptions,
    max_bytes: float,
) -> tuple[str, ...]:
    """Log triangles by curl, and the 1-form's energy before and after the solve; gives notes of what was thinned."""
    try:
        complex_ = flag_of(graph)
    except GraphError as error:
        notes = (f"recording: no triangles of round {outer} drawn: {error}",)
        log_notes(stream, outer, notes)
        return notes
    triangles = complex_.simplices[2]
    curl_m = triangle_curl_m(graph, triangles)
    if 0 < len(triangles) * COLUMN_BYTES <= max_bytes:
        _log_columns(stream, outer, triangles, curl_m)
    kept = options.count(options.edge_lines, len(triangles), TRIANGLE_BYTES, max_bytes)
    corners = solution.world_from_cam[triangles, :3, 3]
    drawable = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
    rows = drawable[np.argsort(curl_m[drawable], kind="stable")][evenly(len(drawable), kept)]
    colours = shapes.residual_colours(curl_m[rows], options.residual_scale_m)
    if len(rows):
        log_triangles(stream, layout.complex_mesh(outer), corners[rows], colours, np.full(len(rows), ALPHA, np.uint8))
    log_markdown(stream, layout.complex_text(outer), _text(outer, complex_, curl_m, _energy(graph, start, solution)))
    drawn = f"recording: {len(rows)} of {len(triangles)} triangles of round {outer} drawn"
    thinned = (drawn,) if len(rows) < len(triangles) else ()
    log_notes(stream, outer, thinned)
    return thinned


def _log_columns(stream: rr.RecordingStream, outer: int, triangles: Ints, curl_m: Floats) -> None:
    """Every triangle, drawn or not, as components that a program reads back."""
    stream.log(
        layout.complex_columns(outer),
        rr.AnyValues(a=triangles[:, 0], b=triangles[:, 1], c=triangles[:, 2], curl_m=curl_m.astype(np.float32)),
        static=True,
    )


def _energy(graph: ViewGraph, start: Floats, solution: Solution) -> list[str]:
    """Table rows: the share of each part in rotation and in translation, before and after the solve, of edges used."""
    used, rows = graph.select(solution.weights > 0), []
    complex_ = flag_of(used)
    for when, poses in (("before", start), ("after", solution.world_from_cam)):
        if not np.isfinite(poses).all():
            continue
        found = decompose(complex_, one_form(used, poses, solution.component)).energies(complex_.counts)
        rows += [f"| {when} | {part} | {100 * r:.2f} % | {100 * t:.2f} % |" for part, (r, t) in found.shares.items()]
    return rows


def _text(outer: int, complex_: SimplicialComplex, curl_m: Floats, energy: list[str]) -> str:
    counts = complex_.counts
    lines = [f"# Complex, round {outer}", "", "| | |", "|---|---|", f"| frames | {counts[0]} |"]
    lines += [f"| edges, parallel ones once | {counts[1]} |", f"| triangles | {counts[2]} |"]
    if len(curl_m):
        middle, high, top = np.percentile(curl_m, [50, 95, 100]) * 1000
        lines.append(f"| curl, median / 95th / largest | {middle:.1f} / {high:.1f} / {top:.1f} mm |")
    if energy:
        lines += [
            "",
            "## Energy of the residual 1-form",
            "",
            "Exact is what a solve can remove; curl and harmonic stay.",
        ]
        lines += ["", "| solve | part | rotation | translation |", "|---|---|---|---|", *energy]
    return "\n".join(lines)

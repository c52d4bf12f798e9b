"""Log triangles of the viewing graph coloured by curl, the error of the motions around them."""

from __future__ import annotations

import numpy as np
import rerun as rr

from hodge_pipeline import se3
from hodge_pipeline.complex.cech import SimplicialComplex
from hodge_pipeline.complex.cycles import Loops, edge_between, loop_products
from hodge_pipeline.complex.parts import decompose, flag_of, one_form
from hodge_pipeline.diagnosis.result import Cycles
from hodge_pipeline.errors import GraphError
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import log_markdown, log_notes
from hodge_pipeline.types import Bytes, Floats, Ints, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly

MOST_TRIANGLES = 20_000
OPEN_CHI = 30.0**0.5
"""Of the curl: a cycle whose χ² exceeds its square does not close; the colours end there."""
ALPHA = 110
TRIANGLE_BYTES = 60


def log_triangles(stream: rr.RecordingStream, path: str, corners: Floats, colours: Bytes, alpha: Bytes) -> None:
    """Triangles by their corners (T, 3, 3) in the world, each in one colour (T, 3) and opacity (T,)."""
    mesh = rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3).astype(np.float32),
        triangle_indices=np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3),
        vertex_colors=np.repeat(np.column_stack([colours, alpha]), 3, axis=0),
    )
    stream.log(path, mesh, static=True)


def triangle_curl_m(graph: ViewGraph, triangles: Ints) -> Floats:
    """Curl (T,) in metres of the measured motions around each triangle (T, 3); a rotation counts as its arc at 1 m.

    Of parallel edges the first counts.
    """
    a, b = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    edge = edge_between(graph.edges, graph.vertex_count, a, b)
    sign = np.where(graph.edges[edge, 0] == a, 1, -1)
    around = loop_products(Loops(3 * np.arange(len(triangles) + 1), edge, sign), graph.i_from_j)
    return np.asarray(np.hypot(np.linalg.norm(around[:, :3, 3], axis=1), se3.ARM_M * se3.rotation_angle(around)))


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
    kept = options.count(shapes.MOST_LINES, len(triangles), TRIANGLE_BYTES, max_bytes)
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


def log_tested_triangles(
    stream: rr.RecordingStream, graph: ViewGraph, world_from_cam: Floats, cycles: Cycles
) -> tuple[str, ...]:
    """Log tested triangles coloured by √χ² of their curl, those that fail opaque; gives notes of what was left out."""
    rows = np.flatnonzero(cycles.loops.lengths == 3)
    corners = vertices_along(graph, cycles.loops, rows).reshape(-1, 3)
    finite = np.asarray(np.isfinite(world_from_cam[corners][:, :, :3, 3]).all(axis=(1, 2)))
    rows, corners = rows[finite], corners[finite]
    worst = np.argsort(-cycles.chi2[rows], kind="stable")[:MOST_TRIANGLES]
    notes: tuple[str, ...] = ()
    if len(rows) > MOST_TRIANGLES:
        notes = (f"recording: {MOST_TRIANGLES} of {len(rows)} triangles drawn, those of largest curl",)
    rows, corners = rows[worst], corners[worst]
    colours = shapes.residual_colours(np.sqrt(cycles.chi2[rows]), OPEN_CHI)
    alpha = np.where(cycles.closes[rows], ALPHA, 255).astype(np.uint8)
    if len(rows):
        log_triangles(stream, layout.TRIANGLES, world_from_cam[corners, :3, 3], colours, alpha)
    log_notes(stream, 0, notes)
    return notes


def vertices_along(graph: ViewGraph, loops: Loops, rows: Ints) -> Ints:
    """The vertices along these loops, one after the other."""
    chosen = loops.select(rows)
    return graph.edges[chosen.edge, np.where(chosen.sign > 0, 0, 1)]

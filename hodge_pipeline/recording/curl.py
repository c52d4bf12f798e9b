"""Log triangles of the viewing graph coloured by curl, the error of the motions around them."""

from __future__ import annotations

import numpy as np
import rerun as rr

from hodge_pipeline import se3
from hodge_pipeline.complex.cech import SimplicialComplex
from hodge_pipeline.complex.cycles import Loops, edge_between, loop_products
from hodge_pipeline.complex.parts import decompose, flag_of, one_form
from hodge_pipeline.diagnosis.cycles import Cycles
from hodge_pipeline.errors import GraphError
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import Part, log_markdown
from hodge_pipeline.types import Bytes, Floats, Ints, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly
from hodge_pipeline.types.text import markdown_table

MOST_TRIANGLES = 20_000
OPEN_CHI = 30.0**0.5
"""√χ² of a cycle above which it does not close, and at which the colours end."""
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


def log_complex(part: Part, outer: int, graph: ViewGraph, start: Floats, solution: Solution) -> None:
    """Log triangles by curl, and the 1-form's energy before and after the solve."""
    try:
        complex_ = flag_of(graph)
    except GraphError as error:
        part.note(f"no triangles of round {outer} drawn: {error}")
        return
    triangles = complex_.simplices[2]
    curl_m = triangle_curl_m(graph, triangles)
    kept = part.options.count(shapes.MOST_LINES, len(triangles), TRIANGLE_BYTES, part.solver_bytes / 4)
    corners = solution.world_from_cam[triangles, :3, 3]
    drawable = np.flatnonzero(np.isfinite(corners).all(axis=(1, 2)))
    rows = drawable[np.argsort(curl_m[drawable], kind="stable")][evenly(len(drawable), kept)]
    colours = shapes.residual_colours(curl_m[rows])
    if len(rows):
        alpha = np.full(len(rows), ALPHA, np.uint8)
        log_triangles(part.stream, layout.complex_mesh(outer), corners[rows], colours, alpha)
    text = _text(outer, complex_, curl_m, _energy(graph, start, solution))
    log_markdown(part.stream, layout.complex_text(outer), text)
    if len(rows) < len(triangles):
        part.note(f"{len(rows)} of {len(triangles)} triangles of round {outer} drawn")


def _energy(graph: ViewGraph, start: Floats, solution: Solution) -> list[tuple[str, ...]]:
    """The share of each part in rotation and in translation, before and after the solve, of edges used."""
    used, rows = graph.select(solution.weights > 0), list[tuple[str, ...]]()
    complex_ = flag_of(used)
    for when, poses in (("before", start), ("after", solution.world_from_cam)):
        if not np.isfinite(poses).all():
            continue
        found = decompose(complex_, one_form(used, poses, solution.component)).energies(complex_.counts)
        rows += [(when, name, f"{100 * r:.2f} %", f"{100 * t:.2f} %") for name, (r, t) in found.shares.items()]
    return rows


def _text(outer: int, complex_: SimplicialComplex, curl_m: Floats, energy: list[tuple[str, ...]]) -> str:
    counts = complex_.counts
    rows: list[tuple[str, object]] = [("frames", counts[0]), ("edges, parallel ones once", counts[1])]
    rows += [("triangles", counts[2])]
    if len(curl_m):
        middle, high, top = np.percentile(curl_m, [50, 95, 100]) * 1000
        rows += [("curl, median / 95th / largest", f"{middle:.1f} / {high:.1f} / {top:.1f} mm")]
    text = f"# Complex, round {outer}\n\n{markdown_table(('', ''), rows)}"
    if not energy:
        return text
    table = markdown_table(("solve", "part", "rotation", "translation"), energy)
    told = "Exact is what a solve can remove; curl and harmonic stay."
    return f"{text}\n\n## Energy of the residual 1-form\n\n{told}\n\n{table}"


def log_tested_triangles(part: Part, graph: ViewGraph, world_from_cam: Floats, cycles: Cycles) -> None:
    """Log tested triangles coloured by √χ² of their curl, those that fail opaque."""
    rows = np.flatnonzero(cycles.loops.lengths == 3)
    corners = cycles.loops.select(rows).vertices(graph.edges).reshape(-1, 3)
    finite = np.asarray(np.isfinite(world_from_cam[corners][:, :, :3, 3]).all(axis=(1, 2)))
    rows, corners = rows[finite], corners[finite]
    worst = np.argsort(-cycles.chi2[rows], kind="stable")[:MOST_TRIANGLES]
    if len(rows) > MOST_TRIANGLES:
        part.note(f"{MOST_TRIANGLES} of {len(rows)} triangles drawn, those of largest curl")
    rows, corners = rows[worst], corners[worst]
    colours = shapes.residual_colours(np.sqrt(cycles.chi2[rows]), OPEN_CHI)
    alpha = np.where(cycles.closes[rows], ALPHA, 255).astype(np.uint8)
    if len(rows):
        log_triangles(part.stream, layout.TRIANGLES, world_from_cam[corners, :3, 3], colours, alpha)

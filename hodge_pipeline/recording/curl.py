"""Log triangles of the viewing graph coloured by curl, the error of the motions around them."""

from __future__ import annotations

import numpy as np
import rerun as rr

from hodge_pipeline import se3
from hodge_pipeline.complex.cycles import Loops
from hodge_pipeline.diagnosis.result import Cycles
from hodge_pipeline.recording import layout, shapes
from hodge_pipeline.recording.stream import log_notes
from hodge_pipeline.types import Bytes, Floats, Ints, ViewGraph

MOST_TRIANGLES = 20_000
OPEN_CHI = 30.0**0.5
"""Of the curl: a cycle whose χ² exceeds its square does not close; the colours end there."""
ALPHA = 110


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
    ab, bc, ca = (_motions(graph, triangles[:, k], triangles[:, (k + 1) % 3]) for k in range(3))
    around = ab @ bc @ ca
    angle_rad = se3.rotation_angle(around)
    return np.asarray(np.hypot(np.linalg.norm(around[:, :3, 3], axis=1), se3.ARM_M * angle_rad))


def _motions(graph: ViewGraph, a: Ints, b: Ints) -> Floats:
    """The measured `a_from_b` (T, 4, 4) of pairs that have an edge in either direction."""
    low, high = graph.edges.min(axis=1), graph.edges.max(axis=1)
    keys, first = np.unique(low * graph.vertex_count + high, return_index=True)
    rows = first[np.searchsorted(keys, np.minimum(a, b) * graph.vertex_count + np.maximum(a, b))]
    motions = graph.i_from_j[rows]
    turned = graph.edges[rows, 0] != a
    motions[turned] = se3.inverse(motions[turned])
    return motions


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

"""Log harmonic loops: cycles of the viewing graph that no triangles fill."""

from __future__ import annotations

import numpy as np
import rerun as rr

from hodge_pipeline import se3
from hodge_pipeline.complex.cycles import loop_products
from hodge_pipeline.complex.holes import unfilled_loops
from hodge_pipeline.diagnosis.result import WRONG
from hodge_pipeline.errors import GraphError
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.shapes import RESULT_COLOUR, VERDICT_COLOURS
from hodge_pipeline.recording.stream import Part
from hodge_pipeline.types import Bytes, Floats, Ints, ViewGraph

MOST_LOOPS = 200
LOOP_RADIUS = -2.2
LOOP_COLOURS = np.array([RESULT_COLOUR, VERDICT_COLOURS[WRONG]], float)
MOST_NAMED = 12
BRIGHT_MEDIANS = 4.0
"""Error at which the colours end, in medians of all loops: the worst stand out, whatever the scene's size."""


def log_loops(part: Part, graph: ViewGraph, world_from_cam: Floats) -> None:
    """Log one closed line for each hole, labelled with its closure error."""
    try:
        holes = unfilled_loops(graph.edges, graph.vertex_count, most_loops=MOST_LOOPS)
    except GraphError as error:
        part.note(f"no harmonic loops: {error}")
        return
    chosen = holes.loops.select(np.arange(len(holes.loops))[::-1])
    starts = chosen.offsets[:-1]
    corners = np.split(chosen.vertices(graph.edges), starts[1:]) if len(chosen) else []
    lines = [world_from_cam[np.append(each, each[0]), :3, 3].astype(np.float32) for each in corners]
    kept = np.array([row for row, line in enumerate(lines) if np.isfinite(line).all()], np.int64)
    left = se3.log(loop_products(chosen, graph.i_from_j))
    angle, shift_m = np.linalg.norm(left[:, :3], axis=1), np.linalg.norm(left[:, 3:], axis=1)
    size = np.hypot(shift_m, se3.ARM_M * angle)[kept]
    strips = rr.LineStrips3D(
        [lines[row] for row in kept],
        colors=_loop_colours(size),
        radii=[LOOP_RADIUS],
        labels=[_label(graph, corners[row], shift_m[row], angle[row]) for row in kept],
        show_labels=False,
    )
    part.stream.log(layout.LOOPS, strips, static=True)
    if len(kept) < holes.count:
        part.note(f"{len(kept)} of {holes.count} harmonic loops drawn, the longest")


def _loop_colours(size: Floats) -> Bytes:
    """White to magenta, unlike any triangle."""
    share = np.clip(size / (BRIGHT_MEDIANS * max(float(np.median(size)), 1e-9)), 0, 1) if len(size) else size
    mixed = LOOP_COLOURS[0] + share[:, None] * (LOOP_COLOURS[1] - LOOP_COLOURS[0])
    return np.asarray(mixed.round(), np.uint8)


def _label(graph: ViewGraph, corners: Ints, shift_m: float, angle_rad: float) -> str:
    names = "-".join(map(str, graph.vertex_ids[corners[:MOST_NAMED]])) + ("-…" if len(corners) > MOST_NAMED else "")
    return f"{names}: {len(corners)} edges, off by {shift_m:.3g} m, {np.degrees(angle_rad):.3g}°"

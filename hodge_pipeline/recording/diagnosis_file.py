"""`diagnosis.rrd` of `hodge diagnose`: edges by verdict, triangles by curl, harmonic loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hodge_pipeline import se3
from hodge_pipeline.complex.cycles import loop_products
from hodge_pipeline.complex.holes import unfilled_loops
from hodge_pipeline.diagnosis.result import WRONG, Diagnosis
from hodge_pipeline.errors import GraphError
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.blueprint import scene_view, without_panels
from hodge_pipeline.recording.curl import log_tested_triangles
from hodge_pipeline.recording.diagnosis import log_diagnosis
from hodge_pipeline.recording.eye import Eye
from hodge_pipeline.recording.shapes import RESULT_COLOUR, VERDICT_COLOURS
from hodge_pipeline.recording.stream import Part, identity_of_poses, log_markdown, writing
from hodge_pipeline.types import Bytes, Edges, Floats, Ints, ViewGraph

APPLICATION = "hodge-pipeline diagnosis"
VERTEX_RADIUS = -2.5
GREY = (200, 200, 200)
MOST_NAMED = 2_000
MOST_LOOPS = 200
LOOP_RADIUS = -2.2
LOOP_COLOURS = np.array([RESULT_COLOUR, VERDICT_COLOURS[WRONG]], float)
MOST_CORNERS_NAMED = 12
BRIGHT_MEDIANS = 4.0
"""Error at which the colours end, in medians of all loops: the worst stand out, whatever the scene's size."""
LEGEND = """
| colour | what |
|---|---|
| blue, amber, magenta, grey | an edge: consistent, suspect, wrong, untestable |
| blue to yellow | a triangle: the brighter, the larger its curl; one that does not close is opaque |
| white to magenta, thick | a loop that no triangles fill: the redder, the less it closes |
"""


def write_diagnosis(path: Path, graph: ViewGraph, world_from_cam: Floats, diagnosis: Diagnosis) -> None:
    """One recording, which appears under its name when it is complete; frames are drawn at these poses."""
    with writing(
        path, identity_of_poses(diagnosis.world_from_cam), _blueprint(_eye(world_from_cam)), APPLICATION
    ) as stream:
        _log_vertices(stream, graph, world_from_cam)
        edges = diagnosis.put_into(Edges.measured(graph))
        part = Part(stream)
        log_diagnosis(part, graph, world_from_cam, edges)
        log_tested_triangles(part, graph, world_from_cam, diagnosis.cycles)
        _log_loops(part, graph, world_from_cam)
        log_markdown(stream, layout.LEGEND, LEGEND)


def _log_vertices(stream: rr.RecordingStream, graph: ViewGraph, world_from_cam: Floats) -> None:
    drawn = np.flatnonzero(se3.has_pose(world_from_cam))
    names = [str(name) for name in graph.vertex_ids[drawn]] if len(drawn) <= MOST_NAMED else None
    points = rr.Points3D(
        world_from_cam[drawn, :3, 3].astype(np.float32),
        radii=[VERTEX_RADIUS],
        labels=names,
        show_labels=False,
        colors=[GREY],
    )
    stream.log(layout.VERTICES, points, static=True)


def _log_loops(part: Part, graph: ViewGraph, world_from_cam: Floats) -> None:
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
        labels=[_loop_label(graph, corners[row], shift_m[row], angle[row]) for row in kept],
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


def _loop_label(graph: ViewGraph, corners: Ints, shift_m: float, angle_rad: float) -> str:
    names = "-".join(map(str, graph.vertex_ids[corners[:MOST_CORNERS_NAMED]])) + (
        "-…" if len(corners) > MOST_CORNERS_NAMED else ""
    )
    return f"{names}: {len(corners)} edges, off by {shift_m:.3g} m, {np.degrees(angle_rad):.3g}°"


def _blueprint(eye: Eye | None) -> rrb.Blueprint:
    verdicts = scene_view("Edges by verdict", [f"+ {layout.VERDICTS}/**", f"+ {layout.VERTICES}"], eye)
    curl = scene_view(
        "Triangles by curl, harmonic loops", [f"+ {layout.TRIANGLES}", f"+ {layout.LOOPS}", f"+ {layout.VERTICES}"], eye
    )
    texts = rrb.Vertical(
        rrb.TextDocumentView(origin=layout.DIAGNOSIS, name="Which edge is wrong"),
        rrb.TextDocumentView(origin=layout.LEGEND, name="Colours"),
        row_shares=[3, 1],
    )
    return without_panels(rrb.Horizontal(verdicts, curl, texts, column_shares=[2, 2, 1.4]), "")


def _eye(world_from_cam: Floats) -> Eye | None:
    """From above the plane in which the frames spread most, a little aside."""
    places = world_from_cam[se3.has_pose(world_from_cam), :3, 3]
    if len(places) < 2:
        return None
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    axes = np.linalg.eigh((places - middle).T @ (places - middle))[1]
    size = max(float(np.ptp(places @ axes[:, 2])), 0.1)
    position = middle + size * (1.7 * axes[:, 0] - 0.6 * axes[:, 1])
    return Eye(*(tuple(map(float, each)) for each in (position, middle, axes[:, 0])))  # type: ignore[arg-type]

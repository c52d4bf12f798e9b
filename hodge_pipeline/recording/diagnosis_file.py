"""`diagnosis.rrd` of `hodge diagnose`: edges by verdict, triangles by curl, harmonic loops."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hodge_pipeline import se3
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.blueprint import scene_view, without_panels
from hodge_pipeline.recording.curl import log_tested_triangles
from hodge_pipeline.recording.diagnosis import log_diagnosis
from hodge_pipeline.recording.eye import Eye
from hodge_pipeline.recording.loops import log_loops
from hodge_pipeline.recording.stream import Part, log_markdown, writing
from hodge_pipeline.types import Edges, Floats, ViewGraph

APPLICATION = "hodge-pipeline diagnosis"
VERTEX_RADIUS = -2.5
GREY = (200, 200, 200)
MOST_NAMED = 2_000
LEGEND = """
| colour | what |
|---|---|
| blue, amber, magenta, grey | an edge: consistent, suspect, wrong, untestable |
| blue to yellow | a triangle: the brighter, the larger its curl; one that does not close is opaque |
| white to magenta, thick | a loop that no triangles fill: the redder, the less it closes |
"""


def write_diagnosis(path: Path, identity: str, graph: ViewGraph, world_from_cam: Floats, diagnosis: Diagnosis) -> None:
    """One recording, which appears under its name when it is complete; frames are drawn at these poses."""
    with writing(path, identity, _blueprint(_eye(world_from_cam)), APPLICATION) as stream:
        _log_vertices(stream, graph, world_from_cam)
        edges = diagnosis.put_into(Edges.measured(graph))
        part = Part(stream)
        log_diagnosis(part, graph, world_from_cam, edges)
        log_tested_triangles(part, graph, world_from_cam, diagnosis.cycles)
        log_loops(part, graph, world_from_cam)
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

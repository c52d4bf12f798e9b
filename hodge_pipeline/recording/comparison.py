"""Recording of two runs for comparison: trajectories and models, B aligned to A."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hodge_pipeline.recording import layout
from hodge_pipeline.recording.blueprint import scene_view, without_panels
from hodge_pipeline.recording.eye import Eye, look_from
from hodge_pipeline.recording.graph import log_poses
from hodge_pipeline.recording.results import log_model
from hodge_pipeline.recording.stream import Part, log_markdown, writing
from hodge_pipeline.types import Floats, Model


def record_comparison(
    path: Path,
    names: tuple[str, str],
    poses: tuple[Floats, Floats],
    models: tuple[Model | None, Model | None],
    apart_m: Floats,
    text: str,
    *,
    is_scanner: bool,
) -> None:
    """Write the recording; the poses (S, 4, 4) of the shared frames and the models are in one world already."""
    eye = look_from(poses[0], np.zeros((0, 3)), is_scanner)
    with writing(path, f"compare-{names[0]}-{names[1]}", _blueprint(names, eye)) as stream:
        for side, world_from_cam, model in zip("ab", poses, models, strict=True):
            part = Part(stream, is_scanner=is_scanner)
            log_poses(part, side, world_from_cam)
            if model is not None:
                log_model(part, model, _model(side))
        if len(apart_m):
            times = [rr.TimeColumn(layout.FRAME, sequence=np.arange(len(apart_m)))]
            stream.send_columns(layout.APART, times, rr.Scalars.columns(scalars=apart_m))
        log_markdown(stream, layout.SCORES, text)


def _model(side: str) -> str:
    return f"{layout.MODEL}/{side}"


def _blueprint(names: tuple[str, str], eye: Eye | None) -> rrb.Blueprint:
    def scene(name: str, *contents: str) -> rrb.Spatial3DView:
        return scene_view(name, [f"+ {entity}" for entity in contents], eye)

    a, b = layout.trajectory("a"), layout.trajectory("b")
    plot = rrb.TimeSeriesView(origin=layout.APART, name="Apart, m")
    text = rrb.TextDocumentView(origin=layout.SCORES, name="Numbers")
    tabs = rrb.Tabs(
        rrb.Horizontal(
            scene(f"Orange: {names[0]}. Blue: {names[1]}", a, layout.frusta("a"), b, layout.frusta("b")),
            rrb.Vertical(plot, text),
            column_shares=[2, 1],
            name="Both",
        ),
        rrb.Horizontal(scene(names[0], _model("a"), a), scene(names[1], _model("b"), b), name="Side by side"),
    )
    return without_panels(tabs, layout.FRAME)

"""Recording of two runs for comparison: trajectories and models, B aligned to A."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hodge_pipeline import se3
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recording import layout
from hodge_pipeline.recording.blueprint import scene_view, without_panels
from hodge_pipeline.recording.eye import Eye, look_from
from hodge_pipeline.recording.results import log_model
from hodge_pipeline.recording.shapes import pose_lines
from hodge_pipeline.recording.stream import log_markdown, writing
from hodge_pipeline.types import Floats, Model
from hodge_pipeline.types.arrays import evenly

COLOURS = {"a": (230, 130, 0), "b": (86, 180, 233)}
"""Orange and sky blue of Okabe and Ito's set."""
APART = "/plots/apart_m"
FRUSTA = 40


def record_comparison(
    path: Path,
    names: tuple[str, str],
    poses: tuple[Floats, Floats],
    models: tuple[Model | None, Model | None],
    apart_m: Floats,
    text: str,
    *,
    is_scanner: bool = False,
) -> None:
    """Write the recording; the poses (S, 4, 4) of the shared frames and the models are in one world already."""
    eye = look_from(poses[0], np.zeros((0, 3)), is_scanner)
    with writing(path, f"compare-{names[0]}-{names[1]}", _blueprint(names, eye)) as stream:
        for side, world_from_cam, model in zip("ab", poses, models, strict=True):
            _log_run(stream, side, world_from_cam, model, is_scanner)
        if len(apart_m):
            times = [rr.TimeColumn(layout.FRAME, sequence=np.arange(len(apart_m)))]
            stream.send_columns(APART, times, rr.Scalars.columns(scalars=apart_m))
        log_markdown(stream, layout.SCORES, text)


def _log_run(
    stream: rr.RecordingStream, side: str, world_from_cam: Floats, model: Model | None, is_scanner: bool
) -> None:
    root, colour = f"{layout.WORLD}/{side}", COLOURS[side]
    if len(world_from_cam):
        line = rr.LineStrips3D([world_from_cam[:, :3, 3].astype(np.float32)], colors=[colour], radii=[-1.6])
        stream.log(f"{root}/trajectory", line, static=True)
        picked = world_from_cam[evenly(len(world_from_cam), FRUSTA)]
        shapes = rr.LineStrips3D(pose_lines(picked, is_scanner), colors=[colour], radii=[-0.5])
        stream.log(f"{root}/frusta", shapes, static=True)
        stream.send_columns(
            f"{root}/poses",
            [rr.TimeColumn(layout.FRAME, sequence=np.arange(len(world_from_cam)))],
            rr.Transform3D.columns(translation=world_from_cam[:, :3, 3], quaternion=se3.to_quat_xyzw(world_from_cam)),
        )
    if model is not None:
        log_model(stream, model, RecordingOptions(), f"{root}/model")


def _blueprint(names: tuple[str, str], eye: Eye | None) -> rrb.Blueprint:
    def scene(name: str, *contents: str) -> rrb.Spatial3DView:
        return scene_view(name, [f"+ {layout.WORLD}/{entity}" for entity in contents], eye)

    lines = ("a/trajectory", "a/frusta", "b/trajectory", "b/frusta")
    plot = rrb.TimeSeriesView(origin=APART, name="Apart, m")
    text = rrb.TextDocumentView(origin=layout.SCORES, name="Numbers")
    tabs = rrb.Tabs(
        rrb.Horizontal(
            scene(f"Orange: {names[0]}. Blue: {names[1]}", *lines),
            rrb.Vertical(plot, text),
            column_shares=[2, 1],
            name="Both",
        ),
        rrb.Horizontal(
            scene(names[0], "a/model", "a/trajectory"), scene(names[1], "b/model", "b/trajectory"), name="Side by side"
        ),
    )
    return without_panels(tabs, layout.FRAME)

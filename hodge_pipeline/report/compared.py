"""What a comparison of two runs leaves for people: `compare.html` and `compare.rrd`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError, not_written
from hodge_pipeline.recording.comparison import record_comparison
from hodge_pipeline.report import raster
from hodge_pipeline.report.comparison import Comparison, RunFacts, tables
from hodge_pipeline.report.contents import Path3D, Pictures, Report, SourceSummary
from hodge_pipeline.report.document import Banner, Document, Picture, Section, markdown, render
from hodge_pipeline.report.photographs import sides
from hodge_pipeline.report.plots import draw
from hodge_pipeline.store.artifacts import write_text
from hodge_pipeline.store.workspace import make_folder
from hodge_pipeline.types import Floats, Model
from hodge_pipeline.types.ply import read_model


def write_comparison(folder: Path, comparison: Comparison) -> tuple[Path, Path]:
    """Write the page and the recording into a folder, made if it is not there, and give back their paths."""
    html, recording = folder / "compare.html", folder / "compare.rrd"
    models = _model(comparison.a, np.eye(4)), _model(comparison.b, comparison.a_from_b)
    make_folder(folder)
    try:
        write_text(html, render(_page(comparison, models)))
    except OSError as error:
        raise not_written(html, error) from error
    names = comparison.a.name, comparison.b.name
    poses = comparison.a_poses, comparison.b_poses
    told = markdown(tables(comparison))
    record_comparison(recording, names, poses, models, comparison.apart_m, told, is_scanner=_is_scanner(comparison))
    return html, recording


def _model(run: RunFacts, world_from_run: Floats) -> Model | None:
    """The fused scene in the common world; none where its file is of another program."""
    if run.model is None:
        return None
    try:
        model = read_model(run.model)
    except SourceError:
        return None
    turn = world_from_run[:3, :3].astype(np.float32)
    points = np.asarray(se3.transform(world_from_run, model.points_in_world.astype(float)), np.float32)
    normals = None if model.normals_in_world is None else model.normals_in_world @ turn.T
    return Model(model.name, points, normals, model.colours, model.triangles, model.notes)


def _is_scanner(comparison: Comparison) -> bool:
    return bool(comparison.a.report["source"].get("is_scanner"))


def _page(comparison: Comparison, models: tuple[Model | None, Model | None]) -> Document:
    a, b = comparison.a, comparison.b
    shared = len(comparison.apart_m)
    laid = f"B is laid onto A by the {shared} frames that both have." if shared else "The runs share too few frames."
    return Document(
        f"{a.name} and {b.name}",
        f"A: {a.folder}. B: {b.folder}. {laid}",
        tuple(Banner("", run.name, (run.report["verdict"]["sentence"],)) for run in (a, b)),
        sections=(
            *(Section.of(each) for each in tables(comparison)),
            Section(
                "The models from four sides", f"Left: {a.name}. Right: {b.name}.", pictures=_sides(comparison, models)
            ),
            Section("Trajectories", pictures=draw(_paths(comparison))),
        ),
    )


def _paths(comparison: Comparison) -> Report:
    """A report that holds nothing but what the plots need."""
    a, b = comparison.a, comparison.b
    named = ((a.name, comparison.a_poses), (b.name, comparison.b_poses))
    series = {
        f"{run.name}, {name}": tuple(float("nan") if value is None else value for value in values)
        for run in (a, b)
        for name, values in run.report.get("convergence", {}).items()
    }
    paths = tuple(Path3D.of(name, poses) for name, poses in named if len(poses))
    pictures = Pictures(paths=paths, component=np.zeros(len(comparison.a_poses), np.int64), convergence=series)
    return Report("", SourceSummary("", "", 0), before=a.name, after=b.name, pictures=pictures)


def _sides(comparison: Comparison, models: tuple[Model | None, Model | None]) -> tuple[Picture, ...]:
    first, second = models
    if first is None or second is None or not len(comparison.a_poses) or not len(first.points_in_world):
        return ()
    scenes = [raster.Points.of(one.points_in_world, one.normals_in_world, one.colours) for one in (first, second)]
    views = raster.around(scenes[0], comparison.a_poses, _is_scanner(comparison))
    return sides(scenes, views, f"{comparison.a.name} | {comparison.b.name}")

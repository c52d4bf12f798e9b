"""The run folder of a refined model: `sparse/0`, `poses.tum`, `edges.csv`, report and recording."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from hodge_pipeline import registry
from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recipe import binding
from hodge_pipeline.recording.solved import record_graph
from hodge_pipeline.refine.model import RefinedModel
from hodge_pipeline.refine.model_options import ModelRefinement
from hodge_pipeline.report.refined import model_report
from hodge_pipeline.report.write import write_report
from hodge_pipeline.store.cost import Cost
from hodge_pipeline.store.edge_table import write_edges
from hodge_pipeline.store.workspace import REFINEMENT, Workspace
from hodge_pipeline.types import Source, Trajectory
from hodge_pipeline.types.tracked_model import TrackedModel

MODELS = "sparse"
"""The folder of the models, as COLMAP calls it."""
REFUSAL = "holds another refined model ({change}): --overwrite replaces it"


@contextmanager
def model_workspace(out: Path | None, options: ModelRefinement, *, overwrite: bool) -> Iterator[Workspace]:
    """The workspace of a refinement, in a temporary folder without `out`.

    Raises `WorkspaceError` where `out` holds something else, or the input model.
    """
    model = None if options.source is None else Path(options.source).resolve()
    if out is not None and model is not None and out.resolve() in (model, *model.parents):
        raise WorkspaceError(f"--out {out}: holds the model to be refined: give another folder")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if out is None else out
        recipe = binding.unbind(options)
        with Workspace.open(folder, recipe, overwrite=overwrite, refusal=REFUSAL, kind=REFINEMENT) as workspace:
            yield workspace


def write_run_folder(
    out: Path,
    results: Sequence[RefinedModel],
    options: ModelRefinement,
    cost: Cost,
) -> None:
    """Write models, tables, report and recording. Raises `WorkspaceError` where `out` cannot be written."""
    try:
        models = [model for result in results for model in result.kept]
        _write_models(out, models)
        _write_tables(out, results)
        write_report(out, model_report(results, options, options.source or "pycolmap", cost))
        _record(out, results[0])
    except OSError as error:
        raise WorkspaceError(f"{out}: cannot be written ({error.strerror}): give another --out") from error


def _write_models(out: Path, models: Sequence[TrackedModel]) -> None:
    """Replace the models in one step, so that the folder never mixes two runs; kept inputs are copied byte for byte."""
    draft = Path(tempfile.mkdtemp(dir=out, prefix=f".{MODELS}."))
    try:
        for number, model in enumerate(models):
            folder = draft / str(number)
            folder.mkdir()
            if model.files:
                for file in model.files:
                    shutil.copyfile(file, folder / file.name)
            else:
                model.write(folder)
        if (out / MODELS).exists():
            shutil.rmtree(out / MODELS)
        if models:
            os.chmod(draft, 0o755)
            os.replace(draft, out / MODELS)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _record(out: Path, first: RefinedModel) -> None:
    """Record the first result, which has most images: poses before and after, edges, the solve."""
    sets = {"start": first.start.world_from_body, "refined": first.model.world_from_body}
    solved = first.solved
    graph, solution = (None, None) if solved is None else (solved.graph, solved.solution)
    record_graph(out, first.model.name, graph, sets["start"], solution, sets, first.notes)


def _write_tables(out: Path, results: Sequence[RefinedModel]) -> None:
    """Write poses and edges, of each result a file: `poses.tum`, or `poses-0.tum`, … of several."""
    for number, result in enumerate(results):
        suffix = "" if len(results) == 1 else f"-{number}"
        frames = [frame for model in result.kept for frame in model.frames]
        poses = np.array([frame.world_from_cam for frame in frames])
        trajectory = Trajectory(np.arange(len(poses), dtype=float), poses)
        source = Source(result.model.name, out, trajectory=trajectory)
        registry.load("writers", "tum")().write(out / f"poses{suffix}.tum", source)
        if result.solved is not None:
            edges = result.solved.edges(result.model.world_from_body)
            has_metres = result.final_scale.is_observable
            write_edges(out / f"edges{suffix}.csv", edges, result.solved.graph.vertex_ids, has_metres=has_metres)

"""Refine COLMAP models from Python or the command line: options in, models and a run folder out."""

from __future__ import annotations

import os
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hodge_pipeline.refine.model import RefinedModel, refine_models
from hodge_pipeline.refine.model_options import RECIPE, ModelRefinement, load_model_refinement
from hodge_pipeline.store.cost import Monitor
from hodge_pipeline.store.progress import Watcher
from hodge_pipeline.store.store import Store
from hodge_pipeline.types.tracked_model import TrackedModel
from hodge_pipeline.uses.model_folder import model_workspace, write_run_folder


@dataclass(frozen=True)
class RefinedColmap:
    """The result of each model, the largest first, and the run folder, None where nothing was written."""

    results: tuple[RefinedModel, ...]
    folder: Path | None

    @property
    def models(self) -> list[Any]:
        """The models as `pycolmap.Reconstruction`: refined, or the inputs unchanged where the guard kept these."""
        return [model.native for result in self.results for model in result.kept]

    @property
    def exit_code(self) -> int:
        """3 where a result failed its own checks, else 0."""
        return max(result.decision.exit_code for result in self.results)


def refine_colmap(
    model: Any,
    *,
    database: Path | str | None = None,
    images: Path | str | None = None,
    depth: Path | str | None = None,
    depth_scale: float | None = None,
    out: Path | str | None = None,
    force: bool = False,
    overwrite: bool = False,
    recipe: str = RECIPE,
    overrides: Sequence[str] = (),
    watcher: Watcher | None = None,
    dask: str | None = None,
) -> RefinedColmap:
    """A COLMAP model with better poses: `model` is its folder, a `pycolmap.Reconstruction`, or a list of those.

    `depth`: folder of sensor depth images named as the colour images, in `depth_scale` stored units to the metre.
    `out`: the run folder, in which a stopped refinement goes on (one of models in memory begins again); without it
    nothing is written. `force` writes a worse result too, `overwrite` replaces another refinement in `out`, `dask` is
    as of `run`. Raises `HodgeError` (see `errors`) for whatever the user can mend.
    """
    given = {"database": database, "images": images, "depth": depth, "depth_scale": depth_scale}
    sets = [f"model.{name}={value}" for name, value in given.items() if value is not None]
    options = load_model_refinement(recipe, [*sets, *overrides])
    folder = None if out is None else Path(out)
    return run_refinement(model, options, out=folder, force=force, overwrite=overwrite, watcher=watcher, dask=dask)


def run_refinement(
    model: Any,
    options: ModelRefinement,
    *,
    out: Path | None,
    force: bool,
    overwrite: bool,
    watcher: Watcher | None,
    dask: str | None,
) -> RefinedColmap:
    """`refine_colmap` with bound options."""
    is_path = isinstance(model, (str, Path))
    options = replace(options, source=str(model) if is_path else None)
    given = Path(model) if is_path else model if isinstance(model, (list, tuple)) else [model]
    with model_workspace(out, options, overwrite=overwrite) as workspace:
        with Monitor().measure() as cost:
            models = options.model.open_models(given)
            steps = Store(workspace.steps, watcher)
            results = refine_models(models, options, steps, models_key(models, options, steps), force=force, dask=dask)
        if out is not None:
            write_run_folder(out, results, options, cost)
    return RefinedColmap(results, out)


def models_key(models: Sequence[TrackedModel], options: ModelRefinement, steps: Store) -> str:
    """A key of models under these options, by path, size and time of every file; a random one of models in memory."""
    if not all(model.files for model in models):
        return uuid.uuid4().hex
    files = [file for model in models for file in (*model.files, *model.measurements)]
    status = [(str(file.absolute()), os.stat(file)) for file in files]
    return steps.key([[[path, found.st_size, found.st_mtime_ns] for path, found in status], options])

"""Refine a COLMAP model from Python or the command line: options in, models and a run folder out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hodge_pipeline.monitor import Monitor
from hodge_pipeline.refine.model import RefinedModel, refine_models
from hodge_pipeline.refine.model_options import RECIPE, ModelRefinement, load_model_refinement
from hodge_pipeline.refined_folder import check_out, write_run_folder
from hodge_pipeline.watch import Nobody, Watcher


@dataclass(frozen=True)
class RefinedColmap:
    """What became of each model, and the folder that it was written to, if to any.

    `models` are pycolmap's: the refined ones, or the inputs as they came where the guard kept those.
    """

    results: tuple[RefinedModel, ...]
    folder: Path | None

    @property
    def models(self) -> list[Any]:
        """The resulting models as `pycolmap.Reconstruction`, the largest first."""
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
    recipe: str = RECIPE,
    overrides: Sequence[str] = (),
    watcher: Watcher | None = None,
) -> RefinedColmap:
    """A COLMAP model with better poses: `model` is its folder, a `pycolmap.Reconstruction`, or a list of those.

    `depth`: folder of sensor depth images named as the colour images, `depth_scale` stored units to the metre. Without
    `out` nothing is written. Raises `HodgeError` (see `errors`) for whatever the user can mend.
    """
    given = {"database": database, "images": images, "depth": depth, "depth_scale": depth_scale}
    sets = [f"model.{name}={value}" for name, value in given.items() if value is not None]
    options = load_model_refinement(recipe, [*sets, *overrides])
    return run_refinement(model, options, out=None if out is None else Path(out), force=force, watcher=watcher)


def run_refinement(
    model: Any, options: ModelRefinement, *, out: Path | None, force: bool, watcher: Watcher | None = None
) -> RefinedColmap:
    """The same with the options bound already."""
    watcher = watcher or Nobody()
    is_path = isinstance(model, (str, Path))
    if out is not None:
        check_out(out, Path(model) if is_path else None)
    models = Path(model) if is_path else model if isinstance(model, (list, tuple)) else [model]
    with Monitor().measure() as cost, watcher.stage("refine", 1):
        results = refine_models(options.model.open_models(models), options, force=force)
    if out is not None:
        write_run_folder(out, results, options, str(model) if is_path else "pycolmap", cost)
    return RefinedColmap(results, out)

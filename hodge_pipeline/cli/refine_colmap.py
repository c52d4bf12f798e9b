"""`hodge refine colmap`: run the refinement, print what came out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hodge_pipeline.cli.console import ProgressBars, print_table
from hodge_pipeline.cli.run import resumable
from hodge_pipeline.errors import CheckError
from hodge_pipeline.refine.model_options import RECIPE, load_model_refinement

if TYPE_CHECKING:
    from hodge_pipeline.refine.model import RefinedModel


def refine(
    model: Path,
    out: Path,
    overrides: Sequence[str],
    *,
    recipe: str,
    force: bool,
    overwrite: bool,
    quiet: bool,
    as_json: bool,
    dask: str | None,
) -> None:
    """Refine a model into a run folder. Raises `CheckError` (exit code 3) where the guard kept the input as worse."""
    options = load_model_refinement(recipe or RECIPE, overrides)
    from hodge_pipeline.types.input_files import read_input_text
    from hodge_pipeline.uses.colmap import run_refinement

    with resumable(out), ProgressBars(quiet or as_json) as terminal:
        done = run_refinement(model, options, out=out, force=force, overwrite=overwrite, watcher=terminal, dask=dask)
    if as_json:
        print(read_input_text(out / "report.json"), end="")
    elif not quiet:
        for result in done.results:
            _print(result)
        if (out / "sparse").is_dir():
            print(f"{'model':<8} {out / 'sparse'}")
        print(f"{'report':<8} {out / 'report.html'}")
    failed = [result.decision.reason for result in done.results if result.decision.exit_code]
    if failed:
        written = any(result.decision.outcome == "worse" for result in done.results)
        kept = (
            "the input was given back (--force writes the result)" if written else "nothing was written but the report"
        )
        raise CheckError(f"{'; '.join(failed)}: {kept}")


def _print(result: RefinedModel) -> None:
    rows = [(m.name, f"{m.before:.4g}", f"{m.after:.4g}", m.unit) for m in result.decision.measures]
    if rows:
        print_table(f"{result.start.quality.images} images", ("measure", "before", "after", "unit"), rows)
    costs = [
        (name, f"{cost.px:.4g}", f"{cost.median_px:.4g}", str(len(cost.images_off)), "kept" * (row == result.kept_row))
        for row, (name, cost) in enumerate(result.candidates)
    ]
    print_table("candidates", ("candidate", "mean px", "median px", "images off", ""), costs)
    print(f"{'verdict':<8} {result.decision.outcome}: {result.decision.reason}")
    if result.decision.change is not None:
        print(f"{'change':<8} {result.decision.change}")
    for note in result.notes:
        print(f"{'note':<8} {note}")

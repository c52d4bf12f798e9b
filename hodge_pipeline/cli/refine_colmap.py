"""`hodge refine colmap`: run the refinement, print what came out."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hodge_pipeline.cli.console import ProgressBars, print_table
from hodge_pipeline.cli.options import Shown
from hodge_pipeline.cli.run import resumable
from hodge_pipeline.errors import CheckError
from hodge_pipeline.refine.model_options import RECIPE, load_model_refinement
from hodge_pipeline.report.brief import COLUMNS, LABEL, labelled
from hodge_pipeline.store.workspace import NUMBERS_FILE, PAGE_FILE
from hodge_pipeline.types.text import counted

if TYPE_CHECKING:
    from hodge_pipeline.refine.model import RefinedModel

MEASURES, NOTES = 4, 1
"""Printed of a model without `--verbose`."""


def refine(
    model: Path,
    out: Path,
    overrides: Sequence[str],
    shown: Shown,
    *,
    recipe: str,
    force: bool,
    overwrite: bool,
    dask: str | None,
) -> None:
    """Refine a model into a run folder. Raises `CheckError` (exit code 3) where the guard kept the input as worse."""
    options = load_model_refinement(recipe or RECIPE, overrides)
    from hodge_pipeline.types.input_files import read_input_text
    from hodge_pipeline.uses.colmap import run_refinement
    from hodge_pipeline.uses.model_folder import MODELS

    with resumable(out), ProgressBars.of(shown) as terminal:
        done = run_refinement(model, options, out=out, force=force, overwrite=overwrite, watcher=terminal, dask=dask)
    if shown.as_json:
        print(read_input_text(out / NUMBERS_FILE), end="")
    elif not shown.quiet:
        for result in done.results:
            if shown.verbose:
                _print_tables(result)
            print("\n".join(_lines(result, alone=len(done.results) == 1, verbose=shown.verbose)))
        if (out / MODELS).is_dir():
            print(f"{'model':<9}{out / MODELS}")
        print(f"{'report':<9}{out / PAGE_FILE}")
    failed = [result.decision.reason for result in done.results if result.decision.exit_code]
    if failed:
        written = any(result.decision.outcome == "worse" for result in done.results)
        kept = (
            "the input was given back (--force writes the result)" if written else "nothing was written but the report"
        )
        raise CheckError(f"{'; '.join(failed)}: {kept}")


def _print_tables(result: RefinedModel) -> None:
    rows = [(m.name, f"{m.before:.4g}", f"{m.after:.4g}", m.unit) for m in result.decision.measures]
    if rows:
        print_table(counted(result.start.quality.images, "image"), ("measure", "before", "after", "unit"), rows)
    costs = [
        (name, f"{cost.px:.4g}", f"{cost.median_px:.4g}", str(len(cost.images_off)), "kept" * (row == result.kept_row))
        for row, (name, cost) in enumerate(result.candidates)
    ]
    print_table("candidates", ("candidate", "mean px", "median px", "images off", ""), costs)


def _lines(result: RefinedModel, *, alone: bool, verbose: bool) -> list[str]:
    """The result of a model in eight lines of 80 columns, where there are several three, the first of which names it;
    `verbose`: every note, whole.
    """
    decision = result.decision
    told = decision.outcome in decision.reason  # "already optimal: …" says it
    outcome = "" if told else "kept as given" if decision.outcome in ("worse", "optimal") else decision.outcome
    named = ", ".join(f"{model.name} ({counted(model.quality.images, 'image')})" for model in result.inputs)
    lines = [] if alone else labelled("of", named)
    lines += labelled("verdict", ": ".join(filter(None, (decision.doubt, outcome, decision.reason))))
    if verbose or alone:
        lines += [f"  - {measure}" for measure in decision.measures[: len(decision.measures) if verbose else MEASURES]]
    if verbose and decision.change is not None:
        lines += labelled("change", str(decision.change))
    kept = result.candidates[result.kept_row][0]
    lines.append(f"{'kept':<9}{kept}, of {len(result.candidates)} candidates{'' if verbose else ': --verbose has all'}")
    if verbose:
        return lines + [line for note in result.notes for line in labelled("note", str(note))]
    shown = [textwrap.shorten(str(note), COLUMNS - LABEL, placeholder=" …") for note in result.notes]
    return lines + [f"{'note':<9}{note}" for note in shown[: NOTES if alone else 0]]

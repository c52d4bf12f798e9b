"""The command that solves a pose-graph file: `hodge solve`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hodge_pipeline.cli.console import ProgressBars, print_json
from hodge_pipeline.cli.convert import check_result, keep_source, writer_name
from hodge_pipeline.cli.options import Shown
from hodge_pipeline.errors import CheckError, RecipeError
from hodge_pipeline.pairs.edits import read_history
from hodge_pipeline.refine.pose_graph import SolvedFile, SolveOptions, solve_file, write_solved
from hodge_pipeline.report.brief import LABEL, at_most, labelled
from hodge_pipeline.report.verdict import in_pieces
from hodge_pipeline.solvers.backbone.trust import AUTO
from hodge_pipeline.solvers.maximum_likelihood import ObjectiveName
from hodge_pipeline.solvers.newton import TIME_LIMIT_REACHED
from hodge_pipeline.solvers.setup import InitialName
from hodge_pipeline.store.workspace import EDITS_FILE, PAGE_FILE, RECIPE_FILE
from hodge_pipeline.types.text import command, counted

COUNTED = ("pose", "edge", "piece")
"""Counts of the summary that are printed."""
KNOWN_ENDINGS = (".tum", ".kitti", ".csv", ".log", ".json", ".ply")
"""Endings that tell the format; any other is a g2o file's. `.txt` tells none: many programs name g2o files so."""
NOTES = 2
"""Printed without `--verbose`."""


def choices(
    objective: str | None,
    start: str,
    disable: list[str],
    time_limit_s: float,
    *,
    robust: bool,
    trust: str | None,
    certificate: bool,
    sesync_units: bool,
) -> SolveOptions:
    """The checked options; a certificate implies the isotropic objective, which alone has one.

    Raises `RecipeError` for options that are wrong or contradict each other.
    """
    named = objective or ("isotropic" if certificate or sesync_units else "full")
    for option, value, known in (
        ("--objective", named, get_args(ObjectiveName)),
        ("--start", start, ("given", "chordal")),
    ):
        if value not in known:
            raise RecipeError(f"{option} {value}: expected {' or '.join(known)}")
    if named == "full" and (certificate or sesync_units):
        raise RecipeError("--certificate and --sesync-units are for the isotropic objective: add --objective isotropic")
    if trust is not None and not robust:
        raise RecipeError(f"--trust {trust}: only a robust solve trusts some edges more than others: add --robust")
    if not time_limit_s > 0:
        raise RecipeError(f"--time-limit {time_limit_s:g}: expected seconds above zero")
    initial: InitialName = "given" if start == "given" else "chordal"
    chosen: ObjectiveName = "isotropic" if named == "isotropic" else "full"
    return SolveOptions(chosen, initial, robust, certificate, sesync_units, tuple(disable), trust or AUTO, time_limit_s)


def solve(
    path: Path,
    options: SolveOptions,
    shown: Shown,
    *,
    out: Path | None,
    run_folder: Path | None,
    dask: str | None,
) -> None:
    """Solve a file, write what was asked for, print a summary; `CheckError` where the result fails its own checks.

    A run folder given alone is solved and fused again, with its edits, and brought up to date.
    """
    if out is None and run_folder is None and options == SolveOptions() and (path / RECIPE_FILE).is_file():
        _solve_run(path, shown, dask)
        return
    if path.is_dir() and (history := read_history(path / EDITS_FILE)).edits:
        options = replace(options, disable=(*options.disable, *history.disabled))
        if out is None and not (path / RECIPE_FILE).is_file():
            run_folder = run_folder or path
    if out is not None:
        check_result(out)
        keep_source(path, out)
    with ProgressBars.of(shown) as terminal, terminal.stage("solve", 1):
        solved = solve_file(path, options)
    left_out: tuple[str, ...] = ()
    if out is not None:
        writer = writer_name(out, solved.source) if out.suffix.lower() in KNOWN_ENDINGS else "g2o"
        left_out = write_solved(out, solved, writer)
    if run_folder is not None:
        from hodge_pipeline.report.solved import write_run_folder

        left_out += write_run_folder(run_folder, solved)
    summary = solved.summary()
    summary["notes"] += dict.fromkeys(left_out)
    if shown.as_json:
        print_json({"source": str(solved.source.path), "out": None if out is None else str(out), **summary})
    elif not shown.quiet:
        print("\n".join(_lines(solved, summary, out, run_folder, verbose=shown.verbose)))
    _check(summary, options.initial)


def _solve_run(folder: Path, shown: Shown, dask: str | None) -> None:
    from hodge_pipeline.cli.run import check_outcome, print_result
    from hodge_pipeline.uses.recipe_run import solve_again

    with ProgressBars.of(shown) as terminal:
        result = solve_again(folder, watcher=terminal, dask=dask)
    print_result(result, shown)
    check_outcome(result)


def _lines(
    solved: SolvedFile, summary: dict[str, Any], out: Path | None, run_folder: Path | None, *, verbose: bool
) -> list[str]:
    """The verdict, what was solved, what to heed, where it is: ten lines; `verbose`: with every note, whole."""
    poses, edges, pieces = (counted(summary[f"{one}s"], one) for one in COUNTED)
    ignored = f", {summary['edges_ignored']} ignored" if summary["edges_ignored"] else ""
    shape = f"{summary['dimension']}-D, {poses}, {edges}{ignored}, {pieces}"
    lines = [*labelled("verdict", _headline(solved)), f"  - {solved.source.name}: {shape}"]
    if verbose:
        lines += [line for note in summary["notes"] for line in labelled("note", note)]
    else:
        lines += [line for note in summary["notes"][:NOTES] for line in at_most(labelled("note", note), 1)]
        if (left := len(summary["notes"]) - NOTES) > 0:
            lines.append(f"  - … and {counted(left, 'more note')}: --verbose")
    time = f"{summary['wall_s']:.3f} s, {summary['cpu_s']:.3f} CPU s, {counted(summary['newton_steps'], 'step')}"
    lines.append(f"{'time':<{LABEL}}{time}")
    lines += [f"{'written':<{LABEL}}{out}"] if out is not None else []
    lines += [f"{'report':<{LABEL}}{run_folder / PAGE_FILE}"] if run_folder is not None else []
    return [*lines, f"{'next':<{LABEL}}{command('hodge', 'diagnose', run_folder or solved.source.path)}"]


def _headline(solved: SolvedFile) -> str:
    """The verdict, after the pieces where no edge joins all poses, as on the page of a run."""
    sizes = np.unique_counts(solved.solution.component).counts
    joined = sorted(sizes[sizes > 1].tolist(), reverse=True)
    if not joined or joined[0] == len(solved.solution.component) or solved.torn:
        return solved.headline
    pieces = in_pieces(joined, len(solved.solution.component), "poses")
    return f"{pieces}: {solved.headline[:1].lower()}{solved.headline[1:]}"


def _check(summary: dict[str, Any], start: InitialName) -> None:
    if summary["pieces"] == summary["poses"] > 1:
        raise CheckError("no edge joins two poses: give a graph with measured edges")
    if summary["certified"] is False:
        raise CheckError("the result is not proven to be the global minimum: see the notes; try --start chordal")
    if summary["confirmed"] is False:
        raise CheckError(
            "nothing confirms the result: edges are left out, and the cycles of the others close no better than by "
            "chance; add edges between the same views, or see which are wrong with hodge diagnose"
        )
    if not summary["converged"]:
        remedy = "if edges may be wrong, hodge diagnose names them, or add --robust"
        if summary["stopped_by"] == TIME_LIMIT_REACHED:
            remedy = "raise --time-limit"
        elif start == "given":
            remedy = f"leave out --start given, since the edges alone may lead to better ones; {remedy}"
        raise CheckError(f"the solver stopped before it converged, with the best poses so far: {remedy}")

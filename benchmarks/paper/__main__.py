"""The paper's tables from start to end: `python -m benchmarks.paper`, which `make paper` calls."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.paper import tables as paper_tables
from benchmarks.paper.sequences import Found, find_sequences, peer_poses, recipe_file
from benchmarks.paper.tables import NAN, Measured, Results
from hodge_pipeline.cli.console import ProgressBars
from hodge_pipeline.cli.options import Dask
from hodge_pipeline.errors import HodgeError, RecipeError, SourceError
from hodge_pipeline.evaluation.scores import GRAPH_KINDS, GraphKind, score_table
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import has_truth, true_poses
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import Floats
from hodge_pipeline.uses.recipe_run import run as run_pipeline

HEADING = "The paper's tables"
OUTER_ITERATIONS = 3


def default_data() -> Path:
    """`HODGE_DATA`, else `shared/data` beside the working folder."""
    return Path(os.environ.get("HODGE_DATA", Path("..") / "shared" / "data"))


def paper(
    data: Annotated[
        Path | None,
        typer.Option(help="The folder with the sequences, or with seven_scenes/ and icl_nuim/. Default: HODGE_DATA."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Where the runs and the tables go; goes on where it stopped.")] = Path(
        "runs/paper"
    ),
    peer: Annotated[
        str | None,
        typer.Option(metavar="NAME=DIR", help="Another system's poses for the BF column, such as bundlefusion=DIR."),
    ] = None,
    frames: Annotated[int, typer.Option(min=10, help="Frames of a sequence at most; longer ones are thinned.")] = 250,
    dask: Dask = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change an option of the paper_* recipes."),
    ] = None,
    figure: Annotated[bool, typer.Option(help="Render GT, peer and ours side by side.")] = True,
) -> None:
    """Tables 1, 2 and 3 of the paper for every sequence that is there, beside the paper's own figures.

    Writes paper.md, paper.html, paper.csv and a picture for each sequence into --out.
    """
    peer_name, peer_folder = _peer_of(peer)
    data = data or default_data()
    found, missing = find_sequences(data, frames)
    if not found:
        names = "; ".join(f"{name}: {why}" for name, why in missing.items())
        raise SourceError(f"{data}: holds none of the paper's sequences ({names})")
    out.mkdir(parents=True, exist_ok=True)
    measured: dict[str, dict[GraphKind, Measured]] = {}
    pictures: dict[str, str] = {}
    for sequence in found:
        try:
            runs = {kind: _run(sequence, kind, out, overrides or [], dask) for kind in GRAPH_KINDS}
            poses, note = (None, "") if peer_folder is None else _peer(peer_folder, sequence, runs["distance"][0])
            measured[sequence.name] = {
                kind: _measured(run, kind, wall_s, poses, note) for kind, (run, wall_s) in runs.items()
            }
            if figure:
                pictures |= _picture(sequence.name, runs["distance"][0], poses, peer_name, out)
        except HodgeError as error:
            missing[sequence.name] = f"failed: {error}"
    tables = paper_tables.tables(Results(measured, missing, peer_name))
    artifacts.write_text(out / "paper.md", paper_tables.as_markdown(tables, HEADING))
    artifacts.write_text(out / "paper.csv", paper_tables.as_csv(tables))
    artifacts.write_text(out / "paper.html", paper_tables.as_html(tables, HEADING, pictures))
    print(paper_tables.as_markdown(tables, HEADING))
    print(f"The same as a page with pictures: {out / 'paper.html'}")
    failed = [f"{name} {why}" for name, why in missing.items() if why.startswith("failed")]
    if failed:
        raise SourceError("; ".join(failed))


def _peer_of(option: str | None) -> tuple[str, Path | None]:
    if option is None:
        return "", None
    name, equals, folder = option.partition("=")
    if not (name and equals and folder):
        raise RecipeError(f"--peer {option}: expected NAME=DIR, such as bundlefusion=runs/bundlefusion")
    if not Path(folder).is_dir():
        raise RecipeError(f"--peer {option}: no such folder: {folder}")
    return name, Path(folder)


def _run(sequence: Found, kind: GraphKind, out: Path, overrides: list[str], dask: str | None) -> tuple[Run, float]:
    reader = f"source.reader={{stage: {sequence.reader}, every: {sequence.every}}}"
    fixed = [reader, f"outer_iterations={OUTER_ITERATIONS}", "recording.level=off", "fusion=[]"]
    recipe = load_recipe(recipe_file(kind), [*fixed, *overrides], sequence.folder)
    begin = time.perf_counter()
    with ProgressBars(quiet=False) as terminal:
        terminal.say(f"{sequence.name}, {kind} graph: {sequence.folder}")
        run = run_pipeline(recipe, out / f"{sequence.name}-{kind}", overwrite=True, watcher=terminal, dask=dask)
    return run, time.perf_counter() - begin


def _peer(folder: Path, sequence: Found, run: Run) -> tuple[Floats | None, str]:
    try:
        return peer_poses(folder, sequence.name, run.source.frames)
    except HodgeError as error:
        return None, f"no peer: {error}"


def _measured(run: Run, kind: GraphKind, wall_s: float, peer: Floats | None, peer_note: str) -> Measured:
    solutions = [found.solution for found in run.rounds if found.solution is not None]
    first = solutions[0]
    stages = run.report.stages
    assert run.report.scores is not None
    (graph,) = (graph for graph in run.report.scores.graphs if graph.kind == kind)
    score = dict(zip(run.report.scores.names, graph.mean_score, strict=True))
    notes = [] if has_truth(run.source) else ["no GT: scored on the pairs of the result"]
    return Measured(
        frames=len(run.source.frames),
        pairs=len(graph.pairs),
        truth=float(score.get("truth", NAN)),
        first=float(score["round 1"]),
        third=float(score["result"]),
        deviations=tuple(s.history[-1].metrics["loop_deviation_sum"] for s in solutions if s.history),
        step_deviations=tuple(step.metrics["loop_deviation_sum"] for step in first.history),
        measured_deviation=first.metrics.get("measured_loop_deviation_sum", NAN),
        loops=int(first.metrics.get("loops", 0)),
        wall_s=sum(stage.wall_s for stage in stages) or wall_s,
        cpu_s=sum(stage.cpu_s for stage in stages),
        peer=NAN if peer is None else _peer_score(run, kind, peer),
        ate_m=tuple(row.ate_rmse_m for row in run.report.trajectories),
        notes=(*notes, *([peer_note] if peer_note else [])),
    )


def _peer_score(run: Run, kind: GraphKind, peer: Floats) -> float:
    """The peer's score on the pairs of the true poses, or of our result where there are none."""
    reference = true_poses(run.source) if has_truth(run.source) else run.poses
    sets = {"reference": reference, "peer": peer}
    with load_recipe(recipe_file(kind)).executor.open() as workers:
        table = score_table(run.clouds.folder, sets, "reference", workers, kinds=(kind,))
    return float(table.graphs[0].mean_score[1])


def _picture(name: str, run: Run, peer: Floats | None, peer_name: str, out: Path) -> dict[str, str]:
    from benchmarks.paper.picture import draw_comparison

    sets = {"GT": true_poses(run.source)} if has_truth(run.source) else {}
    if peer is not None:
        sets[peer_name] = peer
    sets["Hodge 3rd"] = run.poses
    path = out / f"{name}.png"
    draw_comparison(path, run.source.frames, sets)
    shown = ", ".join(sets)
    return {f"{name}: {shown}; the whole and four details, each from the same place": path.name}


def main() -> None:
    """Run it; what a user can mend is one line and exit code 1."""
    try:
        typer.run(paper)
    except HodgeError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()

"""What is reviewed: the edges of a run or of a pose graph, their poses, and where decisions about them are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import HodgeError, SourceError
from hodge_pipeline.pairs.edits import FILE
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import true_poses
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.sources.inspect import guess_reader, guesses
from hodge_pipeline.store.workspace import is_run_folder
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Solution, Source, ViewGraph
from hodge_pipeline.types.edges import DISABLED, REJECTED, USED
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import command

SIDE_FILE, SIDE_LOG = ".edits.json", ".decisions.csv"
LOG = "decisions.csv"


@dataclass(frozen=True)
class Subject:
    """What is reviewed.

    `edges` are those of the graph and the pairs that were rejected with a motion, row by row `graph`'s; `solution` is
    that of the graph with a weight for each of them. A run also has a recipe, clouds and, where its source is still
    there, frames (its key frames'). `truth (V, 4, 4)` is NaN where unknown. Decisions are kept in `edits`, their log in
    `log`; `locked` says why none can be taken.
    """

    path: Path
    name: str
    edges: Edges
    graph: ViewGraph
    solution: Solution
    edits: Path
    log: Path
    truth: Floats
    source: Source
    recipe: Recipe | None = None
    clouds: CloudSet | None = None
    frames: Sequence[Frame] = ()
    locked: str = ""
    notes: tuple[str, ...] = ()

    @property
    def is_run(self) -> bool:
        """Whether `hodge solve` fuses it again."""
        return self.recipe is not None


def open_for_review(path: Path) -> Subject:
    """What a path holds: a run, finished or not, or a pose graph. Raises `HodgeError` where it holds neither."""
    return _of_run(path) if is_run_folder(path) else _of_graph(path)


def _of_run(path: Path) -> Subject:
    run = Run.load(path)
    last, recipe = run.result, run.recipe
    rows = np.flatnonzero(last.edges.in_graph | _rejected_with_motion(last.edges))
    edges = last.edges.select(rows)
    left = int((last.edges.status == REJECTED).sum() - (edges.status == REJECTED).sum())
    unknown = tuple(str(Note("option unknown", detail=line)) for line in run.options_left_out)
    notes = (f"{left} rejected pairs have no motion and are not listed",) if left else ()
    frames, complaint = _frames(run, recipe)
    unfinished = "the run is not finished: run the same command again; until then it can only be looked at"
    return Subject(
        path=path,
        name=path.resolve().name,
        edges=edges,
        graph=edges.as_graph(last.vertex_ids),
        solution=_of_all(last.solution, last.world_from_cam, edges),
        edits=path / FILE,
        log=path / LOG,
        truth=true_poses(run.source)[run.key_frames.rows],
        source=run.source,
        recipe=recipe,
        clouds=run.clouds,
        frames=frames,
        locked="" if run.ending is not None else unfinished,
        notes=(*unknown, *notes, *complaint),
    )


def _rejected_with_motion(edges: Edges) -> Bools:
    """Where (E,) a rejected pair could be an edge: its motion is known, and how well."""
    known = np.isfinite(edges.i_from_j).all(axis=(1, 2)) & np.isfinite(edges.information).all(axis=(1, 2))
    rows = np.flatnonzero((edges.status == REJECTED) & known)
    definite = rows[np.linalg.eigvalsh(edges.information[rows]).min(axis=1, initial=np.inf) > 0]
    return np.isin(np.arange(len(edges)), definite)


def _of_all(solution: Solution | None, world_from_cam: Floats, edges: Edges) -> Solution:
    """The solution with a weight for every listed edge, 0 for those that are rejected."""
    weights = np.zeros(len(edges))
    weights[edges.in_graph] = edges.counts[edges.in_graph] if solution is None else solution.weights
    if solution is None:
        return Solution(world_from_cam, np.zeros(len(world_from_cam), np.int64), weights)
    return replace(solution, weights=weights)


def _frames(run: Run, recipe: Recipe) -> tuple[Sequence[Frame], tuple[str, ...]]:
    """The key frames with their images: a run can be reviewed when its source has gone."""
    path = recipe.source.path
    if path is None:
        return (), ()
    try:
        frames = (recipe.source.reader or guess_reader(path)).open(path).frames
    except (HodgeError, OSError) as error:
        return (), (f"without colour images: {error}",)
    if len(frames) != len(run.source.frames):
        return (), (f"without colour images: {path} has other frames by now",)
    return tuple(frames[row] for row in run.key_frames.rows), ()


def _of_graph(path: Path) -> Subject:
    if [guess.name for guess in guesses(path)[:1]] == ["colmap"]:
        diagnose, convert = command("hodge", "diagnose", path), command("hodge", "convert", path, "graph.json")
        raise SourceError(
            f"{path}: is a COLMAP model, whose points and images a review does not show: '{diagnose}' names its wrong "
            f"pairs, '{convert}' writes their graph, which can be reviewed"
        )
    source = read_graph(path)
    assert source.graph is not None
    graph = source.graph
    start = None if source.trajectory is None else source.trajectory.world_from_cam
    solution = solve(graph, start=start)
    kept = path if path.is_dir() else None
    return Subject(
        path=path,
        name=path.resolve().name,
        edges=Edges.measured(graph),
        graph=graph,
        solution=solution,
        edits=kept / FILE if kept else path.with_name(path.name + SIDE_FILE),
        log=kept / LOG if kept else path.with_name(path.name + SIDE_LOG),
        truth=np.full((graph.vertex_count, 4, 4), np.nan),
        source=source,
        notes=source.notes,
    )


def base_weights(subject: Subject) -> Floats:
    """The weight (E,) of each edge before any decision: 1, but 0 for those that are rejected or the solver left out.

    A solver that weighs edges by how well they fit has found its weights beside the wrong edges: these have driven
    right ones out, which count in full again here.
    """
    return np.where(subject.edges.status == DISABLED, 1.0, (subject.solution.weights > 0).astype(float))


def let_in(subject: Subject) -> Bools:
    """Where (E,) enabling an edge gives it weight: it was rejected or off by hand, not left out by the solver."""
    return np.asarray(np.isin(subject.edges.status, (REJECTED, DISABLED, USED)))

"""What is reviewed: the edges of a run, COLMAP model or pose graph, their poses, and the files of decisions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.refine.candidates import NO_EDGE
from hodge_pipeline.refine.model import refinable
from hodge_pipeline.refine.model_options import load_model_refinement
from hodge_pipeline.refine.model_solve import solve_bodies
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import true_poses
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.sources.inspect import guesses
from hodge_pipeline.store.workspace import EDITS_FILE, is_run_folder
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Solution, Source, ViewGraph
from hodge_pipeline.types.axes import is_scanner
from hodge_pipeline.types.edges import DISABLED, REJECTED, USED
from hodge_pipeline.types.text import UNKNOWN_UNIT, in_unit
from hodge_pipeline.types.tracked_model import TrackedModel

LOG = "decisions.csv"
"""The log in a folder."""
SIDE_FILE, SIDE_LOG = ".edits.json", ".decisions.csv"
"""Endings of the decisions and their log beside a file."""
UNITS = "the unit of length is the model's own"


@dataclass(frozen=True)
class Subject:
    """What is reviewed.

    - `edges`, and row by row `graph`: the edges of the solve and the rejected pairs that have a motion; `solution`: the
      poses with a weight (E,) for each of them.
    - `recipe`, `clouds`: of a run, the recipe scaled; `frames`: of its key frames, where the source is still there.
    - `model`: a COLMAP model, whose `clouds` are the points that each body sees, in the model's own unit.
    - `truth (V, 4, 4)`: NaN where unknown.
    - `edits`, `log`: the files of decisions and of their log; `locked`: why none can be taken, "" where they can.
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
    model: TrackedModel | None = None
    frames: Sequence[Frame] = ()
    locked: str = ""
    notes: tuple[str, ...] = ()

    @property
    def is_run(self) -> bool:
        """Whether `hodge solve` fuses it again."""
        return self.recipe is not None

    @property
    def is_scanner(self) -> bool:
        """Whether poses have x ahead and z up: of scans, and of graphs whose format does not say they are cameras'."""
        return not (self.is_run or self.source.of_cameras) if self.clouds is None else is_scanner(self.clouds)

    @property
    def finish(self) -> str:
        """What the page's last button says that it does."""
        if self.is_run:
            return "solve and fuse"
        return "save as g2o" if self.model is None else "adjust and save as COLMAP model"

    @property
    def unit(self) -> str:
        """The unit of lengths: a model without a scale has its own."""
        return "m" if self.model is None else UNKNOWN_UNIT

    def worded(self, sentence: str) -> str:
        """A sentence of the diagnosis, worded in metres, in the subject's unit."""
        return in_unit(sentence, self.unit == "m")


def open_for_review(path: Path) -> Subject:
    """The run, finished or not, COLMAP model or pose graph at a path. Raises `HodgeError` for anything else."""
    if is_run_folder(path):
        return _of_run(path)
    return _of_model(path) if [guess.name for guess in guesses(path)[:1]] == ["colmap"] else _of_graph(path)


def _of_run(path: Path) -> Subject:
    """The last round of a run, at its scale; a run that has not ended is locked."""
    run = Run.load(path)
    last, recipe = run.result, run.scaled_recipe
    rows = np.flatnonzero(last.edges.in_graph | _rejected_with_motion(last.edges))
    edges = last.edges.select(rows)
    left = int((last.edges.status == REJECTED).sum() - (edges.status == REJECTED).sum())
    notes = (f"{left} rejected pairs have no motion and are not listed",) if left else ()
    frames, complaint = run.key_frames_with_images()
    unfinished = "the run is not finished: run the same command again; until then it can only be looked at"
    return Subject(
        path=path,
        name=path.resolve().name,
        edges=edges,
        graph=edges.as_graph(last.vertex_ids),
        solution=_with_all_weights(last.solution, last.world_from_cam, edges),
        edits=path / EDITS_FILE,
        log=path / LOG,
        truth=true_poses(run.source)[run.key_frames.rows],
        source=run.source,
        recipe=recipe,
        clouds=run.clouds,
        frames=frames,
        locked="" if run.ending is not None else unfinished,
        notes=(*notes, *map(str, (*run.options_left_out, *complaint))),
    )


def _rejected_with_motion(edges: Edges) -> Bools:
    """Rejected pairs (E,) that could be edges: their motion is finite and their information positive definite."""
    known = np.isfinite(edges.i_from_j).all(axis=(1, 2)) & np.isfinite(edges.information).all(axis=(1, 2))
    rows = np.flatnonzero((edges.status == REJECTED) & known)
    definite = rows[np.linalg.eigvalsh(edges.information[rows]).min(axis=1, initial=np.inf) > 0]
    return np.isin(np.arange(len(edges)), definite)


def _with_all_weights(solution: Solution | None, world_from_cam: Floats, edges: Edges) -> Solution:
    """The solution with a weight for every listed edge, 0 of rejected ones; without one the poses as they are."""
    weights = np.zeros(len(edges))
    weights[edges.in_graph] = edges.counts[edges.in_graph] if solution is None else solution.weights
    if solution is None:
        return Solution(world_from_cam, np.zeros(len(world_from_cam), np.int64), weights)
    return replace(solution, weights=weights)


def _of_graph(path: Path) -> Subject:
    """A pose graph, solved with all its edges."""
    source = read_graph(path)
    assert source.graph is not None
    graph = source.graph
    start = None if source.trajectory is None else source.trajectory.world_from_cam
    return _beside(path, source, Edges.measured(graph), graph, solve(graph, start=start))


def _of_model(path: Path) -> Subject:
    """The largest model at a path as a graph of its bodies, solved by the relative motions that images measure."""
    options = load_model_refinement()
    models, left_out = refinable(options.model.open_models(path))
    model = max(models, key=lambda one: one.quality.images)
    graph, notes = model.measured()
    if not graph.edge_count:
        raise SourceError(f"{path}: {NO_EDGE}")
    solved = solve_bodies(graph, model.world_from_body, options.solver)
    first = np.unique(model.body_of_frame, return_index=True)[1]
    frames = tuple(model.frames[row] for row in first)
    source = Source(path.resolve().name, path, frames, notes=(*left_out, *model.notes, *notes, UNITS))
    return replace(
        _beside(path, source, Edges.measured(solved.graph), solved.graph, solved.solution),
        solution=replace(solved.solution, weights=np.where(solved.solution.kept, solved.solution.weights, 0.0)),
        clouds=model.seen_points(),
        frames=frames if any(frame.read_colour is not None for frame in frames) else (),
        model=model,
    )


def _beside(path: Path, source: Source, edges: Edges, graph: ViewGraph, solution: Solution) -> Subject:
    """A subject that is no run: its decisions are stored beside its file, or in its folder."""
    is_folder = path.is_dir()
    return Subject(
        path=path,
        name=path.resolve().name,
        edges=edges,
        graph=graph,
        solution=solution,
        edits=path / EDITS_FILE if is_folder else path.with_name(path.name + SIDE_FILE),
        log=path / LOG if is_folder else path.with_name(path.name + SIDE_LOG),
        truth=np.full((graph.vertex_count, 4, 4), np.nan),
        source=source,
        notes=source.notes,
    )


def base_weights(subject: Subject) -> Floats:
    """The weight (E,) of each edge before any decision: 1, but 0 for rejected edges and those the solver left out.

    The solver's own robust weights depend on the wrong edges in its graph, which lower those of right ones: here what
    counts counts in full. Edges disabled by hand have 1: the decision itself makes it 0.
    """
    return np.where(subject.edges.status == DISABLED, 1.0, (subject.solution.weights > 0).astype(float))


def let_in(subject: Subject) -> Bools:
    """Edges (E,) that enabling gives weight: rejected, used or disabled by hand, but not left out by the solver."""
    return np.asarray(np.isin(subject.edges.status, (REJECTED, DISABLED, USED)))

"""What is reviewed: the edges of a run, model or pose graph, their poses, and where decisions about them are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hodge_pipeline.errors import SourceError
from hodge_pipeline.pairs.edits import FILE
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.recording.shapes import is_scanner
from hodge_pipeline.refine.candidates import NO_EDGE
from hodge_pipeline.refine.model import refinable
from hodge_pipeline.refine.model_options import load_model_refinement
from hodge_pipeline.refine.model_solve import solve_bodies
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.report.advice import in_unit
from hodge_pipeline.run_folder import Run
from hodge_pipeline.scene import true_poses
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.sources.inspect import guesses
from hodge_pipeline.stages import TrackedModel
from hodge_pipeline.store.workspace import is_run_folder
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Frame, Solution, Source, ViewGraph
from hodge_pipeline.types.edges import DISABLED, REJECTED, USED
from hodge_pipeline.types.text import UNKNOWN_UNIT

SIDE_FILE, SIDE_LOG = ".edits.json", ".decisions.csv"
LOG = "decisions.csv"

UNITS = "the unit of length is the model's own"


@dataclass(frozen=True)
class Subject:
    """What is reviewed.

    `edges` are those of the graph and the pairs that were rejected with a motion, row by row `graph`'s; `solution` is
    that of the graph with a weight for each of them. A run also has a recipe, its scale on every length, clouds and,
    where its source is still there, frames (its key frames'); a `model` its points as clouds, in its own unit.
    `truth (V, 4, 4)` is NaN where unknown. Decisions are kept in `edits`, their log in `log`; `locked` says why none
    can be taken.
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
        """Whether its poses have x ahead and z up: those of a pose graph whose format tells of no cameras, of scans."""
        return not (self.is_run or self.source.of_cameras) if self.clouds is None else is_scanner(self.clouds)

    @property
    def finish(self) -> str:
        """What the last button does."""
        if self.is_run:
            return "solve and fuse"
        return "save as g2o" if self.model is None else "adjust and save as COLMAP model"

    @property
    def unit(self) -> str:
        """Of its lengths: those of a model without a scale are its own."""
        return "m" if self.model is None else UNKNOWN_UNIT

    def worded(self, sentence: str) -> str:
        """A sentence of the diagnosis, which speaks of metres, in the unit of these lengths."""
        return in_unit(sentence, self.unit == "m")


def open_for_review(path: Path) -> Subject:
    """What a path holds: a run, finished or not, a COLMAP model, a pose graph. Raises `HodgeError` for others."""
    if is_run_folder(path):
        return _of_run(path)
    return _of_model(path) if [guess.name for guess in guesses(path)[:1]] == ["colmap"] else _of_graph(path)


def _of_run(path: Path) -> Subject:
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
        solution=_of_all(last.solution, last.world_from_cam, edges),
        edits=path / FILE,
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


def _of_graph(path: Path) -> Subject:
    source = read_graph(path)
    assert source.graph is not None
    graph = source.graph
    start = None if source.trajectory is None else source.trajectory.world_from_cam
    return _beside(path, source, Edges.measured(graph), graph, solve(graph, start=start))


def _of_model(path: Path) -> Subject:
    """The largest model of a path, its bodies for vertices, at the poses that its measured edges agree with."""
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
        solution=replace(solved.solution, weights=np.where(solved.kept, solved.solution.weights, 0.0)),
        clouds=model.seen_points(),
        frames=frames if any(frame.read_colour is not None for frame in frames) else (),
        model=model,
    )


def _beside(path: Path, source: Source, edges: Edges, graph: ViewGraph, solution: Solution) -> Subject:
    """A subject that is no run: decisions are kept beside its file, or in its folder."""
    is_folder = path.is_dir()
    return Subject(
        path=path,
        name=path.resolve().name,
        edges=edges,
        graph=graph,
        solution=solution,
        edits=path / FILE if is_folder else path.with_name(path.name + SIDE_FILE),
        log=path / LOG if is_folder else path.with_name(path.name + SIDE_LOG),
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

"""One round: the pairs of an edge builder, registered from the poses so far, and the poses consistent with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.components import connected_components, in_runs
from hodge_pipeline.complex.energies import Energies
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import SUSPECT, WRONG
from hodge_pipeline.evaluation.residuals import with_residuals
from hodge_pipeline.pairs.candidates import merge
from hodge_pipeline.pairs.held_out import HeldOut
from hodge_pipeline.pairs.revisits import REVISIT
from hodge_pipeline.recipe.round_options import SolveWith
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.registration.acceptance import accepted, with_odometry
from hodge_pipeline.registration.register import register_edges
from hodge_pipeline.scene import START, Round, Scene
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.solvers.positions import Fixes, Placed, place
from hodge_pipeline.sources.measured_edges import without_measured
from hodge_pipeline.stages import ConsistencySolver, EdgeBuilder, Step, Steps, Workers
from hodge_pipeline.start.unordered.tour import propose_along_tour
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, Solution, Source, ViewGraph
from hodge_pipeline.types.axes import is_scanner, up_and_ahead
from hodge_pipeline.types.edges import HELD_OUT
from hodge_pipeline.types.notes import Note, notes_of

EDITED = "edited"
"""The name of a round that a person's edits made."""


@dataclass(frozen=True)
class Registered:
    """The input of a round's solve: `edges`, measured ones last, `fresh (F,)` the rows that the round registered from
    the poses `before (N, 4, 4)`; the solve begins at `start (N, 4, 4)` and may not leave out the rows `right`.
    """

    name: str
    edges: Edges
    fresh: Ints
    before: Floats
    start: Floats
    right: Bools | None = None

    def graph(self, vertex_ids: NDArray[np.generic]) -> ViewGraph:
        """The viewing graph of the edges that count."""
        return self.edges.as_graph(vertex_ids, self.edges.counts)

    def solved(self, solve_with: SolveWith) -> Bools:
        """Where (P,) a row is solved with: all that count, or those not judged wrong or suspect, or right by hand."""
        if solve_with == "all":
            return self.edges.counts
        kept = ~np.isin(self.edges.verdict, (WRONG, SUSPECT))
        return self.edges.counts & (kept if self.right is None else kept | self.right)

    @property
    def title(self) -> str:
        """The title of its solve."""
        return f"solve, {self.name}"


@dataclass(frozen=True)
class Work:
    """What every round of a run needs: `measured` edges join each round's graph as they are, `fixes` are positions that
    its poses are to meet.
    """

    recipe: Recipe
    steps: Steps
    scene: Scene
    measured: ViewGraph
    workers: Workers
    fixes: Fixes | None = None

    def placed_first(self) -> Round:
        """The first round with loops closed along the path, in the world of known positions if there are any, so that
        pairs that close loops are near.
        """
        scene = self.scene
        closed = scene.closed
        first = scene.first if closed is None else replace(scene.first, world_from_cam=closed.world_from_cam)
        if self.fixes is None or scene.is_given:
            return first
        up = self._up(first.world_from_cam)
        found = self.steps.step(place_first, first, self.fixes, up, title="known positions")
        return replace(first, world_from_cam=found)

    def propose(self, number: int, before: Round) -> Edges:
        """The pairs to register in round `number` from the poses of the one before."""
        scene, recipe = self.scene, self.recipe
        held_out = HeldOut(recipe.guard.held_out, recipe.seed) if scene.is_given else None
        proposed = self.steps.step(
            propose_edges, recipe.edges, scene.source, scene.clouds, before.world_from_cam, self.measured, held_out,
            scene.in_order, self.scale, title=f"edges, round {number}",
        )  # fmt: skip
        if scene.closed is not None:
            proposed = merge([proposed, Edges.proposed(scene.closed.pairs, REVISIT)])[0]
        return with_start_edges(proposed, scene.first)

    def register(self, number: int, edges: Edges, before: Round) -> Registered:
        """The candidates registered from the poses of the round before, and accepted or rejected."""
        world_from_cam, earlier = before.world_from_cam, before.registered(self.measured) if number > 1 else None
        if number == 1 and self.scene.steps_stand:
            earlier = before.edges.select(np.abs(np.diff(before.edges.pairs, axis=1)[:, 0]) == 1)
        registered = self.steps.step(
            register_edges, edges, self.scene.clouds, self.recipe.registration, world_from_cam, earlier, self.scale,
            self.recipe.acceptance.min_spread, before.before if number > 1 else None,
            title=f"registration, round {number}", total=int((edges.status != HELD_OUT).sum()), workers=self.workers,
        )  # fmt: skip
        fresh = np.flatnonzero(registered.status != HELD_OUT)
        edges = self.with_measured(self.accept(registered))
        return Registered(f"round {number}", edges, fresh, world_from_cam, world_from_cam)

    def accept(self, edges: Edges) -> Edges:
        """The table with the status of every registered pair, steps of odometry as in `with_odometry`."""
        found, slid = accepted(edges, self.recipe.acceptance, self.scene.drift, self.scene.in_order)
        if len(slid):
            self.steps.note(Note("slid", len(slid), in_runs(slid, self.scene.first.vertex_ids)))
        return found if self.scene.drift is None else with_odometry(found, self.scene.first.edges)

    def _up(self, world_from_cam: Floats) -> Floats:
        """The mean up direction (3,) in the world of the poses."""
        return up_and_ahead(world_from_cam, is_scanner(self.scene.clouds))[0]

    @property
    def scale(self) -> float:
        """Factor on lengths that are written for rooms."""
        return self.recipe.scale if isinstance(self.recipe.scale, float) else 1.0

    def with_measured(self, edges: Edges) -> Edges:
        """The table with the edges that came measured at its end."""
        return Edges.joined([edges, Edges.measured(self.measured)])

    def judge(self, registered: Registered) -> Registered:
        """The input of the solve with the verdict of the diagnosis on each edge."""
        title = f"diagnosis, {registered.name}"
        ids = self.scene.first.vertex_ids
        edges = self.steps.step(judge_edges, registered.edges, ids, self.recipe.diagnosis, title=title)
        return replace(registered, edges=edges)

    def solve(self, judged: Registered, found: Energies | None) -> Round:
        """The round of these edges, and the poses consistent with those that the recipe solves with."""
        recipe, ids = self.recipe, self.scene.first.vertex_ids
        up = None if self.fixes is None else self._up(judged.start)
        return self.steps.step(
            solve_edges, judged, ids, recipe.solver, recipe.solve_with, found, self.fixes, up, title=judged.title
        )


def propose_edges(
    builder: EdgeBuilder,
    source: Source,
    clouds: CloudSet,
    world_from_cam: Floats,
    measured: ViewGraph,
    held_out: HeldOut | None,
    in_order: bool,
    scale: float,
    *,
    step: Step,
) -> Edges:
    """Step: the pairs to register, from the poses so far; measured ones are not registered again.

    Where the run starts from given poses a share of them is kept out, for its guard.
    """
    if in_order:
        candidates = builder.propose(source.frames, clouds, world_from_cam)
    else:
        candidates = propose_along_tour(builder, source.frames, clouds, world_from_cam, scale)
    candidates = without_measured(candidates, measured)
    return candidates if held_out is None else candidates.put(held_out.of(candidates), status=HELD_OUT)


def with_start_edges(candidates: Edges, first: Round) -> Edges:
    """The candidates, and those edges of the start that join different components of the candidates.

    Candidates of consecutive frames do not connect: across a gap these may share nothing.
    """
    if first.name != START:
        return candidates
    proven = candidates.pairs[~np.isin(candidates.proposed_by, ("sequential", "nearest"))]
    component = connected_components(proven, len(first.vertex_ids))
    joining = component[first.edges.pairs[:, 0]] != component[first.edges.pairs[:, 1]]
    if not joining.any():
        return candidates
    pairs = np.unique(np.sort(first.edges.pairs[joining], axis=1), axis=0)
    return merge([candidates, Edges.proposed(pairs, START)])[0]


def place_first(first: Round, fixes: Fixes, up: Floats, *, step: Step) -> Floats:
    """Step: the first poses (N, 4, 4) with the known positions, by the edges that they come from."""
    edges = first.edges.select(first.edges.counts)
    graph = edges.as_graph(first.vertex_ids)
    component = connected_components(graph.edges, graph.vertex_count)
    return place(graph, first.world_from_cam, component, np.ones(len(edges)), fixes, up).world_from_cam


def solve_edges(
    registered: Registered,
    vertex_ids: NDArray[np.generic],
    solver: ConsistencySolver,
    solve_with: SolveWith,
    found: Energies | None,
    fixes: Fixes | None,
    up: Floats | None,
    *,
    step: Step,
) -> Round:
    """Step: the round of these edges, with poses consistent with them and with `fixes`.

    `up (3,)` points up in the world of the start; `found` are the energies of ω before the solve.
    """
    edges, solved = registered.edges, registered.solved(solve_with)
    graph = edges.as_graph(vertex_ids, solved)
    solution = solver.solve(graph, registered.start)
    if registered.right is not None:
        solution = with_right(graph, solution, registered.right[solved])
    placed: Placed | None = None
    if fixes is not None and up is not None:
        placed = place(graph, solution.world_from_cam, solution.component, solution.weights, fixes, up)
        solution = replace(solution, world_from_cam=placed.world_from_cam, component=placed.component)
    weights = np.zeros(len(edges))
    weights[solved] = solution.weights
    solution = replace(solution, weights=weights[edges.in_graph])
    if left_out := int((edges.counts & ~solved).sum()):
        step.note(Note("left out", left_out, registered.name))
    step.note(*notes_of("solver", (f"{registered.name}: {note}" for note in solution.notes)))
    return Round(
        with_residuals(edges, solution.world_from_cam, solution.weights), vertex_ids, solution.world_from_cam,
        solution, registered.fresh, registered.before, found, edited=registered.name == EDITED,
        position_fit=None if placed is None else placed.fit,
    )  # fmt: skip


def with_right(graph: ViewGraph, solution: Solution, right: Bools) -> Solution:
    """The solution with the `right (E,)` edges put back that a robust solver left out."""
    left_out = np.flatnonzero(right & ~solution.kept)
    if not len(left_out):
        return solution
    editor = GraphEditor(graph, solution)
    editor.restore(left_out)
    better = editor.solve()
    note = f"edges that are right by hand and that the solver had left out: {len(left_out)}"
    return replace(better, notes=(*solution.notes, note))


def judge_edges(edges: Edges, vertex_ids: NDArray[np.generic], options: DiagnosisOptions, *, step: Step) -> Edges:
    """Step: the table with the verdict of the diagnosis on each edge of its graph, those off by hand included."""
    unjudged = edges.put(slice(None), verdict="", probability=np.nan, leverage=np.nan)
    return diagnose(edges.as_graph(vertex_ids, edges.in_graph), options).put_into(unjudged)

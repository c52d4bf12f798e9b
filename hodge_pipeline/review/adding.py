"""An edge added by hand: a first guess, registration by the run's own registrar, acceptance and residual."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.registration.seen_through import with_seen_through
from hodge_pipeline.types import CloudSet, Edges, Floats, Registration, ViewGraph

LEAST_POINTS = 3
"""Point pairs that fix a rigid motion."""
LEAST_SPREAD = 1e-3
"""Second singular value over the first of the points clicked, below which they lie on a line."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Candidate:
    """A pair of vertex rows (i, j) that may become an edge.

    - `guess (4, 4)`: i_from_j, from `guess_by`; `points_i`, `points_j`: points clicked, in the axes of each camera.
    - `found`: the registration, None before it; `rejected`: why acceptance rejects that, "" where it does not;
      `residual_m`, `residual_deg`: how far it is from the present poses.
    """

    i: int
    j: int
    guess: Floats
    guess_by: str = "the poses"
    found: Registration | None = None
    rejected: str = ""
    residual_m: float = float("nan")
    residual_deg: float = float("nan")
    points_i: tuple[Point, ...] = ()
    points_j: tuple[Point, ...] = ()

    @property
    def motion(self) -> Floats:
        """The motion i_from_j (4, 4) that was registered, else the guess."""
        return self.guess if self.found is None else self.found.i_from_j

    def clicked(self, point: Point) -> Candidate:
        """The candidate with one more point, in i's and in j's cloud by turns; three pairs or more make the guess."""
        first, second = self.points_i, self.points_j
        first, second = ((*first, point), second) if len(first) == len(second) else (first, (*second, point))
        guess, by = self.guess, self.guess_by
        if len(first) == len(second) >= LEAST_POINTS:
            guess, by = guess_from_points(np.array(first), np.array(second)), f"{len(first)} point pairs"
        return Candidate(self.i, self.j, guess, by, points_i=first, points_j=second)


def guess_from_points(points_in_i: Floats, points_in_j: Floats) -> Floats:
    """The rigid motion `i_from_j (4, 4)` with the least squared distances of point pairs (N, 3) (Arun et al. 1987).

    Raises `GraphError` for fewer than three pairs, or pairs on a line.
    """
    first, second = np.asarray(points_in_i, float), np.asarray(points_in_j, float)
    if len(first) != len(second) or len(first) < LEAST_POINTS:
        raise GraphError(f"{len(first)} and {len(second)} points clicked: click three pairs or more, in both clouds")
    for name, points in (("first", first), ("second", second)):
        sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if sizes[1] <= LEAST_SPREAD * max(sizes[0], 1e-12):
            raise GraphError(f"the points clicked in the {name} cloud lie on a line: click one beside it")
    return se3.fit_rigid(first, second)


def register_candidate(recipe: Recipe, clouds: CloudSet, wanted: Candidate) -> Registration:
    """The pair registered from its guess by the registrar of a run's `scaled_recipe`.

    Raises `GraphError` where a frame has no cloud.
    """
    for row in (wanted.i, wanted.j):
        if not len(clouds[row]):
            raise GraphError(f"frame {row} has no points: pick another")
    registrar = recipe.registration
    target, source = (registrar.prepare(clouds[row]) for row in (wanted.i, wanted.j))
    return registrar.register(target, source, wanted.guess)


def assessed(
    recipe: Recipe,
    graph: ViewGraph,
    clouds: CloudSet,
    world_from_cam: Floats,
    wanted: Candidate,
    found: Registration,
) -> Candidate:
    """The candidate with its registration, the acceptance's reason against it, and the residual at poses (V, 4, 4)."""
    row = Edges.of([[wanted.i, wanted.j]]).with_registrations([found])
    row = with_seen_through(row, clouds, float(recipe.scale))
    residual_m, residual_rad = edge_residuals(row.as_graph(graph.vertex_ids), world_from_cam)
    return replace(
        wanted,
        found=found,
        rejected=str(recipe.acceptance.reasons(row)[0]),
        residual_m=float(residual_m[0]),
        residual_deg=float(np.degrees(residual_rad[0])),
    )

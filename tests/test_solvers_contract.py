"""Every registered solver against the contract of solvers; solvers that break it are noticed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from hodge_pipeline import registry, se3
from hodge_pipeline.complex.checks import orthonormal
from hodge_pipeline.testing import check_solver
from hodge_pipeline.types import Floats, Solution, ViewGraph

LACKS = {
    "maximum_likelihood": {"wrong copy of an edge"},  # least squares: every edge counts
    "paper": {"wrong copy of an edge", "zero information"},  # every edge counts, and each as much as the others
    "poisson": {"zero information", "wrong copy of an edge"},  # unit weights by default, least squares
}


@pytest.mark.parametrize("name", registry.names("solvers"))
@pytest.mark.parametrize("what", check_solver.properties)
def test_every_solver_keeps_the_contract(name: str, what: str) -> None:
    check_solver(registry.load("solvers", name)(), lacks=LACKS.get(name, set()), properties=[what])


@dataclass(frozen=True)
class Spoiled:
    """The solver `maximum_likelihood` with something spoiled: what it is given, or what it gives."""

    before: Callable[[ViewGraph, Floats], tuple[ViewGraph, Floats]] = lambda graph, start: (graph, start)
    after: Callable[[Solution, Floats], Solution] = lambda solution, start: solution

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        return self.after(PLAIN().solve(*self.before(graph, world_from_cam)), world_from_cam)


PLAIN = registry.load("solvers", "maximum_likelihood")


def in_place(graph: ViewGraph, start: Floats) -> tuple[ViewGraph, Floats]:
    graph.i_from_j[:] = orthonormal(graph.i_from_j)
    start += 1e-12
    return graph, start


def without_fixed(graph: ViewGraph, start: Floats) -> tuple[ViewGraph, Floats]:
    return replace(graph, fixed=np.zeros(0, np.int64)), start


def without_priors(graph: ViewGraph, start: Floats) -> tuple[ViewGraph, Floats]:
    return replace(graph, priors=None), start


def made_rigid(graph: ViewGraph, start: Floats) -> tuple[ViewGraph, Floats]:
    motions = np.nan_to_num(graph.i_from_j)
    return replace(graph, i_from_j=se3.from_parts(se3.project_to_so3(motions[:, :3, :3]), motions[:, :3, 3])), start


def first_copies(graph: ViewGraph, start: Floats) -> tuple[ViewGraph, Floats]:
    rows = np.unique(graph.edges, axis=0, return_index=True)[1]
    information = np.zeros_like(graph.information)
    information[rows] = graph.information[rows]
    return replace(graph, information=information), start


def undirected(graph: ViewGraph, start: Floats) -> tuple[ViewGraph, Floats]:
    return replace(graph, edges=np.sort(graph.edges, axis=1)), start


def as_one_piece(solution: Solution, start: Floats) -> Solution:
    return replace(solution, component=np.zeros_like(solution.component))


def at_the_start(solution: Solution, start: Floats) -> Solution:
    return replace(solution, world_from_cam=start.copy())


def in_metres(solution: Solution, start: Floats) -> Solution:
    """Steps of at most 10 m: no matter in metres."""
    moved = np.clip(solution.world_from_cam - start, -10, 10)
    return replace(solution, world_from_cam=start + moved)


def without_notes(solution: Solution, start: Floats) -> Solution:
    return replace(solution, notes=())


@pytest.mark.parametrize(
    ("solver", "what", "why"),
    [
        (Spoiled(in_place), "exact edges", "changes the graph or the start"),
        (Spoiled(without_fixed), "fixed vertices", "do not follow the fixed vertices"),
        (Spoiled(without_priors), "priors", "do not lie where the only prior says"),
        (Spoiled(made_rigid), "motions not rigid", "an edge that is transposed must raise"),
        (Spoiled(first_copies), "order of parallel edges", "a wrong copy of an edge counts otherwise"),
        (Spoiled(undirected), "reversed edges", "half of the edges measured the other way"),
        (Spoiled(after=as_one_piece), "disconnected graph", "components are numbered by their size"),
        (Spoiled(after=at_the_start), "exact edges", "do not give back the true poses"),
        (Spoiled(after=in_metres), "units x 1000", "millimetres give other poses"),
        (Spoiled(after=without_notes), "no edges", "no note says that nothing was solved"),
        (Spoiled(after=without_notes), "zero information", "no note tells of edges without information"),
        (Spoiled(after=without_notes), "disconnected graph", "no note tells of the pieces"),
        (PLAIN(), "wrong copy of an edge", "is believed"),
    ],
)
def test_a_solver_that_breaks_the_contract_is_noticed(solver: object, what: str, why: str) -> None:
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        check_solver(solver, properties=[what])  # type: ignore[arg-type]


def test_an_error_that_is_no_assertion_is_named() -> None:
    def divide(graph: ViewGraph, start: Floats) -> tuple[ViewGraph, Floats]:
        raise ZeroDivisionError("weights sum to zero")

    with pytest.raises(AssertionError, match="^no edges: raises ZeroDivisionError: weights sum to zero"):
        check_solver(Spoiled(divide), properties=["no edges"])


def test_what_is_declared_as_lacking_must_be_lacking() -> None:
    with pytest.raises(AssertionError, match="priors: declared as lacking, but it holds"):
        check_solver(PLAIN(), lacks=["priors"], properties=["priors"])
    with pytest.raises(AssertionError, match=r"no such property: \['speed'\]"):
        check_solver(PLAIN(), lacks=["speed"])

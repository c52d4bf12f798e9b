"""Edges that measure some axes alone: they count where other edges hold what they do not measure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backbone_graphs import Drive, drive
from hodge_pipeline.diagnosis.diagnosis import backbone_or_diagnosis, diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.robust import solve_robust
from hodge_pipeline.solvers.covariance import relative_covariances
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.solvers.explained import degrees_of_freedom
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Bools, ViewGraph
from solver_graphs import ladder

UNMEASURED = {
    "x, y and heading": [0, 1, 5],
    "x and y": [0, 1, 2, 5],
    "heading": [0, 1, 3, 4, 5],
    "height": [0, 1, 2, 3, 4],
}
PLANAR = UNMEASURED["x, y and heading"]


def blind(graph: ViewGraph, rows: Bools, axes: list[int]) -> ViewGraph:
    """The graph whose edges `rows (E,)` have no information on these axes."""
    information = graph.information.copy()
    chosen = np.flatnonzero(rows)[:, None]
    information[chosen, axes] = 0
    information[chosen, :, axes] = 0
    return replace(graph, information=information)


def far(graph: ViewGraph) -> Bools:
    """The edges that are no steps."""
    return np.abs(np.diff(graph.edges, axis=1)[:, 0]) > 1


@pytest.fixture(scope="module", params=["ring", "town"])
def made(request: pytest.FixtureRequest) -> Drive:
    return drive(seed=3, dimension=3, world=request.param, loops=31, wrong=0.0)


@pytest.mark.parametrize(
    ("measured", "share"), [("x, y and heading", 0.6), ("x and y", 0.6), ("heading", 0.99), ("height", 0.99)]
)
def test_loops_count_for_what_they_measure(made: Drive, measured: str, share: float) -> None:
    """They were ignored: the poses were the odometry's, 1.1 and 1.6 m off."""
    graph = blind(made.graph, far(made.graph), UNMEASURED[measured])
    solution = solve(graph)
    assert solution.converged
    assert solution.weights.all()
    assert made.error_m(solution.world_from_cam) < share * made.error_m(made.odometry())
    assert "31 edges measure some axes alone, which count" in solution.notes


def test_the_robust_solve_heeds_the_loops_that_the_diagnosis_confirms(made: Drive) -> None:
    """31 of 31 loops were confirmed, and the solve ignored them all."""
    graph = blind(made.graph, far(made.graph), PLANAR)
    solution = solve_robust(graph)
    np.testing.assert_array_equal(solution.weights > 0, diagnose(graph).kept)
    assert "31 of 31 loops confirmed" in " ".join(solution.notes)
    assert made.error_m(solution.world_from_cam) < 0.6 * made.error_m(made.odometry())


def test_what_is_stated_of_an_unmeasured_axis_does_not_matter(made: Drive) -> None:
    graph = blind(made.graph, far(made.graph), UNMEASURED["x and y"])
    motion = graph.i_from_j.copy()
    lift = np.tile(np.eye(4), (31, 1, 1))
    lift[:, 2, 3] = np.random.default_rng(0).normal(size=31)
    motion[far(graph)] = motion[far(graph)] @ lift
    one, two = solve(graph), solve(replace(graph, i_from_j=motion))
    assert two.metrics["objective"] == pytest.approx(one.metrics["objective"], rel=1e-6)
    np.testing.assert_allclose(two.world_from_cam, one.world_from_cam, atol=2e-3)


@pytest.mark.parametrize("indefinite", [False, True])
def test_scalar_weights_take_no_such_edge(made: Drive, indefinite: bool) -> None:
    graph = blind(made.graph, far(made.graph), PLANAR)
    if indefinite:
        information = graph.information.copy()
        information[7, 0, 3] = information[7, 3, 0] = 1e5
        graph = replace(graph, information=information)
    solution = solve(graph, objective="full" if indefinite else "isotropic")
    np.testing.assert_array_equal(solution.weights > 0, ~far(graph))
    assert any(note.startswith("31 edges have information on some axes alone") for note in solution.notes)
    bare = solve(graph.select(np.flatnonzero(~far(graph))), objective="isotropic")
    np.testing.assert_allclose(solution.world_from_cam, bare.world_from_cam, atol=1e-6)


def parted() -> ViewGraph:
    """0—2—4  6—8—10     a ladder whose middle rails, and a diagonal beside them, measure x, y and the heading alone
    |  |  |  |  |  |
    1—3—5  7—9—11
    """
    graph, _ = ladder(0.01)
    middle = np.isin(graph.edges, [4, 5]).any(axis=1) & np.isin(graph.edges, [6, 7]).any(axis=1)
    assert middle.sum() == 2
    return blind(graph, middle, PLANAR)


def test_edges_that_nothing_else_holds_join_no_pieces() -> None:
    """What they do not measure would be free between the two pieces."""
    solution = solve(parted())
    assert len(np.unique(solution.component)) == 2
    assert (solution.weights == 0).sum() == 2
    assert any(note.startswith("2 edges have information on some axes alone") for note in solution.notes)


def test_weights_of_a_robust_solve_are_those_of_the_edges_that_it_solved() -> None:
    graph = parted()
    found = solve_robust(graph, diagnosis=DiagnosisOptions(trust="none"))
    np.testing.assert_array_equal(np.flatnonzero(found.weights == 0), np.flatnonzero(solve(graph).weights == 0))
    made = drive(seed=3, dimension=3, loops=31, wrong=0.0)
    cut = blind(made.graph, (np.sort(made.graph.edges, axis=1) == [200, 201]).all(axis=1) | far(made.graph), PLANAR)
    backbone, solution = (
        backbone_or_diagnosis(cut, DiagnosisOptions(trust="sequential")),
        solve_robust(cut, diagnosis=DiagnosisOptions(trust="sequential")),
    )
    over = (made.graph.edges <= 200).sum(axis=1) == 1
    assert (backbone.used & over).any()
    assert not (solution.weights > 0)[over].any()
    assert (solution.weights > 0)[backbone.used & ~over].all()


def test_editing_parts_what_only_such_an_edge_joins() -> None:
    graph, _ = ladder(0.01)
    rails = np.flatnonzero(np.isin(graph.edges, [4, 5]).any(axis=1) & np.isin(graph.edges, [6, 7]).any(axis=1))
    one = np.arange(graph.edge_count) == rails[0]
    editor = GraphEditor(blind(graph, one, PLANAR))
    assert len(np.unique(editor.solution.component)) == 1
    editor.disable([int(rails[1])])
    edited = editor.solve()
    assert len(np.unique(edited.component)) == 2
    assert edited.weights[rails].tolist() == [0, 0]


def test_covariances_shrink_along_the_axes_that_an_edge_measures() -> None:
    graph, _ = ladder(0.01)
    rung = (graph.edges == [0, 1]).all(axis=1)
    with_rung = blind(graph, rung, PLANAR)
    without = graph.select(np.flatnonzero(~rung))
    one, two = (
        np.diag(relative_covariances(each, solve(each).world_from_cam, np.array([[0, 1]]))[0])
        for each in (with_rung, without)
    )
    assert (one[[2, 3, 4]] < 0.8 * two[[2, 3, 4]]).all()


@pytest.mark.parametrize(("axes", "stated"), [([], 6), (PLANAR, 3), ([0, 1, 3, 4, 5], 1)])
def test_degrees_of_freedom_count_what_is_measured(axes: list[int], stated: int) -> None:
    graph, _ = ladder(0.01)
    rung = (graph.edges == [0, 1]).all(axis=1)
    counted = degrees_of_freedom(blind(graph, rung, axes), solve(graph))
    assert counted == 6 * (graph.edge_count - 1 - graph.vertex_count + 1) + stated

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.editing import GraphEditor
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Solution, ViewGraph


def ring(seed: int = 0, noise: float = 0.1, count: int = 10) -> ViewGraph:
    """A ring, with a chord from each vertex to the third after it and one tail vertex that a single edge holds."""
    rng = np.random.default_rng(seed)
    truth = se3.exp(rng.normal(size=(count + 1, 6)))
    edges = np.array([(i, (i + s) % count) for s in (1, 3) for i in range(count)] + [(0, count)])
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(noise * rng.normal(size=(len(edges), 6)))
    information = np.tile(np.diag([4.0, 4, 4, 1, 1, 1]), (len(edges), 1, 1))
    return ViewGraph.from_edges(np.arange(count + 1), edges, measured, information)


def scaled(graph: ViewGraph, weights: np.ndarray) -> ViewGraph:
    kept = np.flatnonzero(weights > 0)
    part = graph.select(kept)
    return ViewGraph.from_edges(
        part.vertex_ids, part.edges, part.i_from_j, part.information * weights[kept, None, None]
    )


def same(one: Solution, other: Solution) -> None:
    assert one.metrics["objective"] == pytest.approx(other.metrics["objective"], rel=1e-7)
    assert one.component.tolist() == other.component.tolist()
    for piece in range(one.component.max() + 1):
        rows = np.flatnonzero(one.component == piece)
        a, b = one.world_from_cam[rows], other.world_from_cam[rows]
        np.testing.assert_allclose(se3.inverse(a[:1]) @ a, se3.inverse(b[:1]) @ b, atol=3e-4)


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10**6), objective=st.sampled_from(["isotropic", "full"]))
def test_edits_give_what_a_fresh_solve_gives(seed, objective):
    graph = ring(seed)
    rng = np.random.default_rng(seed)
    editor = GraphEditor(graph, objective=objective)
    for _ in range(3):
        rows = rng.choice(20, 3, replace=False)
        editor.reweight(rows, rng.choice([0.0, 0.5, 1.0, 3.0], 3))
        same(editor.solve(), solve(scaled(graph, editor.weights), objective=objective))


def test_a_solve_cut_short_goes_on_where_it_was():
    graph = ring(noise=0.3)
    editor = GraphEditor(graph)
    editor.disable([2, 5])
    first = editor.solve(max_iterations=1)
    assert first.converged is False
    rest = editor.solve()
    assert rest.metrics["objective"] < first.metrics["objective"]
    same(rest, solve(scaled(graph, editor.weights)))


def test_undo_takes_back_edit_and_solve():
    editor = GraphEditor(ring())
    before = editor.solution
    editor.disable([2, 5])
    changed = editor.solve()
    assert changed.weights[[2, 5]].tolist() == [0, 0]
    assert changed.metrics["objective"] < before.metrics["objective"]
    editor.undo()
    assert editor.solution is before
    assert editor.weights.all()
    with pytest.raises(GraphError, match="no edit to undo"):
        editor.undo()


def test_restored_edges_count_again():
    editor = GraphEditor(ring())
    first = editor.solution.metrics["objective"]
    editor.disable([4])
    editor.solve()
    editor.restore([4])
    assert editor.solve().metrics["objective"] == pytest.approx(first, rel=1e-8)


def test_pieces_part_and_join_again():
    graph = ring()
    editor = GraphEditor(graph)
    editor.disable([20])
    apart = editor.solve()
    assert apart.component[-1] == 1
    same(apart, solve(scaled(graph, editor.weights)))
    editor.restore([20])
    same(editor.solve(), solve(graph))


def test_an_edge_that_parts_pieces_and_one_that_does_not():
    graph = ring()
    editor = GraphEditor(graph)
    editor.disable([20, 3])
    same(editor.solve(), solve(scaled(graph, editor.weights)))


def test_added_edges_are_solved_and_taken_back():
    graph = ring()
    editor = GraphEditor(graph)
    rows = editor.add(np.array([[2, 7]]), se3.exp(np.full((1, 6), 0.2)))
    assert rows.tolist() == [21]
    more = editor.solve()
    assert len(more.weights) == 22
    same(more, solve(editor.graph))
    editor.disable(rows)
    same(editor.solve(), solve(graph))
    editor.undo()
    editor.undo()
    assert editor.graph is graph


def test_many_edits_at_once_are_factorised_anew():
    graph = ring(count=40)
    editor = GraphEditor(graph)
    editor.reweight(np.arange(40), 2.0)
    same(editor.solve(), solve(scaled(graph, editor.weights)))


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda e: e.disable([99]), "there is no edge 99"),
        (lambda e: e.reweight([1], -1.0), "finite and not negative"),
        (lambda e: e.reweight([1], np.nan), "finite and not negative"),
    ],
)
def test_edits_that_make_no_sense_are_one_line(edit, message):
    editor = GraphEditor(ring())
    with pytest.raises(GraphError, match=message):
        edit(editor)


def test_the_solution_must_be_of_the_graph():
    with pytest.raises(GraphError, match="not of this graph"):
        GraphEditor(ring(), solve(ring(count=12)))


def noisy_grid(side: int) -> ViewGraph:
    rng = np.random.default_rng(1)
    grid = np.arange(side * side).reshape(side, side)
    edges = np.concatenate(
        [np.stack([a.ravel(), b.ravel()], axis=1) for a, b in ((grid[1:], grid[:-1]), (grid[:, 1:], grid[:, :-1]))]
    )
    return ViewGraph.from_edges(grid.ravel(), edges, se3.exp(0.05 * rng.normal(size=(len(edges), 6))))


def test_changes_settle_nearby_first():
    """On a grid of 90 x 90 an edit is solved in its neighbourhood, then everywhere if need be: the same minimum."""
    graph = noisy_grid(90)
    editor = GraphEditor(graph, objective="isotropic")
    iterations = []
    for row in (89, 4000, 15990):
        editor.disable([row])
        warm = editor.solve()
        iterations.append(warm.metrics["iterations"])
    assert max(iterations) <= 2
    assert min(iterations) == 0, "no edit was settled in its neighbourhood alone"
    cold = solve(scaled(graph, editor.weights), objective="isotropic", relative_tolerance=1e-12)
    assert warm.metrics["objective"] == pytest.approx(cold.metrics["objective"], rel=2e-9)


def test_a_solution_of_another_objective_is_not_taken_for_the_minimum():
    graph = noisy_grid(75)
    editor = GraphEditor(graph, solve(graph, objective="isotropic", relative_tolerance=1e-2), objective="full")
    editor.disable([4000])
    found = editor.solve()
    cold = solve(scaled(graph, editor.weights))
    assert found.metrics["objective"] == pytest.approx(cold.metrics["objective"], rel=1e-8)

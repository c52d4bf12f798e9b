"""A loop with one wrong edge and nobody to say which: nothing of it is called consistent, and the loop is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from diagnosis_graphs import measured, poses_on_a_ring, spoiled
from hodge_adapters.g2o import write_g2o
from hodge_pipeline.cli.main import app
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG
from hodge_pipeline.types import ViewGraph

CHAIN = [(k, k + 1) for k in range(9)]


def graph_of(*more: tuple[int, int], bad: int) -> ViewGraph:
    """0 - 1 - … - 9 and more edges, of which that of row `bad` among all is wrong."""
    poses, edges = poses_on_a_ring(10), np.array([*CHAIN, *more])
    return spoiled(measured(poses, edges), np.array([bad]))[0]


@pytest.mark.parametrize(
    ("second", "shared", "loop"),
    [
        ((8, 1), {(8, 9), (9, 0), (0, 1)}, "8-9-0-1"),
        ((4, 0), {(4, 5), (5, 6), (6, 7), (7, 8), (8, 9), (9, 0)}, "6-7-8-9-0-4-5"),
    ],
)
def test_a_good_loop_vouches_for_its_own_edges_alone(
    second: tuple[int, int], shared: set[tuple[int, int]], loop: str
) -> None:
    graph = graph_of((9, 0), second, bad=9)
    found = diagnose(graph)
    for row, ends in enumerate(map(tuple, graph.edges.tolist())):
        if ends in shared:
            assert found.verdict[row] in (UNTESTABLE, SUSPECT), "one of them is wrong, and nothing says which"
            assert f"the loop {loop} fails by" in found.reason[row]
            assert not found.probability[row] < 0.5, "a right edge is not called improbable for nothing"
        else:
            assert found.verdict[row] == CONSISTENT
    assert sorted(set(found.verdict.tolist())) == [CONSISTENT, SUSPECT, UNTESTABLE]
    left_out = found.verdict == SUSPECT
    assert ((found.probability[left_out] > 0.5) & (found.probability[left_out] < 1)).all(), "one of several is wrong"


def test_a_second_loop_through_the_wrong_edge_clears_the_others() -> None:
    graph = graph_of((9, 0), (8, 0), (9, 1), bad=9)
    found = diagnose(graph)
    assert found.verdict[9] == WRONG and (np.delete(found.verdict, 9) == CONSISTENT).all()


def test_the_command_says_so_and_what_to_register(tmp_path: Path) -> None:
    write_g2o(tmp_path / "chain.g2o", graph_of((9, 0), (8, 1), bad=9), poses_on_a_ring(10))
    done = CliRunner().invoke(app, ["diagnose", str(tmp_path / "chain.g2o")], catch_exceptions=False)
    lines = done.stdout.splitlines()
    assert {line.split()[0] for line in lines[:3]} == {"8-9", "9-0", "0-1"}
    assert all("the loop 8-9-0-1 fails by" in line for line in lines[:3])
    assert "1 is suspect; 2 cannot be tested" in done.stdout
    assert any(line.startswith("register 1-9  tests 1 untestable edge;") for line in lines)

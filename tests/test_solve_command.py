"""`hodge solve` as a user types it, and what it leaves."""

import dataclasses
import json
import math
import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hodge_pipeline
from backbone_graphs import drive
from command import hodge as command
from command import told
from hodge_adapters.pose_graphs.g2o import load_g2o, write_g2o
from hodge_pipeline import se3
from hodge_pipeline.cli.main import app
from hodge_pipeline.errors import CheckError, GraphError, HodgeError, RecipeError, SourceError, WorkspaceError
from hodge_pipeline.refine.pose_graph import UNTOLD, SolvedFile, SolveOptions, disabled_edges, read_graph, solve_file
from hodge_pipeline.report.solved import write_run_folder
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.types import Source, ViewGraph


def graph_file(path: Path, planar: bool = False) -> ViewGraph:
    """Eight vertices with strange ids in a ring with chords; vertex 30 is held."""
    rng = np.random.default_rng(0)
    truth_xi, noise = rng.normal(size=(8, 6)), 0.05 * rng.normal(size=(12, 6))
    information = np.tile(np.diag([9.0, 9, 9, 4, 4, 4]), (12, 1, 1))
    if planar:
        truth_xi[:, [0, 1, 5]] = noise[:, [0, 1, 5]] = 0
        information[:, [0, 1, 5]] = 0
    truth = se3.exp(truth_xi)
    edges = np.array([(i, (i + 1) % 8) for i in range(8)] + [(4, 0), (1, 5), (6, 2), (6, 2)])
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(noise)
    ids = np.array([10**15, 30, 5, 41, -2, 7, 8, 100])
    graph = ViewGraph.from_edges(ids, edges, measured, information, dimension=2 if planar else 3, fixed=np.array([1]))
    write_g2o(path, graph, truth)
    return graph


hodge = partial(told, "solve")


@pytest.mark.parametrize("planar", [False, True])
def test_ids_edges_order_and_held_poses_survive(tmp_path, planar):
    graph = graph_file(tmp_path / "in.g2o", planar)
    read = load_g2o(tmp_path / "in.g2o")
    text = hodge(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o")
    assert "8 poses, 12 edges" in text
    assert "1 piece" in text
    back = load_g2o(tmp_path / "out.g2o")
    np.testing.assert_array_equal(back.graph.vertex_ids, graph.vertex_ids)
    np.testing.assert_array_equal(back.graph.edges, graph.edges)
    np.testing.assert_allclose(back.graph.i_from_j, read.graph.i_from_j, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(back.graph.information, read.graph.information)
    assert back.graph.dimension == (2 if planar else 3)
    assert back.graph.fixed.tolist() == [1]
    np.testing.assert_allclose(back.trajectory.world_from_cam[1], read.trajectory.world_from_cam[1], rtol=0, atol=1e-14)
    direct = hodge_pipeline.solve(read.graph, start=read.trajectory.world_from_cam)
    np.testing.assert_allclose(back.trajectory.world_from_cam, direct.world_from_cam, atol=1e-12)


def test_the_ending_of_the_result_says_its_format(tmp_path):
    graph_file(tmp_path / "in.g2o")
    for name in ("out.g2o", "out.tum", "out.kitti", "out.json", "out.txt"):
        hodge(tmp_path / "in.g2o", "--out", tmp_path / name)
    back = load_g2o(tmp_path / "out.g2o")
    poses, ids = back.trajectory.world_from_cam, back.graph.vertex_ids
    assert (tmp_path / "out.txt").read_text() == (tmp_path / "out.g2o").read_text()
    open3d = guess_reader(tmp_path / "out.json").open(tmp_path / "out.json")
    np.testing.assert_allclose(open3d.trajectory.world_from_cam, poses, atol=1e-12)
    assert open3d.graph.edge_count == back.graph.edge_count
    tum = guess_reader(tmp_path / "out.tum").open(tmp_path / "out.tum").trajectory
    assert tum.stamps_s.tolist() == sorted(ids.tolist())
    np.testing.assert_allclose(tum.world_from_cam, poses[np.argsort(ids)], atol=1e-9)
    kitti = guess_reader(tmp_path / "out.kitti").open(tmp_path / "out.kitti").trajectory
    np.testing.assert_allclose(kitti.world_from_cam, poses[np.argsort(ids)], atol=1e-9)
    with pytest.raises(SourceError, match="PLY holds points"):
        hodge(tmp_path / "in.g2o", "--out", tmp_path / "out.ply")


def test_poses_alone_are_no_graph(tmp_path):
    (tmp_path / "poses.tum").write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n")
    with pytest.raises(SourceError, match="no graph of measured edges but poses alone: with the frames they belong to"):
        hodge(tmp_path / "poses.tum")


def test_a_run_folder_is_left_and_solved_again(tmp_path):
    graph_file(tmp_path / "in.g2o")
    first = json.loads(hodge(tmp_path / "in.g2o", "--run", tmp_path / "run", "--disable", "8-5", "--json"))
    assert first["edges_ignored"] == 2
    assert first["cost_after"] < first["cost_before"]
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert names == {"graph.g2o", "edges.csv", "solved.json", "report.html", "report.json", "recording.rrd"}
    ignored = [line for line in (tmp_path / "run" / "edges.csv").read_text().splitlines() if ",ignored," in line]
    assert [line.split(",")[:2] for line in ignored] == [["8", "5"]] * 2
    again = json.loads(hodge(tmp_path / "run", "--disable", "5-8", "--start", "given", "--json"))
    assert again["cost_before"] == pytest.approx(first["cost_after"], rel=1e-9)
    assert again["cost_after"] == pytest.approx(first["cost_after"], rel=1e-9)


def test_a_graph_with_names_and_without_metres_is_left_as_such(tmp_path):
    graph = graph_file(tmp_path / "in.g2o")
    graph = dataclasses.replace(graph, vertex_ids=np.array([f"{row}.jpg" for row in range(8)]))
    source = Source("model", tmp_path, graph=graph, in_metres=False)
    solved = SolvedFile(source, graph, hodge_pipeline.solve(graph), SolveOptions(), 0.0, 0.0)
    assert "not in this format, so lost: 8 names" in write_run_folder(tmp_path / "run", solved)
    assert load_g2o(tmp_path / "run/graph.g2o").graph.vertex_ids.tolist() == list(range(8))
    header, first, *_ = (tmp_path / "run/edges.csv").read_text().splitlines()
    assert "residual_units" in header.split(",") and "residual_m" not in header.split(",") and ".jpg" in first
    page = re.sub(r"<style.*?</style>|<[^>]*>", " ", (tmp_path / "run/report.html").read_text(), flags=re.DOTALL)
    assert not re.search(r"\d (mm|cm|m)\b", page)
    back = read_graph(tmp_path / "run")
    assert not back.in_metres and back.graph.vertex_ids.tolist() == graph.vertex_ids.tolist()
    (tmp_path / "run/solved.json").write_text("[]")
    with pytest.raises(WorkspaceError, match=r"solved\.json: is not what a solve writes"):
        read_graph(tmp_path / "run")


def test_the_certificate_is_told(tmp_path):
    graph_file(tmp_path / "in.g2o")
    assert hodge(tmp_path / "in.g2o", "--certificate").startswith("verdict  Solved, globally optimal: F ")
    assert hodge(tmp_path / "in.g2o", "--certificate", "--quiet") == ""
    plain = json.loads(hodge(tmp_path / "in.g2o", "--objective", "isotropic", "--json"))
    sesync = json.loads(hodge(tmp_path / "in.g2o", "--sesync-units", "--json"))
    assert plain["objective"] == sesync["objective"] == "isotropic"
    assert sesync["cost_before"] > plain["cost_before"]


def test_wrong_edges_are_left_out(tmp_path):
    graph = graph_file(tmp_path / "good.g2o")
    motion = graph.i_from_j.copy()
    motion[8] = motion[8] @ se3.exp(np.full(6, 2.0))
    graph = dataclasses.replace(graph, i_from_j=motion, information=100 * graph.information)
    write_g2o(tmp_path / "bad.g2o", graph)
    answer = json.loads(hodge(tmp_path / "bad.g2o", "--robust", "--json"))
    assert answer["edges_ignored"] >= 1
    assert any("edges kept" in note for note in answer["notes"])
    hodge(tmp_path / "bad.g2o", "--robust", "--run", tmp_path / "run")
    report = json.loads((tmp_path / "run/report.json").read_text())
    worst = report["worst_edges"][0]
    assert (worst["i"], worst["j"], worst["verdict"], worst["weight"]) == ("-2", str(10**15), "wrong", 0.0)
    assert "fails by" in worst["why"] and f'word wide">{worst["why"]}<' in (tmp_path / "run/report.html").read_text()
    assert report["graph"]["verdicts"]["wrong"] == 1 and report["source"]["is_scanner"]


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (["--disable", "30-8"], GraphError, "--disable 30-8: no edge joins"),
        (["--disable", "nothing"], GraphError, "no edge joins"),
        (["--objective", "isotropc"], RecipeError, "expected isotropic or full"),
        (["--start", "odometry"], RecipeError, "expected given or chordal"),
        (["--certificate", "--objective", "full"], RecipeError, "add --objective isotropic"),
        (["--time-limit", "0"], RecipeError, "above zero"),
        (["--time-limit", "nan"], RecipeError, "--time-limit nan: expected seconds above zero"),
        (["--out", "nowhere/a.g2o"], RecipeError, "make it first"),
        (["--time-limit", "1e-9"], CheckError, "stopped before it converged"),
    ],
)
def test_mistakes_are_one_line(tmp_path, arguments, kind, message):
    graph_file(tmp_path / "in.g2o")
    with pytest.raises(HodgeError, match=message) as error:
        hodge(tmp_path / "in.g2o", *arguments)
    assert type(error.value) is kind
    assert error.value.exit_code == (3 if kind is CheckError else 1)


def test_a_source_without_a_graph_or_poses_is_refused(tmp_path):
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match="no"):
        solve_file(tmp_path / "poses.tum", SolveOptions())
    graph = graph_file(tmp_path / "in.g2o")
    write_g2o(tmp_path / "edges.g2o", graph)
    with pytest.raises(SourceError, match="--start chordal"):
        solve_file(tmp_path / "edges.g2o", SolveOptions(initial="given"))
    solved = solve_file(tmp_path / "edges.g2o", SolveOptions())
    assert "cost_before" in solved.summary()
    assert any("fixed vertices have no pose" in note for note in solved.summary()["notes"])


def test_pairs_of_negative_and_worded_ids_are_found():
    motion = np.tile(np.eye(4), (3, 1, 1))
    edges = np.array([(0, 1), (1, 2), (2, 1)])
    numbers = ViewGraph.from_edges(np.array([-2, -3, 4]), edges, motion)
    assert disabled_edges(numbers, ["-2--3"]).tolist() == [True, False, False]
    assert disabled_edges(numbers, ["4--3"]).tolist() == [False, True, True]
    words = ViewGraph.from_edges(np.array(["a-1", "b", "c"]), edges, motion)
    assert disabled_edges(words, ["a-1-b", "b-c"]).all()


def test_toro_files_are_solved_in_the_plane(tmp_path):
    lines = ["EDGE2 0 1 1 0 0 4 0 4 9 0 0", "EDGE2 1 2 1 0 1.5 4 0 4 9 0 0", "EDGE2 0 2 2 0.2 1.5 4 0 4 9 0 0"]
    (tmp_path / "a.graph").write_text("\n".join(lines) + "\n")
    answer = json.loads(hodge(tmp_path / "a.graph", "--out", tmp_path / "a.g2o", "--json"))
    assert answer["dimension"] == 2
    assert math.isfinite(answer["cost_after"])
    assert "VERTEX_SE2 2 " in (tmp_path / "a.g2o").read_text()


def test_what_nothing_confirms_is_said_first_and_fails(tmp_path):
    rng = np.random.default_rng(0)
    edges = np.array([rng.choice(8, 2, replace=False) for _ in range(24)])
    graph = ViewGraph.from_edges(
        np.arange(8), edges, se3.exp(2 * rng.normal(size=(24, 6))), np.tile(1e4 * np.eye(6), (24, 1, 1))
    )
    write_g2o(tmp_path / "random.g2o", graph)
    done = CliRunner().invoke(app, ["solve", str(tmp_path / "random.g2o"), "--robust"])
    assert isinstance(done.exception, CheckError) and done.exception.exit_code == 3
    assert "nothing confirms the result" in str(done.exception)
    assert done.stdout.startswith("verdict  Solved, but NOT CONFIRMED by the cycles of its edges: ")
    plain = json.loads(CliRunner().invoke(app, ["solve", str(tmp_path / "random.g2o"), "--robust", "--json"]).stdout)
    assert plain["confirmed"] is False
    tree = graph.select(np.array([0]))
    write_g2o(tmp_path / "tree.g2o", tree)
    assert json.loads(hodge(tmp_path / "tree.g2o", "--robust", "--json"))["confirmed"] is None


def test_loops_that_nothing_confirms_are_said_first(tmp_path: Path) -> None:
    made = drive(wrong=1.0, loops=20)
    write_g2o(tmp_path / "drive.g2o", made.graph, made.odometry())
    said = " ".join(hodge(tmp_path / "drive.g2o", "--robust").split())
    assert "verdict Solved by consecutive edges alone, since nothing confirms the 20 others" in said
    one = made.graph.select(np.arange(made.graph.vertex_count))
    write_g2o(tmp_path / "one.g2o", one, made.odometry())
    said = " ".join(hodge(tmp_path / "one.g2o", "--robust").split())
    assert "verdict Solved by consecutive edges alone, since nothing confirms the other edge" in said


def test_pieces_that_edges_left_out_joined_are_said_first(tmp_path: Path) -> None:
    told, mute = "1 0 0 1 0 1", "0 0 0 0 0 0"
    edges = [f"EDGE_SE2 {i} {i + 1} 1 0 0 {mute if i == 2 else told}\n" for i in range(5)]
    (tmp_path / "in.g2o").write_text("".join(edges))
    assert solve_file(tmp_path / "in.g2o", SolveOptions()).headline.startswith(
        "Solved, but in 2 pieces without the edges left out: chi2"
    )
    parted = solve_file(tmp_path / "in.g2o", SolveOptions(disable=("2-3",)))
    assert parted.headline.startswith("Solved: chi2"), "the user parted them"


@pytest.mark.parametrize(
    ("joined", "begins"),
    [
        (range(5), "verdict Solved: chi2"),
        ((0, 1, 4), "verdict In 2 pieces (3, 2 of 6 poses; 1 alone): solved: chi2"),
        ((2,), "verdict 2 of 6 poses joined: solved: chi2"),
    ],
)
def test_pieces_that_no_edge_joins_are_said_first(tmp_path: Path, joined, begins) -> None:
    vertices = [f"VERTEX_SE2 {i} {i} 0 0\n" for i in range(6)]
    edges = [f"EDGE_SE2 {i} {i + 1} 1 0 0 1 0 0 1 0 1\n" for i in joined]
    (tmp_path / "in.g2o").write_text("".join((*vertices, *edges)))
    assert " ".join(hodge(tmp_path / "in.g2o").split()).startswith(begins)


def test_edges_beside_consecutive_ones_are_counted_in_the_first_line(tmp_path: Path) -> None:
    made = drive(wrong=1.0, loops=20)
    steps = np.flatnonzero(np.diff(made.graph.edges, axis=1)[:, 0] == 1)
    twice = made.graph.select(np.concatenate([np.arange(made.graph.edge_count), steps[:30]]))
    write_g2o(tmp_path / "twice.g2o", twice, made.odometry())
    headline = solve_file(tmp_path / "twice.g2o", SolveOptions(robust=True)).headline
    assert headline.startswith("Solved by consecutive edges and 30 that state the same steps again, since nothing ")


@pytest.mark.parametrize("ring", ["", "EDGE_SE2 0 1 1 0 0 0 0 0 0 0 0\nEDGE_SE2 2 2 1 0 0 1 0 0 1 0 1\n"])
@pytest.mark.parametrize("how", [(), ("--robust",)])
def test_where_no_edge_says_anything_nothing_is_called_solved(tmp_path, ring, how):
    vertices = "".join(f"VERTEX_SE2 {row} {row} 0 0\n" for row in range(3))
    (tmp_path / "in.g2o").write_text(vertices + ring)
    done = command("solve", tmp_path / "in.g2o", *how, "--out", tmp_path / "out.g2o")
    assert done.stdout.startswith("verdict  Nothing to solve: no edge joins two vertices")
    assert (done.returncode, done.stderr[-91:]) == (
        3, "error: no edge joins two poses: give a graph with measured edges\n"
    )  # fmt: skip
    np.testing.assert_array_equal(load_g2o(tmp_path / "out.g2o").trajectory.world_from_cam[:, 0, 3], [0, 1, 2])


def test_poses_that_priors_alone_place_are_solved(tmp_path: Path) -> None:
    information = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
    lines = [f"VERTEX_SE3:QUAT {k} 0 0 0 0 0 0 1\nEDGE_PRIOR_SE3 {k} {k} 5 0 0 0 0 1 {information}\n" for k in (1, 2)]
    (tmp_path / "in.g2o").write_text("".join(lines))
    assert hodge(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o").startswith("verdict  Solved")
    moved = load_g2o(tmp_path / "out.g2o").trajectory.world_from_cam[:, :3, 3]
    np.testing.assert_allclose(moved, [[1, 5, 0], [2, 5, 0]], atol=1e-9)


def test_what_reader_and_solver_both_note_is_told_once(tmp_path: Path) -> None:
    edge = "EDGE_SE2 0 {} 1 0 0 1 0 0 1 0 1\n"
    (tmp_path / "in.g2o").write_text(edge.format(1) + edge.format(0))
    assert hodge(tmp_path / "in.g2o", "--out", tmp_path / "out.g2o").count("to itself") == 1


def test_an_odometry_that_states_nothing_of_some_axes_is_told(tmp_path: Path) -> None:
    step = "EDGE_SE2 {} {} 1 0 0.01 1000 0 0 1000 0 0.001"
    lines = [step.format(k, k + 1) for k in range(9)] + ["EDGE_SE2 0 9 9 0.1 0 1000 0 0 1000 0 1000"]
    (tmp_path / "robot.g2o").write_text("\n".join(lines))
    assert UNTOLD in solve_file(tmp_path / "robot.g2o", SolveOptions()).solution.notes
    assert UNTOLD not in solve_file(tmp_path / "robot.g2o", SolveOptions(robust=True)).solution.notes
    (tmp_path / "robot.g2o").write_text("\n".join(lines).replace("0.001", "1000"))
    assert UNTOLD not in solve_file(tmp_path / "robot.g2o", SolveOptions()).solution.notes


@pytest.mark.parametrize(("stated", "excess"), [(1.0, ""), (0.1, "edges are off by 9.5 times what they state")])
def test_the_headline_tells_edges_that_contradict_each_other(tmp_path, stated, excess):
    """A planar walk of three rounds with loops, each edge off by one standard deviation, or by ten of those stated."""
    rng = np.random.default_rng(1)
    truth = se3.exp(np.cumsum(np.tile([0, 0, np.pi / 6, 0, 0, 0], (36, 1)), axis=0))
    truth[:, :2, 3] = 3 * truth[:, :2, 0]
    edges = np.array([(k, k + 1) for k in range(35)] + [(k, k + 12) for k in range(24)])
    sigma = np.array([0, 0, 0.01, 0.05, 0.05, 0])
    measured = se3.inverse(truth[edges[:, 0]]) @ truth[edges[:, 1]] @ se3.exp(sigma * rng.normal(size=(59, 6)))
    information = np.diag([0, 0, 1e4, 400, 400, 0]) / stated**2
    graph = ViewGraph.from_edges(np.arange(36), edges, measured, np.tile(information, (59, 1, 1)), dimension=2)
    write_g2o(tmp_path / "in.g2o", graph, truth)
    solved = solve_file(tmp_path / "in.g2o", SolveOptions())
    assert solved.headline.startswith(f"Solved, but {excess}: chi2" if excess else "Solved: chi2"), solved.headline
    assert solve_file(tmp_path / "in.g2o", SolveOptions(objective="isotropic")).headline.startswith("Solved: F")


def test_edges_without_information_on_an_axis_are_named_as_the_cause(tmp_path):
    lines = [f"EDGE_SE2 {k} {k + 1} 1 0 0.5 25 0 0 25 0 0" for k in range(6)] + ["EDGE_SE2 0 6 0 1 0.3 25 0 0 25 0 0"]
    (tmp_path / "in.g2o").write_text("\n".join(lines) + "\n")
    with pytest.raises(GraphError, match="information that is zero or almost zero on an axis"):
        solve_file(tmp_path / "in.g2o", SolveOptions())

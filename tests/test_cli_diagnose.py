"""`hodge diagnose`: the table, what it leaves, and what it says of wrong, untestable and scattered graphs."""

import csv
import json
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from typer.testing import CliRunner

import hodge_pipeline
from backbone_graphs import drive
from betti import betti_numbers
from command import told
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_adapters.trajectories.text import parse_tum
from hodge_pipeline import se3
from hodge_pipeline.cli.main import app
from hodge_pipeline.complex import holes
from hodge_pipeline.complex.cech import flag_complex
from hodge_pipeline.complex.cycles import loop_products
from hodge_pipeline.complex.holes import unfilled_loops
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.errors import GraphError, HodgeError
from hodge_pipeline.pairs.edits import Listed, pairs_to_register
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.refine.pose_graph import disabled_edges
from hodge_pipeline.report import raster
from hodge_pipeline.report.advice import ranked
from hodge_pipeline.report.diagnosis_page import PageContents, edge_table, frames_table
from hodge_pipeline.report.diagnosis_plots import pieces_apart
from hodge_pipeline.report.edge_pictures import BLUE, ORANGE, _exaggeration, _views, draw_matches
from hodge_pipeline.report.energy import energy_rows
from hodge_pipeline.types import Edges, PointCloud, ViewGraph
from hodge_pipeline.types.text import number_of, with_symbols
from hodge_pipeline.uses.diagnosed import diagnose_subject, open_subject
from hodge_pipeline.uses.diagnosis_folder import write_diagnosed
from readers_data import tum_folder
from synthetic import tiny_sequence  # noqa: F401 - a fixture


def ring(count: int = 12, reach: int = 2, first_id: int = 100) -> tuple[ViewGraph, np.ndarray]:
    """Views round a circle, each joined to the next ones; their poses."""
    angle = 2 * np.pi * np.arange(count) / count
    turn = np.stack([np.zeros(count), np.zeros(count), angle], axis=1)
    poses = se3.from_parts(se3.so3_exp(turn), np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * 2)
    edges = np.array([(i, (i + step) % count) for step in range(1, reach + 1) for i in range(count)])
    noise = se3.exp(0.003 * np.random.default_rng(0).normal(size=(len(edges), 6)))
    measured = se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ noise
    information = np.tile(np.eye(6) / 0.003**2, (len(edges), 1, 1))
    return ViewGraph.from_edges(np.arange(count) + first_id, edges, measured, information), poses


def spoil(graph: ViewGraph, row: int) -> None:
    graph.i_from_j[row] = graph.i_from_j[row] @ se3.exp(np.array([0.5, 0.2, -0.4, 0.6, -0.5, 0.3]))


hodge = partial(told, "diagnose")


@pytest.fixture(scope="module")
def wrong_edge(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, ViewGraph]:
    """A graph file with one wrong edge, diagnosed: its folder, what was printed, and the graph."""
    folder = tmp_path_factory.mktemp("diagnose")
    graph, poses = ring(reach=3)
    spoil(graph, 17)
    write_g2o(folder / "ring.g2o", graph, poses)
    return folder, hodge(folder / "ring.g2o", "--out", folder / "why", "--top", 3), graph


def test_the_wrong_edge_is_printed_first_with_what_to_do(wrong_edge: tuple[Path, str, ViewGraph]) -> None:
    folder, text, graph = wrong_edge
    i, j = graph.vertex_ids[graph.edges[17]]
    lines = text.splitlines()
    assert lines[0] == f"verdict  1 of 36 edges is wrong, worst of all {i}–{j}."
    assert re.match(rf"  - {i}-{j} wrong: 0 of \d+ cycles close; .* fails by", lines[1])
    assert lines[4] == f"  - … and 33 more edges, none of them worse: {folder / 'why/edges.csv'}"
    assert lines[-1] == f"next     hodge solve {folder / 'ring.g2o'} --out solved.g2o --disable {i}-{j}"
    assert all(len(line) <= 80 for line in lines if str(folder) not in line)
    rows = hodge(folder / "ring.g2o", "--verbose").split("verdict  1 of 36")[0]
    assert re.search(rf"{i}-{j} +wrong +0\.\d\d +0 of \d+ cycles close.*disable it", rows)
    assert "note     cycles: " in rows and "energy   rotation " in rows


def test_symbols_of_gtsam_are_named_as_it_prints_them(tmp_path: Path) -> None:
    """The ids themselves stay in the table; what is printed can be typed."""
    graph, poses = ring(reach=3, first_id=ord("a") << 56)
    spoil(graph, 17)
    write_g2o(tmp_path / "ring.g2o", graph, poses)
    text = hodge(tmp_path / "ring.g2o", "--out", tmp_path / "why")
    verdict, first, *_, last = text.splitlines()
    assert verdict == "verdict  1 of 36 edges is wrong, worst of all a5–a7."
    assert first.startswith("  - a5-a7 wrong: 0 of ") and last.endswith("--disable a5-a7")
    page, table = ((tmp_path / "why" / name).read_text("utf-8") for name in ("diagnosis.html", "edges.csv"))
    assert "a5–a7" in page and not re.search(r"\d{19}", page)
    assert all(re.fullmatch(r"\d{19},\d{19},\D.*", line) for line in table.splitlines()[1:])
    assert not re.search(r"\d{19}", "".join(row["why"] for row in csv.DictReader(table.splitlines())))
    assert disabled_edges(graph, ["a7-a5"]).nonzero()[0].tolist() == [17]
    listed = Listed(Edges.measured(graph), graph.vertex_ids.astype(str))
    assert listed.named(["a5-a7"]) == (f"{graph.vertex_ids[5]}-{graph.vertex_ids[7]}",)
    assert pairs_to_register(listed.edges, graph.vertex_ids, ["a0-a6"]) == (f"{ord('a') << 56}-{(ord('a') << 56) + 6}",)


def test_only_symbols_of_gtsam_are_named_so() -> None:
    a12 = (ord("a") << 56) + 12
    assert with_symbols(f"{a12}–{a12 + 1}, x{a12}.") == "a12–a13, xa12."
    kept = f"{a12}0 0.{a12} {1628069034624019000} {(ord('a') << 56) + (1 << 48)} {ord('[') << 56} 12-87"
    assert with_symbols(kept) == kept
    assert [number_of(name) for name in ("a12", "12", "a012", "ab1", "")] == [str(a12), "12", "a012", "ab1", ""]


def test_many_wrong_edges_are_left_out_by_one_short_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph, poses = ring(20, reach=3)
    turned = se3.exp(np.random.default_rng(1).normal(size=(20, 6)))  # motions in all directions
    motions = se3.inverse(turned[graph.edges[:, 0]]) @ graph.i_from_j @ turned[graph.edges[:, 1]]
    graph, poses = replace(graph, i_from_j=motions), poses @ turned
    for row in (3, 17, 30, 41):
        spoil(graph, row)
    write_g2o(tmp_path / "ring.g2o", graph, poses)
    monkeypatch.chdir(tmp_path)
    told = hodge("ring.g2o").splitlines()[-1]
    assert told == "next     hodge solve ring.g2o --out solved.g2o --robust"
    done = CliRunner().invoke(app, [*told.split()[2:], "--json"], catch_exceptions=False)
    assert json.loads(done.stdout)["edges_ignored"] == 4
    CliRunner().invoke(app, [*told.split()[2:], "--run", "solved"], catch_exceptions=False)
    again = diagnose_subject(open_subject(Path("solved")))
    assert "The robust solve left 4 of the wrong edges out already." in again.notes and again.commands == ()
    assert [again.advice[row] for row in (3, 17, 30, 41)] == ["nothing: no pose depends on it"] * 4


def test_the_wrong_edges_of_a_run_are_disabled_by_one_word_or_not_at_all(
    wrong_edge: tuple[Path, str, ViewGraph],
) -> None:
    folder, _, graph = wrong_edge
    file = open_subject(folder / "ring.g2o")
    judged = replace(file, is_run=True, edges=diagnose(graph).put_into(file.edges))
    found = diagnose_subject(judged)
    assert found.commands == tuple(
        f"hodge {rest}" for rest in (f"edit {file.path} --disable wrong", f"solve {file.path}")
    )
    assert found.advice[17] == "disable it"
    otherwise = diagnose_subject(replace(judged, edges=file.edges))  # the table says nothing of the edge
    i, j = graph.vertex_ids[graph.edges[17]]
    assert otherwise.commands[0].endswith(f"--disable {i}-{j}")
    as_good = diagnose_subject(replace(judged, harmless="No pose moves: nothing to do."))
    assert not any("disable" in command for command in as_good.commands)
    assert as_good.advice[17] == "nothing: no pose depends on it"
    assert as_good.notes[0] == "No pose moves: nothing to do."


def test_the_files_say_the_same(wrong_edge: tuple[Path, str, ViewGraph]) -> None:
    folder, _, graph = wrong_edge
    with (folder / "why/edges.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:4] == ["i", "j", "source", "status"]
    assert [[int(row["i"]), int(row["j"])] for row in rows] == graph.vertex_ids[graph.edges].tolist()
    assert [n for n, row in enumerate(rows) if row["verdict"] != "consistent"] == [17]
    poses = parse_tum(folder / "why/poses.tum").trajectory
    np.testing.assert_array_equal(poses.stamps_s, graph.vertex_ids)
    between = se3.inverse(poses.world_from_cam[0]) @ poses.world_from_cam[1]
    np.testing.assert_allclose(between, graph.i_from_j[0], atol=0.02)
    assert {path.name for path in (folder / "why").iterdir()} == {
        "edges.csv", "poses.tum", "diagnosis.html", "diagnosis.rrd",
    }  # fmt: skip


def test_the_page_needs_nothing_but_itself(wrong_edge: tuple[Path, str, ViewGraph]) -> None:
    folder, _, graph = wrong_edge
    page = (folder / "why/diagnosis.html").read_text()
    assert not re.search(r"(src|href)=[\"'](?!data:|#)", page)
    assert "1 of 36 edges is wrong" in page and '<span class="badge">wrong</span>' in page
    assert page.count("<img ") == 3
    i, j = graph.vertex_ids[graph.edges[17]]
    assert f'<td class="word">{i}–{j}</td><td class="word wrong">wrong</td>' in page
    for words in ("Energy of the residual motions", "harmonic", "linearisation", "Pieces"):
        assert words in page


def test_lengths_of_a_graph_without_a_scale_are_no_metres(wrong_edge: tuple[Path, str, ViewGraph]) -> None:
    folder = wrong_edge[0]
    subject = open_subject(folder / "ring.g2o")
    metric = (folder / "why/diagnosis.html").read_text()
    write_diagnosed(folder / "own", diagnose_subject(replace(subject, has_metres=False)))
    page = re.sub(r"base64,[^\"]*", "", (folder / "own/diagnosis.html").read_text())
    lengths = r"\d (c?m|m²)\b"
    assert re.search(lengths, metric) and not re.search(lengths, page) and "units" in page
    table = (folder / "own/edges.csv").read_text()
    assert "residual_units" in table and not re.search(lengths, table)


def test_the_recording_holds_verdicts_triangles_and_loops(wrong_edge: tuple[Path, str, ViewGraph]) -> None:
    folder, _, graph = wrong_edge
    lines: dict[str, int] = {}
    for chunk in RrdReader(folder / "why/diagnosis.rrd").stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in ("LineStrips3D:strips", "Mesh3D:triangle_indices"):
            if name in batch.schema.names:
                lines[chunk.entity_path] = len(batch.column(name).flatten())
    assert lines["/world/verdicts/wrong"] == 1
    assert lines["/world/verdicts/consistent"] == 35
    assert lines["/world/curl/triangles"] == flag_complex(graph.edges, graph.vertex_count).counts[2]
    assert lines["/world/curl/loops"] == 1


def test_frames_that_several_bad_edges_share_are_named() -> None:
    graph, _ = ring(reach=3)
    found = diagnose(graph)
    bad = np.flatnonzero((graph.edges == 4).any(axis=1))[:3]
    verdict = np.array(found.verdict, dtype="<U12")
    verdict[bad] = "wrong"
    table = frames_table(graph, replace(found, verdict=verdict))
    assert table.rows[0][:3] == ("104", "3", "6") and len(table.rows) == 1
    assert frames_table(graph, found).rows == ()


def test_of_edges_with_one_verdict_and_about_one_probability_the_farthest_off_is_first() -> None:
    found = diagnose(ring(6)[0])
    count = len(found.verdict)
    verdict, far = np.full(count, "consistent", "<U12"), np.zeros(count)
    verdict[9], far[3], far[5] = "wrong", 2.0, np.nan
    probability = np.where(np.arange(count) == 7, 0.6, np.where(np.arange(count) == 3, 0.99, 0.96))
    found = replace(found, verdict=verdict, probability=probability, residual_m=far)
    assert ranked(found)[:4].tolist() == [9, 7, 5, 3]


def test_a_wrong_edge_without_a_listed_cycle_says_what_is_against_it() -> None:
    graph = drive(loops=60, wrong=0.4).graph
    found = diagnose(graph)
    assert found.verdict.tolist().count("wrong") > 5
    bare = replace(found, witnesses_against=np.full_like(found.witnesses_against, -1))
    table = edge_table(PageContents("", graph, bare, ("",) * graph.edge_count, (), ()))
    rows = table.rows
    assert "cycles for" not in table.header, "a column of nothing pushes numbers off the page"
    against = {row[1]: row[3] for row in rows}
    assert "from the poses" in against["wrong"] and {row[3] for row in rows if row[1] == "consistent"} <= {"none"}
    assert re.match(r"[\d.]+ m, \d", rows[0][table.header.index("off by")]), rows[0]


def test_json_has_every_edge(tmp_path: Path) -> None:
    graph, poses = ring(6)
    write_g2o(tmp_path / "a.g2o", graph, poses)
    answer = json.loads(hodge(tmp_path / "a.g2o", "--json"))
    assert answer["counts"] == {"consistent": 12, "suspect": 0, "wrong": 0, "untestable": 0}
    assert len(answer["edges"]) == 12 and answer["pieces"] == 1 and answer["commands"] == []
    for row in answer["energy"]:
        for kind in ("rotation", "translation"):
            assert sum(row[kind][part] for part in ("exact", "co-exact", "harmonic")) == pytest.approx(1)
    text = hodge(tmp_path / "a.g2o", "--verbose", "--top", 3)
    assert text.count("energy   rotation ") == 2 and "ω is only their linearisation" in text
    assert "  - … and 9 more edges, none of them worse: --verbose" in text.splitlines()
    assert hodge(tmp_path / "a.g2o") == "verdict  All 12 edges are consistent with each other.\n"
    joined = {frozenset((edge["i"], edge["j"])) for edge in answer["edges"]}
    nexts = [frozenset((pair["i"], pair["j"])) for pair in answer["register_next"]]
    assert nexts and not joined & set(nexts)
    assert hodge(tmp_path / "a.g2o", "--quiet") == ""


def test_a_chain_with_one_bad_loop_edge_names_the_loop(tmp_path: Path) -> None:
    graph, poses = ring(6, reach=1)
    spoil(graph, 5)
    write_g2o(tmp_path / "chain.g2o", graph, poses)
    text = hodge(tmp_path / "chain.g2o", "--out", tmp_path / "why")
    assert text.count(" untestable: ") == 5 and " consistent: " not in text
    assert "6 of 6 edges may be to blame for the loop" in text
    with (tmp_path / "why/edges.csv").open() as file:
        assert [row["probability"] for row in csv.DictReader(file) if row["verdict"] == "untestable"] == [""] * 6


def test_pieces_are_pieces(tmp_path: Path) -> None:
    first, poses = ring(6)
    both = ViewGraph.from_edges(
        np.arange(12),
        np.concatenate([first.edges, first.edges + 6]),
        np.concatenate([first.i_from_j] * 2),
        np.concatenate([first.information] * 2),
    )
    write_g2o(tmp_path / "two.g2o", both, np.concatenate([poses, poses]))
    text = hodge(tmp_path / "two.g2o", "--out", tmp_path / "why")
    assert "look     poses.tum holds 2 pieces, each in a frame of its own" in text
    assert len(parse_tum(tmp_path / "why/poses.tum").trajectory) == 12


def test_pieces_are_drawn_beside_each_other() -> None:
    _, poses = ring(6)
    placed = pieces_apart(np.concatenate([poses, poses, poses]), np.repeat([0, 1, 2], 6))
    spans = [(placed[k : k + 6, 0, 3].min(), placed[k : k + 6, 0, 3].max()) for k in (0, 6, 12)]
    assert spans[0][1] < spans[1][0] and spans[1][1] < spans[2][0]
    np.testing.assert_allclose(placed[6:12, 1:, 3], poses[:, 1:, 3])


def test_shares_add_up_and_a_wrong_edge_left_out_takes_most_energy_away() -> None:
    graph, _ = ring(reach=3)
    spoil(graph, 3)
    found = diagnose(graph)
    rows, complaints = energy_rows(graph, found.world_from_cam, found.piece, found.kept)
    assert complaints == () and [row.when for row in rows] == ["before", "after"]
    for row in rows:
        for _, shares in row.kinds.values():
            assert sum(shares) == pytest.approx(1)
    before, after = (row.kinds["rotation"][0] for row in rows)
    assert after < 0.1 * before


@pytest.mark.parametrize("seed", range(6))
def test_there_is_a_loop_for_each_hole(seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges = rng.integers(0, 14, (40, 2))
    edges = edges[edges[:, 0] != edges[:, 1]]
    found = unfilled_loops(edges, 14)
    loops = found.loops
    assert found.count == len(loops) == betti_numbers(flag_complex(edges, 14))[1]
    longest = unfilled_loops(edges, 14, most_loops=2)
    assert longest.count == found.count
    np.testing.assert_array_equal(longest.loops.lengths, loops.lengths[-2:])
    poses = se3.exp(rng.normal(size=(14, 6)))
    closed = loop_products(loops, se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]])
    np.testing.assert_allclose(closed, np.broadcast_to(np.eye(4), closed.shape), atol=1e-9)


def test_a_graph_of_too_many_triangles_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    edges = np.array([(i, j) for j in range(9) for i in range(j)])
    assert unfilled_loops(edges, 9).count == 0
    monkeypatch.setattr(holes, "MOST_TRIANGLES", 10)
    with pytest.raises(GraphError, match="at most 10 triangles"):
        unfilled_loops(edges, 9)


@pytest.mark.draws
def test_two_clouds_are_drawn_where_they_are() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)), axis=-1).reshape(-1, 2)
    left = PointCloud(np.column_stack([grid, np.full(len(grid), 2.0)]).astype(np.float32))
    i_from_j = se3.from_parts(np.eye(3), np.array([3.0, 0, 0]))
    ahead, above = _views(left, left, [i_from_j], np.array([0.0, -1.0, 0.0]), np.eye(3))
    both = raster.two(left, left, i_from_j, (BLUE, ORANGE))
    image = raster.picture(both, ahead).astype(int)
    blue, orange = (
        np.abs(image / image.sum(2, keepdims=True) - np.divide(tint, sum(tint))).sum(2) < 0.05
        for tint in (BLUE, ORANGE)
    )
    assert blue.sum() > 500 and orange.sum() > 500
    assert np.flatnonzero(blue.any(0)).max() < np.flatnonzero(orange.any(0)).min()
    assert (raster.picture(both, above) < 255).any(2).sum() < blue.sum()


def test_a_small_offset_is_enlarged_until_it_is_seen() -> None:
    assert [_exaggeration(size, 2.0) for size in (0.0, 0.3, 0.07, 0.02, 0.001, 1e-9)] == [1, 1, 1, 5, 100, 100]


def test_an_image_matches_itself_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    image = np.kron(rng.integers(0, 255, (40, 52, 3), np.uint8), np.ones((8, 8, 1), np.uint8)).astype(np.uint8)
    same, other = draw_matches(image, image), draw_matches(image, np.full_like(image, 90))
    assert same.agreeing > 50 and same.agreeing == same.matches
    assert (other.matches, other.agreeing) == (0, 0)
    np.testing.assert_array_equal(draw_matches(image, image).image, same.image)


def test_a_run_is_diagnosed_with_pictures(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    settings = ["clouds.voxel_m=0.06", "executor.workers=0", "recording.level=off", "outer_iterations=1", "fusion=[]"]
    recipe = load_recipe("demo", [*settings, "evaluation.tables=false", "source.reader.every=2"], tiny_sequence)
    run = hodge_pipeline.run(recipe, tmp_path / "run")
    answer = json.loads(hodge(tmp_path / "run", "--out", tmp_path / "why", "--json"))
    assert sum(answer["counts"].values()) == run.result.graph.edge_count
    assert answer["counts"]["consistent"] == (run.result.edges.verdict == "consistent").sum()
    assert all(source["source"] in run.result.graph.source for source in answer["edges"])
    page = (tmp_path / "why/diagnosis.html").read_text()
    bad = sum(count for verdict, count in answer["counts"].items() if verdict != "consistent")
    assert page.count("As the edge says</h3>") == max(2, min(6, bad))
    assert "SIFT matches;" in page


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    (tmp_path / "half/stages").mkdir(parents=True)
    (tmp_path / "half/recipe.yaml").write_text("x: 1\n")
    tum_folder(tmp_path / "recorded")
    for path, message in (
        ("poses.tum", "no graph"),
        (
            "recorded",
            "no graph of measured edges; its frames give one: hodge run tum --source .*recorded --out RUN",
        ),
        ("half", "has not begun to register"),
        ("nothing.g2o", "no such file"),
    ):
        with pytest.raises(HodgeError, match=message):
            hodge(tmp_path / path)


def test_the_folder_of_a_refined_model_is_diagnosed_as_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "recipe.yaml").write_text("model: colmap\n")
    graph = ViewGraph.from_edges(np.arange(3), np.array([[0, 1], [1, 2], [0, 2]]), np.tile(np.eye(4), (3, 1, 1)))
    write_g2o(tmp_path / "graph.g2o", graph)
    assert open_subject(tmp_path).graph.edge_count == 3

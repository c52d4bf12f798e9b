"""What a review opens, what it refuses, and what can only be looked at."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from hodge_pipeline import registry
from hodge_pipeline.errors import HodgeError, WorkspaceError
from hodge_pipeline.pairs.edits import read_history
from hodge_pipeline.refine.pose_graph import read_graph
from hodge_pipeline.review.decisions import LockedError
from hodge_pipeline.review.keeping import save
from hodge_pipeline.review.listing import Query, describe, list_edges, state
from hodge_pipeline.review.opening import Review
from hodge_pipeline.review.subject import open_for_review
from hodge_pipeline.types import Source
from review_data import PLANTED, graph_file  # noqa: F401 - a fixture
from stand_ins import Log
from synthetic import tiny_sequence  # noqa: F401 - a fixture
from test_cli_edit import small_recipe


def test_a_second_review_of_the_same_graph_is_refused(graph_file: Path) -> None:  # noqa: F811
    with Review(graph_file, scene=False), pytest.raises(WorkspaceError, match="being reviewed already"):
        Review(graph_file, scene=False)
    Review(graph_file, scene=False).close()


def test_a_path_without_edges_is_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    with pytest.raises(HodgeError, match="no graph of measured edges"):
        open_for_review(tmp_path / "poses.tum")
    with pytest.raises(WorkspaceError, match="cannot be read"):
        Review(tmp_path / "nothing.g2o", scene=False)


@pytest.mark.parametrize(("writer", "name"), [("pairs", "ring.log"), ("open3d_pose_graph", "ring.json")])
def test_graphs_of_other_formats_are_decided_about_beside_them(
    graph_file: Path,  # noqa: F811
    tmp_path: Path,
    writer: str,
    name: str,
) -> None:
    source = read_graph(graph_file)
    path = tmp_path / name
    write = write_pairs if writer == "pairs" else registry.load("writers", writer)().write
    write(path, source)
    before = path.read_bytes()
    with Review(path, scene=False, who="ada") as review:
        session = review.session
        session.wait()
        pair = session.names([PLANTED[0]])[0]
        session.decide(0, "disable", [PLANTED[0]])
        session.wait()
        assert len(session.table) == source.graph.edge_count  # type: ignore[union-attr]
        assert (
            session.settled.weights[PLANTED[0]] == 0 and (session.settled.weights > 0).sum() == len(session.table) - 1
        )
        saved, _ = save(session)
    assert read_history(tmp_path / f"{name}.edits.json").disabled == (pair,)
    assert (tmp_path / f"{name}.decisions.csv").exists() and saved.name == "ring.reviewed.g2o"
    assert path.read_bytes() == before
    with Review(path, scene=False) as again:
        again.session.wait()
        assert again.session.settled.weights[PLANTED[0]] == 0


def write_pairs(path: Path, source: Source) -> None:
    """The graph of a source as a `.log` of pairs."""
    graph = source.graph
    assert graph is not None
    with path.open("w") as file:
        for (i, j), motion in zip(graph.vertex_ids[graph.edges], graph.i_from_j, strict=True):
            file.write(f"{i}\t{j}\t{graph.vertex_count}\n")
            np.savetxt(file, motion, "%.12g")


def test_a_run_that_stopped_half_way_can_only_be_looked_at(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    with pytest.raises(KeyboardInterrupt):
        hodge_pipeline.run(small_recipe(tiny_sequence), tmp_path / "run", watcher=Log(stop_at="fusion 1"))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")}
    with Review(tmp_path / "run", scene=False) as review:
        session = review.session
        session.wait()
        assert "the run is not finished: run the same command again" in state(session)["locked"]
        assert list_edges(session, Query())["total"] > 0 and describe(session, 0)["name"]
        with pytest.raises(LockedError, match="not finished"):
            session.decide(0, "disable", [0])
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "run").rglob("*")} == before


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_a_review_that_is_asked_to_end_leaves_no_socket_behind(graph_file: Path) -> None:  # noqa: F811
    pytest.importorskip("viser", reason="viser is not installed: pip install 'hodge-pipeline[review]'")
    serve = [sys.executable, "-m", "hodge_pipeline.cli.main", "review", str(graph_file), "--no-browser"]
    with tempfile.TemporaryDirectory() as temporary:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": temporary}
        with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True, env=environment) as process:
            assert process.stdout is not None and process.stdout.readline().startswith("http://")
            assert list(Path(temporary).glob("hodge-review-*"))
            process.terminate()
        assert not list(Path(temporary).glob("hodge-review-*"))


def test_a_folder_of_temporary_files_too_long_for_a_socket_is_refused(
    graph_file: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Viser waited without end for a server that never started."""
    pytest.importorskip("viser", reason="viser is not installed: pip install 'hodge-pipeline[review]'")
    (long := tmp_path / ("long" * 25)).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    with pytest.raises(WorkspaceError, match="TMPDIR"):
        Review(graph_file)
    assert not list(long.iterdir())

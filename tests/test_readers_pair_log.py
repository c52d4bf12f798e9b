from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.pose_graphs.pair_log import PairLogReader, read_information
from hodge_adapters.trajectories.log import LogWriter
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.review.subject import open_for_review
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.testing import check_reader
from hodge_pipeline.types import Source

IDENTITY = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


def information(diagonal: list[float], corner: float = 0.0) -> str:
    matrix = np.diag(diagonal)
    matrix[0, 5] = matrix[5, 0] = corner
    return "".join(" ".join(map(str, line)) + "\n" for line in matrix)


def graph_of_a_robot(folder: Path) -> Path:
    (folder / "a.g2o").write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    return folder / "a.g2o"


def test_pairs_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text(f"0\t 1\t 4\n0 -1 0 5\n1 0 0 6\n0 0 1 7\n0 0 0 1\n2 0 4\n{IDENTITY}")
    source = check_reader(PairLogReader(), path)
    graph = source.graph
    assert graph is not None and graph.vertex_ids.tolist() == [0, 1, 2, 3], (
        "the head counts vertices that no pair names"
    )
    assert graph.edges.tolist() == [[0, 1], [2, 0]] and graph.source.tolist() == ["sequential", "pair"]
    # the origin of view 1 lies at (5, 6, 7) in view 0
    np.testing.assert_array_equal(graph.i_from_j[0] @ [0, 0, 0, 1], [5, 6, 7, 1])
    np.testing.assert_array_equal(graph.information, np.tile(np.eye(6), (2, 1, 1)))
    assert source.notes == ("1 of 4 vertices are in no pair: 3",)
    assert not open_for_review(path).is_scanner, "such a file is of cameras, that of a robot's graph is not"
    assert open_for_review(graph_of_a_robot(tmp_path)).is_scanner


def test_the_first_head_tells_pairs_from_a_trajectory(tmp_path: Path) -> None:
    pairs, poses = tmp_path / "pairs.log", tmp_path / "poses.log"
    pairs.write_text(f"0 1 2\n{IDENTITY}")
    poses.write_text(f"0 0 1\n{IDENTITY}1 1 2\n{IDENTITY}")
    assert isinstance(guess_reader(pairs), PairLogReader)
    assert not isinstance(guess_reader(poses), PairLogReader)
    with pytest.raises(SourceError, match=r"poses\.log: no pair .* 'log'"):
        PairLogReader().open(poses)


def test_information_is_turned_to_radians_and_missing_pairs_are_counted(tmp_path: Path) -> None:
    path, beside = tmp_path / "a.log", tmp_path / "a.info"
    path.write_text(f"0 1 3\n{IDENTITY}1 2 3\n{IDENTITY}")
    beside.write_text("0 1 3\n" + information([9, 9, 9, 400, 400, 400], 8.0))
    source = PairLogReader().open(path)
    assert source.graph is not None and source.notes == ("1 of 2 pairs are not in a.info: they get its median matrix",)
    assert source.contents == ("information of the pairs: a.info",), "a fact for inspect, nothing to look at"
    expected = np.diag([100.0, 100, 100, 9, 9, 9])
    expected[2, 3] = expected[3, 2] = 4.0
    np.testing.assert_array_equal(source.graph.information, [expected, expected])
    assert source.files == (path, beside)
    alike = PairLogReader(information="none").open(path)
    assert alike.graph is not None and alike.files == (path,)
    np.testing.assert_array_equal(alike.graph.information, np.tile(np.eye(6), (2, 1, 1)))
    elsewhere = beside.rename(tmp_path / "b.info")
    assert PairLogReader().open(path).files == (path,)
    assert PairLogReader(information=elsewhere).open(path).files == (path, elsewhere)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("0 1 2\n1 0 0 0\n", "no blocks"),
        (f"0 1 2\n{IDENTITY}0 x 2\n{IDENTITY}", ":6: not `i j n`|:1: not `i j n`"),
        (f"0 1 2\n{IDENTITY}0 -1 2\n{IDENTITY}", ":6: not `i j n`"),
        ("0 1 2\n1 0 0 0\n0 1 0 0\n0 0 2 0\n0 0 0 1\n", ":1: not `i j n` and a rigid motion"),
        ("0 1 2\n1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", ":1: not"),
        ("", "no blocks"),
    ],
)
def test_a_broken_file_names_its_line(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "a.log"
    path.write_text(text)
    with pytest.raises(SourceError, match=complaint):
        PairLogReader().open(path)


def test_a_broken_information_file_names_its_line(tmp_path: Path) -> None:
    path = tmp_path / "gt.info"
    for text, complaint in (
        ("0 1 2\n1 2\n", "no blocks"),
        ("0 1 2\n" + information([1.0, 1, 1, 1, 1, 1]).replace("1.0 0.0", "1.0 0.5", 1), ":1: not a finite symmetric"),
        ("0 1 2\n" + information([1, 1, np.nan, 1, 1, 1]), ":1: not a finite"),
    ):
        path.write_text(text)
        with pytest.raises(SourceError, match=complaint):
            read_information(path)


def test_an_absurd_count_makes_no_vertices(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text(f"3 900 4000000000\n{IDENTITY}")
    source = PairLogReader().open(path)
    assert source.graph is not None and source.graph.vertex_ids.tolist() == [3, 900]
    assert "4000000000 vertices" in source.notes[0]


def test_a_graph_survives_a_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text(f"0 2 4\n{IDENTITY}3 2 4\n0 -1 0 5\n1 0 0 6\n0 0 1 7\n0 0 0 1\n")
    first = PairLogReader().open(path).graph
    LogWriter().write(tmp_path / "b.log", Source("a", path, graph=first))
    second = PairLogReader().open(tmp_path / "b.log").graph
    assert first is not None and second is not None
    for name in ("vertex_ids", "edges", "i_from_j"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_real_estimates(data_dir: Path) -> None:
    folder = data_dir / "fragments/pair_estimates/7-scenes-redkitchen-evaluation"
    truth = check_reader(PairLogReader(information=folder / "gt.info"), folder / "gt.log").graph
    estimates = check_reader(PairLogReader(), folder / "3dmatch.log").graph
    assert truth is not None and estimates is not None
    assert (truth.vertex_count, truth.edge_count, estimates.edge_count) == (60, 506, 588)
    assert np.linalg.eigvalsh(truth.information).min() > 0
    assert se3.is_motion(estimates.i_from_j).all()

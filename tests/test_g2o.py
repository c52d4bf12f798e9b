import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hodge_adapters.pose_graphs.g2o import (
    G2oReader,
    G2oWriter,
    information_for_file,
    information_of_file,
    load_g2o,
    write_g2o,
)
from hodge_adapters.pose_graphs.toro import ToroReader, load_toro
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Source, ViewGraph

IDENTITY_21 = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 4 0 0 4 0 4"
EDGE = f"EDGE_SE3:QUAT 7 3 1 2 3 0 0 0 1 {IDENTITY_21}"


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def random_graph(seed: int, planar: bool = False) -> tuple[ViewGraph, np.ndarray]:
    rng = np.random.default_rng(seed)
    ids = rng.permutation(np.arange(5) * 10**17)
    edges = rng.integers(0, 5, (8, 2))
    twists = rng.normal(size=(13, 6))
    root = rng.normal(size=(8, 6, 6))
    information = root @ np.swapaxes(root, 1, 2)
    if planar:
        outside = [0, 1, 5]
        twists[:, outside] = 0
        information[:, outside] = 0
        information[:, :, outside] = 0
    poses = se3.exp(twists)
    return ViewGraph.from_edges(ids, edges, poses[:8], information, "g2o"), poses[8:]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6), planar=st.booleans())
def test_a_round_trip_keeps_ids_order_and_values(tmp_path_factory, seed, planar):
    graph, poses = random_graph(seed, planar)
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    graph = dataclasses.replace(graph, dimension=2 if planar else 3, fixed=np.array([1, 3]))
    write_g2o(path, graph, poses)
    back = load_g2o(path)
    assert back.graph.dimension == (2 if planar else 3)
    assert back.graph.fixed.tolist() == [1, 3]
    np.testing.assert_array_equal(back.graph.vertex_ids, graph.vertex_ids)
    np.testing.assert_array_equal(back.graph.edges, graph.edges)
    np.testing.assert_allclose(back.graph.i_from_j, graph.i_from_j, atol=1e-14)
    np.testing.assert_allclose(
        back.graph.information, 0.5 * (graph.information + np.swapaxes(graph.information, 1, 2)), atol=1e-12
    )
    np.testing.assert_allclose(back.trajectory.world_from_cam, poses, atol=1e-14)


def test_the_information_is_over_half_an_angle(tmp_path):
    graph = load_g2o(write(tmp_path / "a.g2o", EDGE)).graph
    np.testing.assert_array_equal(graph.information[0], np.eye(6))
    information = np.random.default_rng(0).normal(size=(3, 6, 6))
    np.testing.assert_array_equal(information_of_file(information_for_file(information)), information)


def test_comments_behind_numbers_and_lines_that_end_in_cr_alone_are_read(tmp_path):
    path = tmp_path / "a.g2o"
    path.write_bytes(f"# head\r{EDGE} # odometry\r{EDGE}\r".encode())
    assert load_g2o(path).graph.edge_count == 2
    path.write_bytes(f"# head\r\n{EDGE}\r\nEDGE_SE3:QUAT 1\r\n".encode())
    with pytest.raises(SourceError, match="a.g2o:3:"):
        load_g2o(path)


def test_edges_alone_name_their_vertices_in_order_of_appearance(tmp_path):
    file = load_g2o(write(tmp_path / "a.g2o", "# a comment", "", EDGE.replace(" ", "\t") + "\r"))
    assert file.graph.vertex_ids.tolist() == [7, 3]
    assert file.graph.edges.tolist() == [[0, 1]]
    assert file.trajectory is None
    np.testing.assert_array_equal(file.graph.i_from_j[0, :3, 3], [1, 2, 3])


def test_gtsam_keys_of_64_bits_survive(tmp_path):
    key = 8646911284551352321
    file = load_g2o(write(tmp_path / "a.g2o", EDGE.replace("7 3", f"{key} {key + 1}")))
    assert file.graph.vertex_ids.tolist() == [key, key + 1]


def test_what_is_of_the_other_dimension_is_counted(tmp_path):
    source = load_g2o(write(tmp_path / "g.g2o", EDGE, "VERTEX_SE2 5 0 0 0", "VERTEX_SE2 6 0 0 0"))
    assert source.graph.vertex_ids.tolist() == [7, 3]
    assert source.notes == ("2 lines of kind VERTEX_SE2 not read",)
    planar = load_g2o(write(tmp_path / "p.g2o", "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1"))
    assert planar.notes == ("1 line of kind VERTEX_SE3:QUAT not read",)


def test_what_is_not_read_is_counted(tmp_path):
    path = write(tmp_path / "a.g2o", "VERTEX_XY 5 1 1", EDGE, "VERTEX_XY 6 1 1", "VERTEX_SE3:QUAT 7 0 0 0 0 0 0 1")
    notes = G2oReader().open(path).notes
    meaning = "landmarks, where only edges between poses are solved"
    assert f"2 lines of kind VERTEX_XY not read: {meaning}" in notes
    assert "1 of 2 vertices are named by edges only: no initial poses" in notes


def test_loops_that_may_be_switched_off_are_edges(tmp_path):
    """Vertigo's: the switch is a third id, the weight of a mixture stands before the motion."""
    spatial = EDGE.replace("EDGE_SE3:QUAT 7 3", "EDGE_SE3_SWITCHABLE 7 5 9")
    source = load_g2o(write(tmp_path / "s.g2o", EDGE, spatial, "VERTEX_SWITCH 9 1", "EDGE_SWITCH_PRIOR 9 1 1"))
    assert source.graph is not None and source.graph.edges.tolist() == [[0, 1], [0, 2]]
    np.testing.assert_array_equal(*source.graph.i_from_j)
    np.testing.assert_array_equal(*source.graph.information)
    assert "1 line of kind VERTEX_SWITCH not read: switches of loops, which are judged anew" in source.notes
    assert "1 edge of kind EDGE_SE3_SWITCHABLE read as EDGE_SE3:QUAT, whatever the switch or weight" in source.notes
    step, loop = "1 2 .3 4 0 0 5 0 6", "2 3 .4 7 0 0 8 0 9"
    lines = f"EDGE_SE2 0 1 {step}", f"EDGE_SE2_SWITCHABLE 1 2 9 {loop}", f"EDGE_SE2_MAXMIX 0 2 0.01 {loop}"
    plain = f"EDGE_SE2 0 1 {step}", f"EDGE_SE2 1 2 {loop}", f"EDGE_SE2 0 2 {loop}"
    found, expected = (load_g2o(write(tmp_path / "p.g2o", *each)).graph for each in (lines, plain))
    for name in ("vertex_ids", "edges", "i_from_j", "information"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_of_a_switched_loop_beside_steps_without_information_the_motion_is_read(tmp_path):
    source = load_g2o(write(tmp_path / "u.g2o", "EDGE_SE2 0 1 1 0 0", "EDGE_SE2_SWITCHABLE 0 2 9 2 0 0 4 0 0 5 0 6"))
    assert source.graph is not None
    np.testing.assert_array_equal(source.graph.information[0], source.graph.information[1])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE_SE3_SWITCHABLE 1 2 3 0 0", ":2: EDGE_SE3_SWITCHABLE needs 28 numbers after its ids, has 2"),
        ("EDGE_SE3:QUAT 1 2 0 0 0", ":2: EDGE_SE3:QUAT needs 28 numbers after its ids, has 3"),
        (EDGE.replace("1 2 3", "1 two 3"), ":2: 'two' is no number"),
        (EDGE.replace("7 3", "7 x3"), ":2: 'x3' is no id of EDGE_SE3:QUAT: give a whole number of 64 bits"),
        (EDGE.replace("0 0 0 1 1", "0 0 0 0 1"), ":2: its quaternion is zero"),
        (EDGE.replace("1 2 3", "1 nan 3"), ":2: EDGE_SE3:QUAT holds a nan"),
        (EDGE + " 5", ":2: EDGE_SE3:QUAT needs 28 numbers after its ids, has 29"),
        ("EDGE_SE3:QUAT 1", ":2: EDGE_SE3:QUAT needs 2 ids and 28 numbers"),
        ("EDGE_SE2 1 2 0 0 0 1 0 0 1 0 1", "holds both EDGE_SE3:QUAT and EDGE_SE2"),
        ("VERTEX_SE3:QUAT 4 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 4 0 0 0 0 0 0 1", ":3: vertex 4 is given twice"),
        ("PARAMS_SE3OFFSET 0 0 0 1 0 0 0 1\nPARAMS_SE3OFFSET 0 0 0 2 0 0 0 1", ":3: PARAMS_SE3OFFSET 0 is given twice"),
    ],
)
def test_a_malformed_line_is_named(tmp_path, line, message):
    path = write(tmp_path / "bad.g2o", EDGE, line)
    with pytest.raises(SourceError) as error:
        load_g2o(path)
    assert str(path) in str(error.value)
    assert message in str(error.value)


def test_other_files_are_refused(tmp_path):
    empty, binary = write(tmp_path / "empty.g2o"), tmp_path / "image.g2o"
    binary.write_bytes(b"\x89PNG\xff\x00")
    for path in (empty, binary, tmp_path / "absent.g2o"):
        assert G2oReader().sniff(path).confidence < 0.5
        with pytest.raises(SourceError):
            load_g2o(path)


def test_vertices_with_names_are_numbered_and_that_is_told(tmp_path):
    graph = ViewGraph.from_edges(np.array(["b", "a"]), np.array([[1, 0]]), np.eye(4)[None])
    told = G2oWriter().write(tmp_path / "a.g2o", Source("named", tmp_path, graph=graph))
    assert told[1:] == ("not in this format, so lost: 2 names",)
    back = load_g2o(tmp_path / "a.g2o").graph
    assert back.vertex_ids[back.edges].tolist() == [[1, 0]]


def test_toro_orders_its_information_in_its_own_way(tmp_path):
    path = write(tmp_path / "a.graph", "VERTEX2 0 0 0 0", "VERTEX2 1 1 0 0", "EDGE2 0 1 1 0 0.5 1 2 3 4 5 6")
    file = load_toro(path)
    planar = file.graph.information[0][np.ix_([3, 4, 2], [3, 4, 2])]
    np.testing.assert_array_equal(planar, [[1, 2, 5], [2, 3, 6], [5, 6, 4]])
    assert file.graph.dimension == 2
    assert ToroReader().sniff(path).confidence > 0.5


def test_toro_angles_are_roll_pitch_yaw(tmp_path):
    path = write(tmp_path / "a.graph", "EDGE3 0 1 1 2 3 0.1 0.2 0.3", "EQUIV 2 1", "EDGE3 1 2 0 0 0 0 0 0")
    file = load_toro(path)
    rz, ry, rx = (se3.so3_exp(np.array(v)) for v in ([0, 0, 0.3], [0, 0.2, 0], [0.1, 0, 0]))
    np.testing.assert_allclose(file.graph.i_from_j[0, :3, :3], rz @ ry @ rx, atol=1e-15)
    assert file.graph.edges.tolist() == [[0, 1], [1, 1]]
    assert any("EQUIV" in note for note in file.notes)


@pytest.mark.parametrize(
    ("pairs", "merged"),
    [
        (["3 1", "3 5"], {1: 5, 3: 5}),
        (["1 3", "5 3", "3 2"], {1: 2, 3: 2, 5: 2}),
        (["1 2", "2 1"], {1: 2}),
        (["4 4", "1 2", "4 5", "5 2"], {1: 2, 4: 2, 5: 2}),
    ],
)
def test_all_vertices_that_equiv_lines_join_are_one(tmp_path, pairs, merged):
    vertices = [f"VERTEX2 {key} {key} 0 0" for key in range(6)]
    edges = [f"EDGE2 {key} {key + 1} 1 0 0 1 0 1 1 0 0" for key in range(5)]
    graph = load_toro(write(tmp_path / "a.graph", *vertices, *edges, *(f"EQUIV {pair}" for pair in pairs))).graph
    assert graph.vertex_ids.tolist() == [key for key in range(6) if key not in merged]
    ends = [merged.get(key, key) for key in range(6)]
    assert graph.vertex_ids[graph.edges].tolist() == [list(pair) for pair in zip(ends[:-1], ends[1:], strict=True)]


def test_toro_vertices_given_twice_are_named(tmp_path):
    with pytest.raises(SourceError, match=r"a\.graph:3: vertex 0 is given twice"):
        load_toro(write(tmp_path / "a.graph", "VERTEX2 0 0 0 0", "EDGE2 0 1 1 0 0", "VERTEX2 0 0 0 0"))


@pytest.mark.parametrize(
    ("name", "vertices", "edges", "dimension"),
    [("sesync/sphere2500.g2o", 2500, 4949, 3), ("sesync/kitti_05.g2o", 2761, 2826, 2)],
)
def test_real_files(data_dir, name, vertices, edges, dimension):
    path = data_dir / "pose_graphs" / name
    source = G2oReader().open(path)
    assert G2oReader().sniff(path).confidence > 0.9
    assert ToroReader().sniff(path).confidence == 0
    assert source.graph is not None
    assert (source.graph.vertex_count, source.graph.edge_count) == (vertices, edges)
    assert load_g2o(path).graph.dimension == dimension
    assert se3.is_motion(source.graph.i_from_j, 1e-9).all()


VERTICES = ("VERTEX_SE3:QUAT 7 0 0 0 0 0 0 1", "VERTEX_SE3:QUAT 3 0 0 0 0 0 0 1")


def test_priors_are_read_at_the_body_and_written_back(tmp_path):
    turned = "0 0 0.7071067811865476 0.7071067811865476"
    path = write(
        tmp_path / "a.g2o",
        *VERTICES,
        EDGE,
        f"PARAMS_SE3OFFSET 5 0 0 2 {turned}",
        f"EDGE_SE3_PRIOR 3 5 1 2 3 {turned} {IDENTITY_21}",
        f"EDGE_PRIOR_SE3 7 4 5 6 0 0 0 1 {IDENTITY_21}",
    )
    priors = load_g2o(path).graph.priors
    assert priors.vertices.tolist() == [0, 1]
    np.testing.assert_allclose(priors.world_from_vertex[1], se3.from_parts(np.eye(3), [1, 2, 1]), atol=1e-15)
    # the sensor sits 2 m above the body: a turn of the body about x moves it by 2 m, which its position weighs once
    np.testing.assert_allclose(np.diag(priors.information[1]), [5, 5, 1, 1, 1, 1], atol=1e-12)
    graph = load_g2o(path).graph
    write_g2o(tmp_path / "b.g2o", graph)
    back = load_g2o(tmp_path / "b.g2o").graph.priors
    np.testing.assert_allclose(back.world_from_vertex, priors.world_from_vertex, atol=1e-14)
    np.testing.assert_allclose(back.information, priors.information, atol=1e-12)


def test_planar_priors_of_poses_and_of_positions(tmp_path):
    path = write(
        tmp_path / "a.g2o",
        "VERTEX_SE2 0 0 0 0",
        "VERTEX_SE2 1 0 0 0",
        "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1",
        "EDGE_PRIOR_SE2 0 5 6 0.5 2 0 0 3 0 4",
        "EDGE_PRIOR_SE2_XY 1 7 8 2 1 3",
    )
    priors = load_g2o(path).graph.priors
    assert priors.vertices.tolist() == [0, 1]
    np.testing.assert_allclose(np.diag(priors.information[0]), [0, 0, 4, 2, 3, 0])
    np.testing.assert_allclose(priors.world_from_vertex[1], se3.from_parts(np.eye(3), [7, 8, 0]))
    np.testing.assert_allclose(priors.information[1][3:5, 3:5], [[2, 1], [1, 3]])
    assert not priors.information[1][2].any()
    solution = solve(load_g2o(path).graph)
    np.testing.assert_allclose(solution.world_from_cam[0, :2, 3], [5, 6], atol=2)


@pytest.mark.parametrize(
    "line, message",
    [
        (f"EDGE_SE3_PRIOR 3 9 1 2 3 0 0 0 1 {IDENTITY_21}", "a.g2o:4: names a PARAMS_SE3OFFSET that the file lacks"),
        (f"EDGE_PRIOR_SE3 99 1 2 3 0 0 0 1 {IDENTITY_21}", "a prior names vertex 99"),
        ("EDGE_PRIOR_SE3 3 1 2 3", "a.g2o:4: EDGE_PRIOR_SE3"),
    ],
)
def test_a_prior_that_makes_no_sense_is_one_line(tmp_path, line, message):
    with pytest.raises(SourceError, match=message):
        load_g2o(write(tmp_path / "a.g2o", *VERTICES, EDGE, line))


def test_a_fixed_vertex_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SourceError, match="FIX names vertex 8, which no vertex or edge line names"):
        load_g2o(write(tmp_path / "a.g2o", EDGE, "FIX 3 8"))
    source = load_g2o(write(tmp_path / "a.g2o", EDGE, "VERTEX_TRACKXYZ 8 0 0 0", "FIX 3 8"))
    assert source.graph.vertex_ids[source.graph.fixed].tolist() == [3]
    assert "1 FIX lines name vertices that are not read, 8 first: ignored" in source.notes


def test_priors_pull_the_poses_to_where_they_are_known(tmp_path):
    path = write(
        tmp_path / "a.g2o",
        *VERTICES,
        f"EDGE_SE3:QUAT 7 3 1 0 0 0 0 0 1 {IDENTITY_21}",
        f"EDGE_PRIOR_SE3 7 10 0 0 0 0 0 1 {IDENTITY_21}",
    )
    solution = solve(load_g2o(path).graph)
    np.testing.assert_allclose(solution.world_from_cam[:, :3, 3], [[10, 0, 0], [11, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("head", [b"# caf\xe9\r\n", b"\xef\xbb\xbf", "# Größe\n".encode()])
def test_comments_in_any_encoding_and_a_byte_order_mark(tmp_path, head):
    good, other = write(tmp_path / "good.g2o", EDGE), tmp_path / "other.txt"
    other.write_bytes(head + good.read_bytes())
    assert G2oReader().sniff(other).confidence > 0.9
    np.testing.assert_array_equal(load_g2o(other).graph.i_from_j, load_g2o(good).graph.i_from_j)


def test_binary_junk_is_no_text(tmp_path):
    (tmp_path / "junk.g2o").write_bytes(bytes(range(256)))
    assert G2oReader().sniff(tmp_path / "junk.g2o").confidence < 0.5
    with pytest.raises(SourceError, match="cannot be read as text"):
        load_g2o(tmp_path / "junk.g2o")


@pytest.mark.parametrize(
    ("tag", "motion", "information"),
    [
        ("EDGE_SE3:QUAT", "1 2 3 0 0 0 1", np.eye(6)),
        ("EDGE_SE2", "1 2 0.5", np.diag([0, 0, 1, 1, 1, 0])),
    ],
)
def test_edges_without_information_state_nothing(tmp_path: Path, tag: str, motion: str, information) -> None:
    """As LIO-SAM's descendants save a session."""
    source = load_g2o(write(tmp_path / "a.g2o", f"{tag} 0 1 {motion}", f"{tag} 1 2 {motion}"))
    np.testing.assert_array_equal(source.graph.information, np.tile(information, (2, 1, 1)))
    np.testing.assert_array_equal(source.graph.i_from_j[0][:2, 3], [1, 2])
    assert "2 edges state no information: taken as unknown" in source.notes
    with pytest.raises(SourceError, match=":2: .* needs"):
        load_g2o(write(tmp_path / "b.g2o", f"{tag} 0 1 {motion}", f"{tag} 1 2 {motion} 1"))


def test_positions_that_are_known_in_space(tmp_path):
    """As hdl_graph_slam writes of GPS: without an angle, and without a height where it is not known."""
    lines = [EDGE, "EDGE_SE3_PRIORXYZ 7 1 2 3 10 1 0 20 0 30", "EDGE_SE3_PRIORXY 3 4 5 40 0 50"]
    priors = load_g2o(write(tmp_path / "a.g2o", *lines)).graph.priors
    np.testing.assert_array_equal(priors.vertices, [0, 1])
    np.testing.assert_array_equal(priors.world_from_vertex[:, :3, 3], [[1, 2, 3], [4, 5, 0]])
    np.testing.assert_array_equal(priors.information[:, :3], 0)
    np.testing.assert_array_equal(priors.information[0, 3:, 3:], [[10, 1, 0], [1, 20, 0], [0, 0, 30]])
    np.testing.assert_array_equal(priors.information[1, 3:, 3:], np.diag([40, 50, 0]))


def test_toro_edges_without_information_are_counted(tmp_path):
    source = load_toro(write(tmp_path / "a.graph", "EDGE2 0 1 1 2 0.5", "EDGE2 1 2 1 2 0.5"))
    assert "2 edges state no information: taken as unknown" in source.notes

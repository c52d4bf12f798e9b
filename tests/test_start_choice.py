"""How a run starts: frames registered whole or tracked, and parts that odometry left joined or let be."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.executors.local import InProcess
from hodge_pipeline.recipe.schema import load_recipe
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.odometry import Odometry
from hodge_pipeline.scene import KeyFrames, Round, Scene, sequences_of
from hodge_pipeline.sources.opening import fingerprints, remembered
from hodge_pipeline.start import given
from hodge_pipeline.start import odometry as odometry_start
from hodge_pipeline.start.clouds import make_clouds
from hodge_pipeline.start.given import GivenStart
from hodge_pipeline.start.odometry import OdometryStart
from hodge_pipeline.start.unordered.join import _keeps_odometry
from hodge_pipeline.start.unordered.start import Start
from hodge_pipeline.store.store import Store
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Source, ViewGraph
from stand_ins import Told
from synthetic import LIGHT, short_sequence, tiny_sequence  # noqa: F401 - a fixture


def started(sequence: Path, stamps_s: Floats, up_to: str, steps: Store) -> Scene:
    """The start of the first frames of a sequence, with other stamps."""
    recipe, reader = load_recipe("demo", [*LIGHT, f"start.whole_up_to={up_to}"], sequence), TumReader()
    opened = reader.open(sequence)
    shown = zip(opened.frames, stamps_s.tolist(), strict=False)
    frames = tuple(replace(frame, stamp_s=stamp_s) for frame, stamp_s in shown)
    source = remembered(replace(opened, frames=frames), reader, steps, fingerprints(opened.files))
    return recipe.start.begin(source, recipe.clouds, steps, InProcess())


@pytest.mark.parametrize(("up_to", "apart_s", "whole"), [("12", 0.1, True), ("auto", 0.7, True), ("auto", 0.1, False)])
def test_what_is_short_enough_is_registered_whole_unless_it_is_a_video(
    tiny_sequence: Path,  # noqa: F811
    tmp_path: Path,
    up_to: str,
    apart_s: float,
    whole: bool,
) -> None:
    scene = started(tiny_sequence, 1e9 + apart_s * np.arange(12), up_to, Store(tmp_path))
    assert scene.key_frames.are_all == whole and (len(scene.clouds) == 12) == whole
    assert len(scene.first.world_from_cam) == len(scene.clouds)


@pytest.mark.parametrize(("up_to", "is_said"), [("auto", True), ("12", False)])
def test_numbered_frames_that_are_not_tracked_are_said(
    tiny_sequence: Path,  # noqa: F811
    tmp_path: Path,
    up_to: str,
    is_said: bool,
) -> None:
    steps = Store(tmp_path)
    started(tiny_sequence, np.arange(12.0), up_to, steps)
    assert any("12 frames are numbered, and nothing tells" in str(note) for note in steps.notes) == is_said


@pytest.mark.parametrize(
    ("edges", "apart"),
    [([[0, 1], [1, 2], [2, 3]], False), ([[0, 1], [2, 3]], True), ([[0, 1], [1, 2]], False)],  # the last: a lone frame
)
def test_relocalisation_is_automatic_where_odometry_left_parts(
    edges: list[list[int]], apart: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, source = np.tile(np.eye(4), (4, 1, 1)), source_at([0, 1, 2, 3])
    graph = ViewGraph.from_edges(np.arange(4), np.array(edges), poses[: len(edges)])
    joined = Round(Edges.of([]), graph.vertex_ids, poses, name="joined")
    monkeypatch.setattr(odometry_start, "join_parts", lambda *_: joined)
    found = Odometry(poses, Edges.measured(graph), ())
    for relocalise, expected in (("auto", apart), (True, True), (False, False)):
        scene = OdometryStart(relocalise=relocalise).joined(  # type: ignore[arg-type]
            source, CloudSet.from_clouds([]), CloudOptions(), found, KeyFrames.all_of(source, poses), Told(None),
            InProcess(),
        )  # type: ignore[arg-type]  # fmt: skip
        assert (scene.first is joined) == expected


def test_landmarks_are_made_where_parts_are_joined_alone(tmp_path: Path) -> None:
    reader = TumReader()
    opened = reader.open(make_sequence(tmp_path / "demo", DemoOptions(frames=2, width=160, height=120)))
    poses, edges = np.tile(np.eye(4), (2, 1, 1)), np.array([[0, 1]])
    for pairs, expected in ((edges, False), (edges[:0], True)):
        store, options = Store(tmp_path / f"store-{expected}"), CloudOptions()
        source = remembered(opened, reader, store, fingerprints(opened.files))
        found = Odometry(poses, Edges.measured(ViewGraph.from_edges(np.arange(2), pairs, poses[: len(pairs)])), ())
        made = make_clouds(source, options, store, InProcess())
        key_frames = KeyFrames.all_of(source, poses)
        scene = OdometryStart(relocalise=expected).joined(source, made, options, found, key_frames, store, InProcess())
        assert (len(scene.clouds.mark_points) > 0) == expected and len(scene.clouds) == 2
        np.testing.assert_array_equal(scene.clouds.points, made.points)


@pytest.mark.parametrize(
    ("is_given", "apart_s", "readout_s", "moved"),
    [(False, 0.22, 0.02, True), (False, 0.22, 0.0, False), (False, 1.0, 0.02, False), (True, 0.22, 0.02, True)],
)
def test_landmarks_of_frames_registered_whole_are_of_the_moment_of_their_stamps(
    is_given: bool,
    apart_s: float,
    readout_s: float,
    moved: bool,
    short_sequence: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    sets = [*LIGHT, "start.whole_up_to=auto", "clouds.landmarks=50"]
    recipe, reader, steps = load_recipe("demo", sets, short_sequence), TumReader(), Store(tmp_path)
    opened = reader.open(short_sequence)
    frames = tuple(
        replace(
            frame,
            stamp_s=apart_s * (row + 1),
            colour_delay_s=0.0,
            camera=frame.camera and replace(frame.camera, readout_s=readout_s),
        )
        for row, frame in enumerate(opened.frames[:4])
    )
    source = remembered(replace(opened, frames=frames), reader, steps, fingerprints(opened.files))
    made = make_clouds(source, recipe.clouds, steps, InProcess())
    start = GivenStart(every=1) if is_given else recipe.start
    scene = start.begin(source, recipe.clouds, steps, InProcess())
    assert scene.key_frames.are_all and len(made.mark_points) > 20
    np.testing.assert_array_equal(scene.clouds.points, made.points)
    change_m = np.linalg.norm(scene.clouds.mark_points - made.mark_points, axis=1)
    assert (float(np.median(change_m)) > 1e-4) == moved, "over a second a hand turns back: no velocity"


@pytest.mark.parametrize(("unit", "jump_m", "fastest_m_s"), [(1.0, 0.0, 0.3), (1.0, 0.3, 0.3), (1000.0, 0.0, 0.0)])
def test_landmarks_take_no_velocity_from_jumps_of_given_poses_nor_from_those_of_another_unit(
    unit: float, jump_m: float, fastest_m_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = np.arange(12)
    source = Source("given", Path("given"), tuple(Frame(row, row / 30) for row in rows.tolist()))
    way_m = np.stack([0.01 * rows + jump_m * (rows > 5), 0.002 * np.sin(rows), 0 * rows], axis=1)
    poses, taken = se3.from_parts(np.eye(3), unit * way_m), list[Floats]()
    monkeypatch.setattr(given, "with_landmarks_at_stamps", lambda *args: taken.append(args[3]))
    jumps = GivenStart()._jumps(poses, list(sequences_of(source).values()), given.NO_VELOCITY_SHARE)
    given._at_stamps(source, source, rows, poses, jumps[:, 1], CloudSet.from_clouds([]), 1.0, Store(Path("unused")))
    assert taken[0][:, 3] == pytest.approx(fastest_m_s)
    assert len(jumps) == (11 if unit > 1 else jump_m > 0)


def source_at(stamps_s: list[float]) -> Source:
    return Source("four", Path("four"), tuple(Frame(row, stamp_s) for row, stamp_s in enumerate(stamps_s)))


def test_parts_that_nothing_joins_stay_where_they_are_guessed_to_be_unless_over_a_hole() -> None:
    edges, poses = np.array([[0, 1], [2, 3]]), np.broadcast_to(np.eye(4), (4, 4, 4))
    graph = ViewGraph.from_edges(np.arange(4), edges, poses[:2])
    known = Edges.measured(graph)
    apart = Start(poses, known, np.array([0, 0, 1, 1]), ())
    joined = Start(poses, known, np.zeros(4, np.int64), ())
    steady, hole = source_at([0, 1, 2, 3]), source_at([0, 1, 2, 30])
    assert _keeps_odometry(steady, known, apart)
    assert not _keeps_odometry(steady, known, joined)
    assert not _keeps_odometry(hole, known, apart)

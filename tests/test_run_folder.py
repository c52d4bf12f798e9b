"""`Run.load`: a run folder as an object, without its source, by whatever version, and only where it is whole."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from command import told as hodge
from hodge_adapters.trajectories.text import parse_tum, write_tum
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import se3
from hodge_pipeline.errors import HodgeError, WorkspaceError
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.report.write import as_json
from hodge_pipeline.review.subject import open_for_review
from hodge_pipeline.run_folder import Run
from hodge_pipeline.store import store as store_module
from hodge_pipeline.store.artifacts import json_text
from hodge_pipeline.types import Trajectory
from hodge_pipeline.uses.compared import compare
from hodge_pipeline.uses.diagnosed import open_subject
from hodge_pipeline.uses.record_again import record_again
from stand_ins import Log
from synthetic import tiny_sequence  # noqa: F401 - a fixture

FRAMES = 24
SMALL = (
    "clouds.voxel_m=0.06", "fusion=[{stage: cloud}]", "executor.workers=0", "recording.level=summary",
    "outer_iterations=1", "edges.max_edges_per_frame=4",
)  # fmt: skip
KEY_FRAMES = ("start.whole_up_to=10", "start.distance_m=0.4", "start.angle_deg=12")


@pytest.fixture(scope="module")
def sequence(tiny_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:  # noqa: F811
    """One of our own, which will be gone."""
    return Path(shutil.copytree(tiny_sequence, tmp_path_factory.mktemp("source") / "sequence"))


@pytest.fixture(scope="module")
def recipe(sequence: Path) -> Recipe:
    return load_recipe("demo", [*SMALL, *KEY_FRAMES], sequence)


@pytest.fixture(scope="module")
def run(recipe: Recipe, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Of key frames."""
    return hodge_pipeline.run(recipe, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def alone(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The run in another place, under other versions, its source gone."""
    folder = Path(shutil.copytree(run.folder, tmp_path / "moved"))
    text = (folder / "recipe.yaml").read_text()
    (folder / "recipe.yaml").write_text(text.replace(str(run.source.path), str(tmp_path / "gone")))
    monkeypatch.setattr(store_module, "versions", lambda: {"numpy": "99"})
    return folder


def test_what_a_run_gave_is_what_its_folder_gives(run: Run, alone: Path) -> None:
    found = Run.load(alone)
    assert not run.key_frames.are_all and found.poses.shape == (FRAMES, 4, 4)
    np.testing.assert_array_equal(found.poses, run.poses)
    np.testing.assert_array_equal(found.clouds.points, run.clouds.points)
    assert len(found.rounds) == len(run.rounds) == 2
    for one, other in zip(found.rounds, run.rounds, strict=True):
        for name, column in vars(one.edges).items():
            np.testing.assert_array_equal(column, getattr(other.edges, name), err_msg=name)
        np.testing.assert_array_equal(one.world_from_cam, other.world_from_cam)
    assert (found.edges.verdict != "").any()
    assert json_text(as_json(found.report)) == json_text(as_json(run.report)) and found.refined is None
    assert {name: path.read_bytes() for name, path in found.models.items()} == {
        name: path.read_bytes() for name, path in run.models.items()
    }
    assert list(found.models) == ["cloud"]
    assert found.scores is not None and found.scores.names == run.scores.names  # type: ignore[union-attr]
    frames = [(frame.frame_id, frame.stamp_s, frame.camera) for frame in found.source.frames]
    assert frames == [(frame.frame_id, frame.stamp_s, frame.camera) for frame in run.source.frames]
    assert repr(found).endswith(f"24 frames, {run.result.graph.edge_count} edges)")


def test_every_reader_works_where_the_source_is_gone(run: Run, alone: Path, tmp_path: Path) -> None:
    steps = {path: path.stat().st_mtime_ns for path in (alone / "stages").rglob("*")}
    answer = json.loads(hodge("diagnose", alone, "--out", tmp_path / "why", "--json"))
    assert sum(answer["counts"].values()) == run.result.graph.edge_count
    assert "no edits" in hodge("edit", alone, "--list")
    assert "compare.html" in hodge("compare", alone, run.folder, "--out", tmp_path / "both").replace("\n", "")
    path, is_whole = record_again(alone, {})
    assert is_whole and path == alone / "recording.rrd"
    assert {path: path.stat().st_mtime_ns for path in (alone / "stages").rglob("*")} == steps


def test_a_run_is_converted_with_the_images_of_its_source(run: Run, alone: Path, tmp_path: Path) -> None:
    told = hodge("convert", run.folder, tmp_path / "scene", "--to", "nerfstudio")
    entries = json.loads((tmp_path / "scene/transforms.json").read_text())["frames"]
    assert len(entries) == FRAMES and all((tmp_path / "scene" / entry["file_path"]).is_file() for entry in entries)
    assert f"{FRAMES} images copied" in told
    assert "without images" in hodge("convert", alone, tmp_path / "bare", "--to", "nerfstudio")


def poses_of(run: Run) -> Path:
    return run.folder / "poses.tum"


def test_poses_are_of_all_frames_wherever_they_come_from(run: Run, sequence: Path, tmp_path: Path) -> None:
    np.testing.assert_allclose(parse_tum(poses_of(run)).trajectory.world_from_cam, run.poses, atol=1e-9)
    quick = [*SMALL, "fusion=[]", "recording.level=off", "evaluation.tables=false"]
    frames = TumReader().open(sequence).frames
    true = np.array([frame.world_from_cam for frame in frames])
    drift = se3.exp(np.linspace(0, 1, FRAMES)[:, None] * np.array([0, 0.05, 0, 0.05, 0, 0]))
    write_tum(tmp_path / "slam.txt", Trajectory(np.array([frame.stamp_s for frame in frames]), true @ drift))
    given = load_recipe("slam_refine", [*quick, f"start.path={tmp_path / 'slam.txt'}", "start.every=3"], sequence)
    unordered = load_recipe("demo", [*quick, "start=unordered", "source.reader.every=3"], sequence)
    for name, recipe, count in (("given", given, FRAMES), ("unordered", unordered, FRAMES // 3)):
        made = hodge_pipeline.run(recipe, tmp_path / name)
        for one in (made, Run.load(made.folder)):
            assert one.poses.shape == (count, 4, 4) and len(one.source.frames) == count
            np.testing.assert_array_equal(one.poses, made.poses)
        assert made.key_frames.are_all == (name == "unordered")
        np.testing.assert_allclose(parse_tum(poses_of(made)).trajectory.world_from_cam, made.poses, atol=1e-9)
        assert (made.refined is not None) == (name == "given")


@pytest.mark.parametrize(
    ("name", "title"),
    [
        ("track-1/clouds/points.npy", "tracking"),
        ("begin-1/value.npz", "frames"),
        ("solve_edges-1/value.json", "solve, round 1"),
        ("judge_edges-1/step.json", "diagnosis, round 1"),
        ("fuse-1/cloud.ply", "fusion 1"),
    ],
)
def test_a_changed_byte_is_refused_and_the_same_command_heals_it(
    run: Run, recipe: Recipe, tmp_path: Path, name: str, title: str
) -> None:
    folder = Path(shutil.copytree(run.folder, tmp_path / "run"))
    damaged = folder / "stages" / name
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 4
    damaged.write_bytes(bytes(data))
    with pytest.raises(WorkspaceError, match=f"{damaged.name} has changed .* the same hodge run computes it again"):
        Run.load(folder)
    log = Log()
    again = hodge_pipeline.run(recipe, folder, watcher=log)
    assert log.stages[0] == title and set(log.stages) <= {title, "report"}
    assert any(f"{damaged.name} has changed" in said for said in log.said)
    for found in (again, Run.load(folder)):
        np.testing.assert_array_equal(found.poses, run.poses)


def test_a_run_in_progress_is_read_as_far_as_it_came(recipe: Recipe, run: Run, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        hodge_pipeline.run(recipe, tmp_path / "run", watcher=Log(stop_at="fusion 1"))
    found = Run.load(tmp_path / "run")
    np.testing.assert_array_equal(found.poses, run.poses)
    assert found.models == {} and repr(found).endswith("unfinished)")
    with pytest.raises(WorkspaceError, match="is not finished: run the same command again"):
        _ = found.report
    shutil.copytree(run.folder, tmp_path / "early")
    shutil.rmtree(tmp_path / "early/stages")
    (tmp_path / "early/stages").mkdir()
    with pytest.raises(WorkspaceError, match="has not begun to register"):
        Run.load(tmp_path / "early")


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("\nseed: 0", "\nseed: 0\npace: 2", "pace: unknown option"),
        ("whole_up_to: 10", "hole_up_to: 10", "did you mean 'whole_up_to'"),
        ("stage: maximum_likelihood", "stage: poison\n  strength: 3", "no stage 'poison'"),
        ("stage: local", "stage: dask\n  address: tcp://127.0.0.1:1", "no stage 'dask'"),
        ("level: summary", "level: all", "recording.level"),
    ],
    ids=["section", "option", "stage", "cluster", "value"],
)
def test_a_run_of_another_version_is_read_and_not_run(run: Run, tmp_path: Path, old: str, new: str, named: str) -> None:
    folder = Path(shutil.copytree(run.folder, tmp_path / "run"))
    text = (folder / "recipe.yaml").read_text()
    assert old in text
    (folder / "recipe.yaml").write_text(text.replace(old, new, 1))

    loaded = Run.load(folder)
    assert [named in str(note) for note in loaded.options_left_out] == [True]
    assert loaded.recipe.diagnosis == run.recipe.diagnosis and not run.options_left_out
    assert (folder / "recipe.yaml").read_text() == text.replace(old, new, 1)

    with pytest.raises(HodgeError, match=r"recipe\.yaml:\d+: ") as refused:
        hodge_pipeline.solve_again(folder)
    assert "\n" not in str(refused.value)


def test_every_reader_works_where_another_version_made_the_run(run: Run, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(run.folder, tmp_path / "run"))
    text = (folder / "recipe.yaml").read_text().replace("\nseed: 0", "\nseed: 0\npace: 2", 1)
    (folder / "recipe.yaml").write_text(text)
    assert record_again(folder, {"level": "summary"}) == (folder / "recording.rrd", True)
    assert compare(run, Run.load(folder)).apart_m.max() < 1e-12
    for opened in (open_for_review(folder), open_subject(folder)):
        assert any("pace: unknown option" in note for note in opened.notes)
    assert (folder / "recipe.yaml").read_text() == text


def test_nothing_is_left_behind(run: Run, recipe: Recipe) -> None:
    hodge_pipeline.run(recipe, run.folder)
    assert sorted(path.name for path in run.folder.rglob(".*")) == [".lock"]
    assert not [path for path in run.folder.rglob("*") if path.suffix in (".part", ".draft", ".tmp")]
    steps = {path.name for path in (run.folder / "stages").iterdir()} - {"index.json"}
    listed = json.loads((run.folder / "stages/index.json").read_text())["steps"]
    assert steps == {entry["name"] for entry in listed}

"""Parts merged into one recording: whole, replaced, empty; and what opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording import layout, live, shapes, stream
from hodge_pipeline.recording.eye import look_at
from hodge_pipeline.recording.merge import contents_of, find_parts
from hodge_pipeline.types import CloudSet
from recording_data import circle, make_frames, record, record_all, rows
from tools import recording_pictures
from tools.recording_pictures import picture


def verify(path: Path, scratch: Path) -> None:
    live.run_program(["rrd", "verify", str(path)], live.quiet_environment(scratch))


def test_one_verified_file_with_a_blueprint(tmp_path: Path) -> None:
    recorder = record(tmp_path / "parts")
    record_all(recorder)
    merged = tmp_path / "recording.rrd"
    recorder.finish(merged)
    assert len(find_parts(tmp_path / "parts")) == 9
    verify(merged, tmp_path)
    reader = RrdReader(merged)
    assert [entry.recording_id for entry in reader.recordings()] == ["run-1"]
    assert len(reader.blueprints()) == 1
    assert not list(tmp_path.rglob(".*"))


def opened_tab(recording: Path) -> str:
    """The name of the tab that a recording opens on."""
    reader = RrdReader(recording)
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=reader.blueprints()[0])]
    columns = [{name.split(":")[-1]: batch[name] for name in batch.schema.names} for batch in batches]
    paths = [batch.schema.metadata[b"rerun:entity_path"].decode() for batch in batches]
    (tab,) = (column["active_tab"][0][0].as_py() for column in columns if "active_tab" in column)
    names = dict(zip(paths, columns, strict=True))
    return str(names[f"/{tab}"]["display_name"][0][0].as_py())


def test_pictures_of_tabs_are_of_recordings_that_open_on_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record_all(record(tmp_path / "run" / "stages" / "record_all"))
    opened = {}

    def paint(recording: Path, png: Path, wait_s: float) -> None:
        opened[recording.stem] = opened_tab(recording)
        Image.new("RGB", (100, 50)).save(png)

    monkeypatch.setattr(recording_pictures, "picture", paint)
    recording_pictures.draw(tmp_path / "run", tmp_path / "out", ("story", "solver"))
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"recording-story.png", "recording-solver.png"}
    assert opened == {"story": "Story", "solver": "Edges and solver"}


def test_the_camera_moves_along_the_best_trajectory(tmp_path: Path) -> None:
    recorder = record(tmp_path / "parts")
    record_all(recorder)
    recorder.finish(tmp_path / "recording.rrd")
    moved = rows(tmp_path / "recording.rrd", layout.CAMERA, "Transform3D:translation")
    np.testing.assert_array_equal(np.float32(np.squeeze(moved)), np.float32(circle()[:, :3, 3]))


def test_which_trajectory_and_graph_are_the_last() -> None:
    names = ["002-poses-odometry.rrd", "002-poses-truth.rrd", "010-edges-1.rrd", "notes.rrd"]
    before = contents_of(map(Path, names))
    assert (before.trajectory, before.last_graph, before.last_solution) == ("odometry", 1, 0)
    after = contents_of(map(Path, [*names, "011-solution-1.rrd", "020-edges-2.rrd"]))
    assert (after.trajectory, after.last_graph, after.last_solution) == ("round_1", 2, 1)
    assert contents_of([]).trajectory == "truth"


def test_a_stage_recorded_again_replaces_its_part(tmp_path: Path) -> None:
    recorder = record(tmp_path / "parts")
    recorder.poses("truth", circle(5))
    recorder.poses("truth", circle(7))
    recorder.finish(tmp_path / "recording.rrd")
    assert len(rows(tmp_path / "recording.rrd", layout.poses("truth"), layout.FRAME)) == 7


def test_a_failed_stage_leaves_the_part_before_it(tmp_path: Path) -> None:
    recorder = record(tmp_path)
    recorder.poses("truth", circle(5))
    with pytest.raises(IndexError):
        recorder.poses("truth", np.eye(4))
    assert [path.name for path in tmp_path.iterdir()] == ["002-poses-truth.rrd"]
    assert len(rows(tmp_path / "002-poses-truth.rrd", layout.poses("truth"), layout.FRAME)) == 5


def test_the_eye_is_above_and_behind_the_cameras(tmp_path: Path) -> None:
    """Cameras all look along +z with y down, so up is −y and behind is −z."""
    poses = np.stack([np.eye(4)] * 4)
    poses[:, 0, 3] = np.arange(4)
    record(tmp_path).poses("truth", poses)
    eye = look_at((), RrdReader(tmp_path / "002-poses-truth.rrd").stream().filter(content=layout.poses("truth")))
    assert eye is not None
    np.testing.assert_allclose(eye.up, [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(eye.target, [1.5, 0, 0], atol=0.01)
    assert eye.position[1] < -0.5 and eye.position[2] < -0.5
    assert look_at((), ()) is None


def test_stages_without_anything_to_show(tmp_path: Path) -> None:
    recorder = record(tmp_path / "parts", level="summary")
    recorder.frames("nothing", [])
    recorder.clouds([], CloudSet.from_clouds([]))
    recorder.poses("truth", np.zeros((0, 4, 4)))
    recorder.evaluation((), {}, {})
    recorder.text("", [])
    recorder.finish(tmp_path / "recording.rrd")
    verify(tmp_path / "recording.rrd", tmp_path)


def test_it_opens_on_trajectories_and_edges(tmp_path: Path) -> None:
    recorder = record(tmp_path / "parts")
    record_all(recorder)
    recorder.frames("circle", make_frames())
    recorder.finish(tmp_path / "recording.rrd")
    try:
        picture(tmp_path / "recording.rrd", tmp_path / "opened.png")
    except WorkspaceError as error:
        pytest.skip(str(error))
    pixels = np.asarray(Image.open(tmp_path / "opened.png").convert("RGB"), int)
    for colour in (shapes.TRAJECTORY_COLOURS["odometry"], shapes.RESULT_COLOUR, shapes.IGNORED_COLOUR):
        assert np.count_nonzero(np.abs(pixels - colour).max(axis=-1) < 40) > 20, colour


@pytest.mark.filterwarnings("error")
def test_a_note_that_names_a_file_in_another_encoding_stays(tmp_path: Path) -> None:
    with stream.writing(tmp_path / "notes.rrd", "run-1") as begun:
        stream.log_notes(begun, 0, ["depth/\udcff.png: cannot be read"])
        stream.log_markdown(begun, "/text", "source \udcff")
    assert RrdReader(tmp_path / "notes.rrd").recordings()

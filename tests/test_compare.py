"""Two runs side by side: by hand, of the same poses moved as one body, of runs that share nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from hodge_pipeline import se3
from hodge_pipeline.cli.main import app
from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.recording import layout
from hodge_pipeline.report.contents import Report, SourceSummary
from hodge_pipeline.report.verdict import judge
from hodge_pipeline.run_folder import Ending, Run
from hodge_pipeline.scene import KeyFrames
from hodge_pipeline.types import CloudSet, Floats, Frame, Model, Source
from hodge_pipeline.types.ply import model_parts
from hodge_pipeline.uses.compared import compare, tables, write_comparison
from recording_data import circle, rows
from report_data import read_page

MOVED = se3.exp(np.array([0.3, -0.2, 0.1, 1.0, 2.0, -0.5]))


def make_run(folder: Path, poses: Floats, recipe: str = "seed: 0\n", first: float = 100.0, name: str = "s") -> Run:
    """A run that ended at these poses, its frames a second apart from the first one."""
    folder.mkdir()
    (folder / "recipe.yaml").write_text(recipe)
    points = se3.transform(poses, np.array([[0, 0, 1.0], [0.1, 0, 1.0]])).reshape(-1, 3).astype(np.float32)
    model = Model("cloud", points, colours=np.full((len(points), 3), 99, np.uint8))
    (folder / "cloud.ply").write_bytes(b"".join(model_parts(model)))
    frames = tuple(Frame(row, first + row) for row in range(len(poses)))
    source = Source(name, folder, frames)
    return Run(
        folder=folder,
        source=source,
        key_frames=KeyFrames.all_of(source, poses),
        clouds=CloudSet.from_clouds([]),
        rounds=(),
        poses=poses,
        models={"cloud": folder / "cloud.ply"},
        ending=Ending(poses, Report(folder.name, SourceSummary(name, "x", len(poses))), None),
    )


def test_a_run_moved_as_one_body_is_the_same_run(tmp_path: Path) -> None:
    a = make_run(tmp_path / "a", circle())
    b = make_run(tmp_path / "b", MOVED @ circle())
    found = compare(a, b)
    np.testing.assert_allclose(found.apart_m, np.zeros(12), atol=1e-6)
    np.testing.assert_allclose(found.a_from_b, se3.inverse(MOVED), atol=1e-6)
    measured, options = tables(found)
    assert measured.rows[0] == ("frames", "12", "12", "")
    assert measured.rows[1] == ("verdict", *(judge(report).headline for report in found.reports), "")
    assert {row[0]: row[2] for row in measured.rows}["poses apart, largest"] == "0"
    assert options.rows == ()


def test_options_that_differ_and_frames_that_are_shared(tmp_path: Path) -> None:
    a = make_run(tmp_path / "a", circle(), "seed: 0\nedges: {stage: overlap, min_iou: 0.3}\n")
    b = make_run(tmp_path / "b", circle()[4:], "seed: 0\nedges: {stage: overlap, min_iou: 0.5}\n", 104.0)
    found = compare(a, b)
    assert len(found.apart_m) == 8
    assert tables(found)[1].rows == (("edges.min_iou", "0.3", "0.5"),)


def test_another_stage_is_told_by_its_name_and_a_list_by_what_differs(tmp_path: Path) -> None:
    """And no recipe's description: what its options do is told already."""
    a = "description: A\nbuilders: [{stage: near, k: 1}, {stage: far, k: 2}]\nstart: {stage: given, reach: {x: 1}}\n"
    b = "description: B\nbuilders: [{stage: near, k: 1}, {stage: far, k: 3}]\nstart: {stage: sweeps}\n"
    found = compare(make_run(tmp_path / "a", circle(), a), make_run(tmp_path / "b", circle(), b))
    assert tables(found)[1].rows == (("builders.2.k", "2", "3"), ("start", "given", "sweeps"))


def test_numbers_of_frames_in_other_sources_are_no_shared_frames(tmp_path: Path) -> None:
    """Scans have no clock: the fifth of a street is not the fifth of a room."""
    a, b = make_run(tmp_path / "a", circle()), make_run(tmp_path / "b", circle()[:9])
    assert len(compare(a, b).apart_m) == 9, "the same source by its name"
    assert not len(compare(a, make_run(tmp_path / "c", circle()[:9], name="street")).apart_m)


def test_page_and_recording(tmp_path: Path) -> None:
    a, b = make_run(tmp_path / "a", circle()), make_run(tmp_path / "b", MOVED @ circle())
    found = compare(a, b)
    page, recording = write_comparison(tmp_path / "out", found)
    text, addresses = read_page(page)
    assert "a and b" in text and "laid onto A by the 12 frames" in text
    headline = judge(found.reports[0]).headline
    assert text.count(headline) == 2, "in each run's banner; in a table of numbers it pushes these off the page"
    assert len(addresses) == 5 and all(address.startswith("data:image/") for address in addresses)
    for side in "ab":
        poses = np.squeeze(rows(recording, layout.poses(side), "Transform3D:translation"))
        np.testing.assert_allclose(np.float32(poses), np.float32(circle()[:, :3, 3]), atol=2e-6)
        (points,) = rows(recording, f"{layout.MODEL}/{side}", "Points3D:positions")
        assert len(points) == 24
    assert len(RrdReader(recording).blueprints()) == 1


def test_runs_that_share_no_frame(tmp_path: Path) -> None:
    a, b = make_run(tmp_path / "a", circle()), make_run(tmp_path / "b", circle(), first=900.0)
    found = compare(a, b)
    assert not len(found.apart_m)
    page, _ = write_comparison(tmp_path / "out", found)
    assert "share too few frames" in page.read_text("utf-8")


def test_frames_without_a_pose_are_not_shared(tmp_path: Path) -> None:
    poses = circle()
    poses[3] = np.nan
    found = compare(make_run(tmp_path / "a", poses), make_run(tmp_path / "b", circle()))
    assert len(found.apart_m) == 11 and np.isfinite(found.apart_m).all()


def test_a_run_that_has_not_ended_is_one_line(tmp_path: Path) -> None:
    run = make_run(tmp_path / "a", circle())
    with pytest.raises(WorkspaceError, match="not finished"):
        compare(run, replace(run, ending=None))


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    runs = {run.folder: run for run in (make_run(tmp_path / "a", circle()), make_run(tmp_path / "b", circle()))}
    monkeypatch.setattr(Run, "load", runs.__getitem__)
    app(["compare", *map(str, runs), "--out", str(tmp_path / "out")], standalone_mode=False)
    assert "compare.html" in capsys.readouterr().out.replace("\n", "")

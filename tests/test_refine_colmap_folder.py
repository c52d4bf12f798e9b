"""`hodge refine colmap` as a command: what it tells, what it refuses, and how a stopped one goes on in its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pycolmap
import pytest
from typer.testing import CliRunner

import hodge_pipeline
from colmap_data import FREE, disturbed, noisy
from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.colmap.tracked import ColmapModel
from hodge_pipeline.cli.main import app
from hodge_pipeline.cli.refine_colmap import _lines
from hodge_pipeline.errors import SourceError, WorkspaceError
from hodge_pipeline.pairs.edits import listed_edges
from hodge_pipeline.refine.choice import UNTOLD, Choice
from hodge_pipeline.refine.model import _decision


def test_the_terminal_has_ten_lines_of_80_columns_and_verbose_has_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = noisy(tmp_path)
    command = ["refine", "colmap", str(model), "--out", "out", "--set", FREE[0], "--overwrite"]
    monkeypatch.chdir(tmp_path)
    verbose = CliRunner().invoke(app, [*command, "--verbose"])
    brief, whole = CliRunner().invoke(app, command).stdout.splitlines(), verbose.stdout
    assert "bundle adjustment: done" in verbose.stderr, "each step is told as it ends"
    assert brief[0].startswith("verdict  ") and brief[-1] == "report   out/report.html"
    assert len(brief) <= 10 and max(map(len, brief)) <= 80
    assert any("mean reprojection error" in line for line in brief)
    assert "candidate" in whole and "bundle adjustment" in whole and len(whole.splitlines()) > len(brief)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    for option in ("database", "depth"):
        with pytest.raises(SourceError, match="nowhere"):
            hodge_pipeline.refine_colmap(model, **{option: tmp_path / "nowhere"})
    (tmp_path / "depths").mkdir()
    with pytest.raises(SourceError, match="name the PNGs alike"):
        hodge_pipeline.refine_colmap(model, depth=tmp_path / "depths")
    with pytest.raises(SourceError, match="no COLMAP model"):
        hodge_pipeline.refine_colmap(tmp_path / "depths")
    with pytest.raises(WorkspaceError, match="give another"):
        hodge_pipeline.refine_colmap(model, out=model)


def test_a_model_without_an_observation_is_refused_and_nothing_written(tmp_path: Path) -> None:
    empty = pycolmap.Reconstruction(noisy(tmp_path))
    for key in list(empty.points3D):
        empty.delete_point3D(key)
    (tmp_path / "empty").mkdir()
    empty.write(tmp_path / "empty")
    with pytest.raises(SourceError, match="no point that two images saw"):
        hodge_pipeline.refine_colmap(tmp_path / "empty", out=tmp_path / "out", overrides=FREE)
    assert not (tmp_path / "out/sparse").exists()


def refuse(*_: object, **__: object) -> None:
    raise AssertionError("this was done before")


def stop(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def counted(patch: pytest.MonkeyPatch, method: str) -> list[object]:
    """One entry for each call of a method of models from now on."""
    calls, honest = list[object](), getattr(ColmapModel, method)

    def call(self: ColmapModel, *arguments: object, **named: object) -> object:
        calls.append(self)
        return honest(self, *arguments, **named)

    patch.setattr(ColmapModel, method, call)
    return calls


@pytest.mark.parametrize("text", [False, True])
def test_a_refinement_that_was_stopped_goes_on_and_ends_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: bool
) -> None:
    start = disturbed(noisy(tmp_path), tmp_path / "start")
    if not text:
        as_text, start = start, tmp_path / "as_binary"
        start.mkdir()
        pycolmap.Reconstruction(as_text).write_binary(start)
    whole, out = tmp_path / "whole", tmp_path / "stopped"
    hodge_pipeline.refine_colmap(start, overrides=FREE, out=whole)
    with monkeypatch.context() as patch:
        patch.setattr(ColmapModel, "resected", stop)
        with pytest.raises(KeyboardInterrupt):
            hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    with monkeypatch.context() as patch:
        calls = counted(patch, "adjusted")
        hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
        held = [model for model in calls if isinstance(model, ColmapModel) and model.refine == "none"]
        assert len(held) == 1, "that of the model as given was done before"
    monkeypatch.setattr(ColmapModel, "adjusted", refuse)
    again = hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    assert again.results[0].decision.outcome == "refined"
    ending = "txt" if text else "bin"
    for name in ("poses.tum", f"sparse/0/images.{ending}", f"sparse/0/points3D.{ending}"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


def test_a_model_that_changed_is_computed_anew_and_another_option_replaces_only_when_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, out = disturbed(noisy(tmp_path), tmp_path / "start"), tmp_path / "out"
    hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    other = [*FREE, "model.min_shared=20"]
    with pytest.raises(WorkspaceError, match="another refined model .model.min_shared was 30, is 20.: --overwrite"):
        hodge_pipeline.refine_colmap(start, overrides=other, out=out)
    pycolmap.Reconstruction(start).write_text(start)
    monkeypatch.setattr(ColmapModel, "adjusted", refuse)
    with pytest.raises(AssertionError, match="done before"):
        hodge_pipeline.refine_colmap(start, overrides=FREE, out=out)
    with pytest.raises(AssertionError, match="done before"):
        hodge_pipeline.refine_colmap(start, overrides=other, out=out, overwrite=True)


def test_a_refined_model_and_a_run_never_share_a_folder(tmp_path: Path) -> None:
    model, out = noisy(tmp_path), tmp_path / "out"
    (result,) = hodge_pipeline.refine_colmap(model, overrides=FREE, out=out).results
    kept = replace(result.decision, outcome="optimal", reason="already optimal: noise", doubt="")
    said = _lines(replace(result, decision=kept), alone=True, verbose=False)[0]
    assert said == "verdict  already optimal: noise", "and not twice"
    found: Any = SimpleNamespace(costs=[result.candidates[0][1]], candidates=[SimpleNamespace(name="as given")])
    decision = _decision(found, Choice(0, UNTOLD), result.scales, force=False, doubted=False)
    told = _lines(replace(result, decision=decision), alone=True, verbose=False)[0]
    assert told.startswith("verdict  kept as given: tracks fix the poses less well"), "which is not optimal"
    with pytest.raises(WorkspaceError, match="holds a refined model: give another --out"):
        hodge_pipeline.run("demo", out, source=tmp_path)
    with pytest.raises(WorkspaceError, match="hodge diagnose .* judges its edges"):
        listed_edges(out)
    run = tmp_path / "run"
    (run / "stages").mkdir(parents=True)
    with pytest.raises(WorkspaceError, match="holds a run: give another --out"):
        hodge_pipeline.refine_colmap(model, overrides=FREE, out=run)


def test_sub_models_are_found(tmp_path: Path) -> None:
    model = noisy(tmp_path)
    for number in ("10", "2"):
        (tmp_path / "scene/sparse" / number).mkdir(parents=True)
        for file in model.iterdir():
            (tmp_path / "scene/sparse" / number / file.name).write_bytes(file.read_bytes())
    found = ColmapModels().open_models(tmp_path / "scene")
    assert [Path(one.name).name for one in found] == ["2", "10"]

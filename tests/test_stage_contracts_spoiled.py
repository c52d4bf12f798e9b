"""The contract checks themselves: each stage here breaks one promise, and the check must say which."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from colmap_data import synthetic
from hodge_adapters.trajectories.readers import TumPosesReader
from hodge_adapters.trajectories.text import TumWriter, parse_tum
from hodge_pipeline import testing
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.global_landmarks import LandmarkConsensus
from hodge_pipeline.testing.writers import whole_source
from spoiled_stages import (
    Builder,
    Changeable,
    Executor,
    Fuser,
    NeedsFinite,
    Once,
    Spoiled,
    Start,
    Unhashable,
    always_converged,
    as_guessed,
    lopsided,
    mark,
    more_inliers,
    never_the_same,
    some_inliers,
    sure,
    unchanged,
    without_guess,
)
from spoiled_writers import Models, Rewriter, Writer

SPOILED = [
    ("edges", Changeable(), "is a stage", "can be changed"),
    ("edges", object(), "is a stage", "lacks a method of EdgeBuilder"),
    ("edges", Unhashable(), "is a stage", "has no hash"),
    ("edges", Builder("a list"), "candidates", "gives a list"),
    ("edges", Builder("no pair"), "candidates", "proposes no pair"),
    ("edges", Builder("backwards"), "candidates", "is not i < j"),
    ("edges", Builder("twice"), "candidates", "is proposed twice"),
    ("edges", Builder("no reason"), "candidates", "without a reason"),
    ("edges", Builder("overlap"), "candidates", r"not in \[0, 1\]"),
    ("edges", Builder("moves"), "candidates", "changes the poses"),
    ("edges", Builder("random"), "the same pairs again", "other pairs when asked again"),
    ("edges", Builder("empty ones"), "frames without points", "a frame without points is in a pair"),
    ("edges", Builder("names"), "rows, not names", "named otherwise"),
    ("edges", Builder("truth"), "no look at the truth", "frames' own poses"),
    ("edges", Builder("itself"), "one frame", "a pair has no frame"),
    ("registration", Changeable(), "is a stage", "can be changed"),
    ("registration", Spoiled(Gicp(), after=as_guessed), "known motion", "off by"),
    ("registration", Spoiled(Gicp(), after=lopsided), "known motion", "not symmetric"),
    ("registration", Spoiled(Gicp(), before=without_guess), "other axes", "guess i_from_j that undoes them: off by"),
    ("registration", Spoiled(Gicp(), after=never_the_same), "the same bits again", "other bits"),
    ("registration", Spoiled(Gicp(), before=mark), "prepared once", "registered before give other bits"),
    ("registration", NeedsFinite(), "points not finite", "off by"),
    ("registration", Spoiled(Gicp(), after=always_converged), "nothing in common", "called converged"),
    ("registration", Spoiled(Gicp(), after=sure), "a bare wall", "held in every direction"),
    ("global_registration", Changeable(), "is a stage", "can be changed"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=unchanged), "known motion", "off by"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=more_inliers), "known motion", "inliers of"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=never_the_same), "the same answer again", "another"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=never_the_same), "stored descriptions", "otherwise"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=some_inliers), "nothing in common", "1 matches agree"),
    ("executors", Changeable(), "is a stage", "can be changed"),
    ("executors", Executor("loses one"), "every block once", "7 blocks give the results of blocks"),
    ("executors", Executor("swaps"), "every block once", "is that of another"),
    ("executors", Executor("swallows"), "errors of tasks", "is lost"),
    ("executors", Once(), "left early", "opened again"),
    ("executors", Executor("gives up"), "a worker that dies", "a worker died once"),
    ("executors", Executor("kills silently"), "a block that kills", "must raise WorkerError"),
    ("fusion", Changeable(), "is a stage", "can be changed"),
    ("fusion", Fuser("nowhere"), "surface", "off the wall"),
    ("fusion", Fuser("silent"), "surface", "heard of 0 of 6"),
    ("fusion", Fuser("corners"), "surface", "a corner that is no point"),
    ("fusion", Fuser("random"), "the same bits again", "another model"),
    ("fusion", Fuser("grey"), "colours", "without colours"),
    ("fusion", Fuser("no notes"), "frames left out", "no note tells of a frame without a pose"),
    ("fusion", Fuser("blind"), "no geometry", "must raise SourceError"),
    ("start", Changeable(), "is a stage", "can be changed"),
    ("start", Start("stands still"), "first poses", "m from the first"),
    ("start", Start("one frame less"), "first poses", "has other frames than the source"),
    ("start", Start("sheared"), "first poses", "not a rigid motion"),
    ("start", Start("random"), "the same bits again", "other bits when started again"),
    ("start", Start("new keys"), "computed once", "is computed again"),
    ("start", Start("needs every frame"), "a frame without points", "raises ValueError: a frame is dark"),
    ("start", Start("takes anything"), "no points at all", "begin gives a NoneType"),
]


@pytest.mark.parametrize(("kind", "stage", "what", "why"), SPOILED)
def test_a_stage_that_breaks_its_contract_is_noticed(
    kind: str, stage: Any, what: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Registrars in this process: a worker is for open3d's, none of which is spoiled here."""
    monkeypatch.setattr("hodge_pipeline.testing.registrars.LocalExecutor", lambda **_: LocalExecutor(workers=0))
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.CHECKS[kind](stage, properties=[what])


@pytest.mark.parametrize(
    ("writer", "what", "why"),
    [
        (Changeable(), "is a stage", "can be changed"),
        (Writer("nothing"), "written or refused", "nothing is at the path"),
        (Writer("leftovers"), "written or refused", "are left behind"),
        (Writer("anonymous"), "written or refused", "does not name the source"),
        (Writer("clock"), "the same bytes again", "other bytes"),
        (Writer("appends"), "replaced", "something else than afresh"),
        (Writer("raw"), "no place to write", "raises NotADirectoryError"),
        (Writer("shifted"), "read back", "poses of the trajectory are off by"),
    ],
)
def test_a_writer_that_breaks_its_contract_is_noticed(writer: Any, what: str, why: str) -> None:
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.check_writer(writer, "poses.tum", TumPosesReader(), properties=[what])


@pytest.mark.parametrize(
    ("rewriter", "what", "why"),
    [
        (Changeable(), "is a stage", "can be changed"),
        (Rewriter("ignores"), "new poses", "poses are off by"),
        (Rewriter("name"), "new poses", "the file is called new.tum"),
        (Rewriter("converts"), "copy", "not the original's bytes"),
        (Rewriter("in place"), "original", "changes the original"),
    ],
)
def test_a_rewriter_that_breaks_its_contract_is_noticed(rewriter: Any, what: str, why: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    TumWriter().write(path, whole_source())
    assert len(parse_tum(path).trajectory) == len(whole_source().frames)
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.check_rewriter(rewriter, path, TumPosesReader(), properties=[what])


@pytest.mark.parametrize(
    ("models", "what", "why"),
    [
        (Changeable(), "is a stage", "can be changed"),
        (Models("takes anything"), "no such path", "must raise SourceError"),
        (Models("carried"), "bodies and frames", "where their bodies carry them"),
        (Models("sheared"), "measured", "an edge is not a rigid motion"),
        (Models("one cloud less"), "seen points", "points of"),
        (Models("one scale"), "another unit", "does not double the positions"),
        (Models("thins all"), "thinned", "of a model that has few"),
        (Models("stays"), "moved", "not at the poses that were given"),
        (Models("untold"), "adjusted", "whether its adjustment converged"),
        (Models("no notes"), "read back", "the notes are lost"),
    ],
)
def test_a_reader_of_models_that_breaks_its_contract_is_noticed(
    models: Any, what: str, why: str, tmp_path: Path
) -> None:
    synthetic(tmp_path)
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.check_model_reader(models, tmp_path / "text", properties=[what])


def test_each_property_has_a_stage_that_breaks_it() -> None:
    for kind in ("edges", "registration", "global_registration", "executors", "fusion", "start"):
        assert {what for name, _, what, _ in SPOILED if name == kind} == {*testing.CHECKS[kind].properties}, kind


def test_what_is_declared_as_lacking_must_be_lacking() -> None:
    with pytest.raises(AssertionError, match="one frame: declared as lacking, but it holds"):
        testing.check_edge_builder(SequentialEdges(), lacks=["one frame"], properties=["one frame"])
    with pytest.raises(AssertionError, match=r"no such property: \['speed'\]"):
        testing.check_edge_builder(SequentialEdges(), lacks=["speed"])

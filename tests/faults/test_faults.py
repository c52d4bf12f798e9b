"""A fast part of `make faults`."""

from __future__ import annotations

from pathlib import Path

import crash
import damage
import pytest
import reading
import repeated
import strangers
import units

from reading_targets import TARGETS

INPUTS = 30


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("faults")


def test_a_crash_before_any_write_loses_nothing(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crash, "EVERY", 20)
    points = crash.cases(True, scratch, 0)
    assert len(points) > 5
    for name in points[len(points) // 2], points[-1]:
        assert crash.check(name, scratch) == {"resumed to the same bits": 1}, name


def test_a_crash_before_the_recipe_has_its_name_locks_nothing(scratch: Path) -> None:
    folder = scratch / "locked"
    folder.mkdir()
    for name in (".lock", ".recipe.yaml.12.draft", ".mesh.ply.9.draft"):
        (folder / name).touch()
    from small_run import made, recipe

    import hodge_pipeline

    hodge_pipeline.run(recipe(made(scratch).source), folder)
    assert not [path for path in folder.rglob(".*") if path.name != ".lock"]


@pytest.mark.parametrize("way", damage.WAYS)
def test_a_damaged_step_is_healed_or_refused(way: str, scratch: Path) -> None:
    names = [name for name in damage.cases(True, scratch, 0) if name.startswith(way)]
    name = names[damage.WAYS.index(way) * 5 % len(names)]
    assert sum(damage.check(name, scratch).values()) == 1, name


@pytest.mark.parametrize("name", [f"name/{len(strangers.NAMES) - 1}", "run/link at log.txt", "hold/pipe at log.txt"])
def test_what_a_stranger_wrote_has_no_effect(name: str, scratch: Path) -> None:
    assert sum(strangers.check(name, scratch).values()) == 1


@pytest.mark.parametrize("stage", ["registration/ndt", "edges/overlap"])
def test_millimetres_give_the_same_poses(stage: str, scratch: Path) -> None:
    assert units.check(f"millimetres/{stage}", scratch) == {"the same poses": 1}


@pytest.mark.parametrize("graph", repeated.GRAPHS)
def test_odd_graphs_have_their_known_answers(graph: str, scratch: Path) -> None:
    assert sum(repeated.check(f"graph/maximum_likelihood/{graph}", scratch).values()) == 1


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_is_read_soundly_or_refused(name: str, tmp_path: Path) -> None:
    assert sum(reading.check(f"{name}/0/0/{INPUTS}", tmp_path).values()) in (1, INPUTS)


def test_input_that_changes_during_a_run_is_noticed(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    from small_run import made, recipe

    import hodge_pipeline
    from hodge_pipeline import pipeline

    source, fuse_all = made(scratch).source, pipeline.fuse_all
    image = sorted((source / "depth").iterdir())[0]
    contents, status = image.read_bytes(), image.stat()

    def touched(*inputs: object, **options: object) -> object:
        image.write_bytes(contents[:-1] + b"x")
        os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns))
        return fuse_all(*inputs, **options)

    monkeypatch.setattr(pipeline, "fuse_all", touched)
    try:
        for strict in (False, True):
            image.write_bytes(contents)
            os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns))
            run = hodge_pipeline.run(recipe(source), scratch / f"changed-{strict}", strict=strict)
            told = [str(note) for note in run.report.notes if "changed while the run" in str(note)]
            assert len(told) == strict and all(image.name in note for note in told)
    finally:
        image.write_bytes(contents)
        os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns))

"""A path read by a recipe for another format: the error, or a note, names the right one."""

from pathlib import Path

import pytest

from hodge_adapters.icl_nuim.reader import IclNuimReader
from hodge_adapters.seven_scenes.reader import SevenScenesReader
from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import registry
from hodge_pipeline.cli.list import next_command
from hodge_pipeline.demo.sequence import DemoOptions, make_sequence
from hodge_pipeline.errors import SourceError
from hodge_pipeline.recipe.recipe_file import recipe_names
from hodge_pipeline.sources.inspect import inspect
from hodge_pipeline.sources.opening import open_with_reader


@pytest.fixture(scope="module")
def tum_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    options = DemoOptions(frames=3, width=80, height=60, stride=1)
    return make_sequence(tmp_path_factory.mktemp("tum") / "sequence", options)


def numbered(folder: Path, tum_folder: Path) -> Path:
    """The same images as ICL-NUIM lists them: frame numbers for stamps."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir()
        for row, image in enumerate(sorted((tum_folder / name).iterdir())):
            (folder / name / f"{row}{image.suffix}").write_bytes(image.read_bytes())
    colour = sorted((folder / "rgb").iterdir())[0].suffix
    (folder / "associations.txt").write_text("".join(f"{k} depth/{k}.png {k} rgb/{k}{colour}\n" for k in range(3)))
    return folder


def test_a_folder_of_another_format_is_refused_with_its_recipe(tum_folder: Path) -> None:
    with pytest.raises(SourceError, match=r"no frame-000000.*looks like tum \(.*\): try the recipe tum"):
        open_with_reader(tum_folder, SevenScenesReader(), recipe_names())


def test_scans_are_sent_to_the_recipe_that_inspect_names(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    with pytest.raises(SourceError, match="looks like clouds .*: try the recipe scans$"):
        open_with_reader(tmp_path, TumReader(), recipe_names())
    assert next_command(tmp_path, inspect(tmp_path), None).startswith("hodge run scans ")


def test_what_can_be_read_all_the_same_is_noted(tum_folder: Path) -> None:
    source, _ = open_with_reader(tum_folder, IclNuimReader(), recipe_names())
    assert any("read as icl_nuim, but it looks like tum" in note for note in source.notes)


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        (
            "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n",
            "a graph of measured edges, which needs no frames: give it to hodge solve",
        ),
        ("# stamp\n0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n", "poses alone: with the frames they belong to hodge refine"),
        ("EDGE_SE2 0 1 1 0 0 nan 0 0 1 0 1\n", "which does not open it either"),
    ],
)
def test_what_has_no_frames_is_sent_elsewhere(tmp_path: Path, text: str, remedy: str) -> None:
    (tmp_path / "file.txt").write_text(text)
    with pytest.raises(SourceError, match=remedy):
        open_with_reader(tmp_path / "file.txt", TumReader(), recipe_names())


def test_the_right_reader_says_nothing(tum_folder: Path, tmp_path: Path) -> None:
    for reader in (TumReader(), None):
        source, _ = open_with_reader(tum_folder, reader, recipe_names())
        assert len(source.frames) == 3
        assert not any("looks like" in note for note in source.notes)
    source, _ = open_with_reader(numbered(tmp_path, tum_folder), IclNuimReader(), recipe_names())
    assert len(source.frames) == 3
    assert not any("looks like" in note for note in source.notes)


def test_a_path_that_is_nothing_keeps_its_own_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError) as refused:
        open_with_reader(tmp_path / "absent", TumReader(), recipe_names())
    assert "looks like" not in str(refused.value)
    with pytest.raises(SourceError, match="no depth.txt") as refused:
        open_with_reader(tmp_path, TumReader(), recipe_names())
    assert "looks like" not in str(refused.value)


def test_a_path_that_is_not_there_is_told_alike_by_every_reader(tmp_path: Path) -> None:
    for name in registry.names("readers"):
        with pytest.raises(SourceError, match="gone: no such file or folder$"):
            open_with_reader(tmp_path / "gone", registry.load("readers", name)())

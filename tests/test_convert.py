from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hodge_adapters.poses_text import parse_tum
from hodge_pipeline.cli.convert import convert, writer_name
from hodge_pipeline.cli.main import app
from hodge_pipeline.errors import HodgeError, RecipeError, SourceError
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.types import Source
from readers_data import seven_scenes_sequence, tum_line


@pytest.mark.parametrize("name", ["a.tum", "a.kitti", "a.csv", "a.log", "a.json", "transforms.json", "model"])
def test_poses_survive_a_conversion_there_and_back(tmp_path: Path, name: str, capsys) -> None:
    sequence = seven_scenes_sequence(tmp_path / "seq-01")
    original = guess_reader(sequence).open(sequence)
    convert(sequence, tmp_path / name)
    assert "written as" in capsys.readouterr().out
    convert(tmp_path / name, tmp_path / "back.tum")
    back = parse_tum(tmp_path / "back.tum").trajectory.world_from_cam
    np.testing.assert_allclose(back, [frame.world_from_cam for frame in original.frames], atol=1e-9)


def test_the_name_tells_the_writer(tmp_path: Path) -> None:
    empty = Source("a", tmp_path)
    assert writer_name(Path("a.g2o"), empty) == "g2o" and writer_name(Path("a.json"), empty) == "open3d_trajectory"
    with pytest.raises(RecipeError, match="--to"):
        writer_name(Path("a.docx"), empty)
    path = tmp_path / "a.tum"
    path.write_text(tum_line(1.5, np.eye(4)))
    with pytest.raises(HodgeError, match="no graph"):
        convert(path, tmp_path / "a.g2o")
    with pytest.raises(SourceError, match="no such file"):
        convert(tmp_path / "nothing", tmp_path / "a.tum")
    convert(path, tmp_path / "b.any", to="kitti")
    assert (tmp_path / "b.any").read_text().count(" ") == 11


def test_a_result_is_not_written_into_the_folder_that_is_read(tmp_path: Path) -> None:
    (tmp_path / "data/room").mkdir(parents=True)
    (tmp_path / "data/room/poses.tum").write_text("0 0 0 0 0 0 0 1\n")
    for source, out, what in (("data", "data", "is"), ("data/room/poses.tum", "data", "holds")):
        with pytest.raises(RecipeError, match=f"{what} what is read"):
            convert(tmp_path / source, tmp_path / out)


def test_what_is_read_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text("# mine\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    (tmp_path / "same.g2o").symlink_to("graph.g2o")
    before = (tmp_path / "graph.g2o").read_bytes()
    for command in (["convert", "graph.g2o", "same.g2o"], ["solve", "graph.g2o", "--out", "same.g2o"]):
        given = [str(tmp_path / word) if word.endswith(".g2o") else word for word in command]
        with pytest.raises(RecipeError, match="is what is read"):
            CliRunner().invoke(app, given, catch_exceptions=False)
    assert (tmp_path / "graph.g2o").read_bytes() == before

"""The recipes on the beginning of real sequences against the numbers in golden.json; whole: benchmarks/baseline.py."""

import json
from pathlib import Path
from typing import Any

import pytest

import hodge_pipeline
from hodge_pipeline.recipe.schema import load_recipe

GOLDEN = json.loads((Path(__file__).parent / "golden.json").read_text())
LIGHT = ("fusion=[]", "recording.level=off", "evaluation.tables=false", "executor.workers=0")


def beginning(source: Path, until: str, folder: Path) -> Path:
    """A folder with links to the source's files before this one."""
    for file in sorted(path for path in source.rglob("*") if path.is_file()):
        name = file.relative_to(source)
        if str(name) < until:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).symlink_to(file)
    return folder


@pytest.mark.parametrize("name", GOLDEN)
def test_a_recipe_reaches_its_golden_numbers(name: str, data_dir: Path, tmp_path: Path) -> None:
    golden: dict[str, Any] = GOLDEN[name]
    source = data_dir / golden["source"]
    if golden["until"]:
        source = beginning(source, golden["until"], tmp_path / "source")
    run = hodge_pipeline.run(load_recipe(name, [*LIGHT, *golden["overrides"]], source), tmp_path / "run")
    assert len(run.source.frames) == golden["frames"]
    rows = {row.name: row.ate_rmse_m for row in run.report.trajectories}
    expected = golden["ate_rmse_m"]
    assert rows["result"] == pytest.approx(expected["value"], abs=expected["tolerance"])
    assert rows["result"] < rows["odometry"]

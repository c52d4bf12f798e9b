"""The recipes on real sequences against the numbers in golden.json."""

import json
from pathlib import Path

import pytest

import hodge_pipeline
from hodge_pipeline.recipe.schema import load_recipe

GOLDEN = json.loads((Path(__file__).parent / "golden.json").read_text())
LIGHT = ("fusion=[]", "recording.level=off", "evaluation.tables=false")


@pytest.mark.slow
@pytest.mark.parametrize("name", GOLDEN)
def test_a_recipe_reaches_its_golden_numbers(name: str, data_dir: Path, tmp_path: Path) -> None:
    golden = GOLDEN[name]
    recipe = load_recipe(name, [*LIGHT, *golden["overrides"]], data_dir / golden["source"])
    run = hodge_pipeline.run(recipe, tmp_path / "run")
    assert len(run.source.frames) == golden["frames"]
    rows = {row.name: row.ate_rmse_m for row in run.report.trajectories}
    expected = golden["ate_rmse_m"]
    assert rows["result"] == pytest.approx(expected["value"], abs=expected["tolerance"])
    assert rows["result"] < rows["odometry"]

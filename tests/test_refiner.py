"""A refiner in a recipe: its poses are those of the run."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import hodge_pipeline
from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.run_folder import Run
from hodge_pipeline.types import Floats
from synthetic import tiny_sequence  # noqa: F401 - a fixture
from test_pipeline import small_recipe

SHIFT = np.array([0, 0, 0, 0.5, 0, 0])


@dataclass(frozen=True)
class Shifted:
    """Moves every pose by half a metre; loses the last one where it is told to."""

    loses: bool = False

    def refine(self, frames, world_from_cam: Floats, advance=lambda done: None) -> Floats:
        poses = se3.exp(SHIFT) @ world_from_cam
        return poses[:-1] if self.loses else poses


def test_the_poses_of_a_run_are_those_of_its_refiner(tiny_sequence: Path, tmp_path: Path) -> None:  # noqa: F811
    recipe = small_recipe(tiny_sequence, "evaluation.tables=false", "fusion=[]", "recording.level=off")
    plain = hodge_pipeline.run(recipe, tmp_path / "plain")
    moved = hodge_pipeline.run(replace(recipe, refiner=Shifted()), tmp_path / "moved")
    np.testing.assert_allclose(moved.poses, se3.exp(SHIFT) @ plain.poses, atol=1e-12)
    np.testing.assert_array_equal(Run.load(tmp_path / "moved").poses, moved.poses)
    with pytest.raises(GraphError, match="the refiner gave"):
        hodge_pipeline.run(replace(recipe, refiner=Shifted(loses=True)), tmp_path / "lost")

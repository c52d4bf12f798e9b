"""What a user of the package sees first: its public names, what they do and how they print."""

from __future__ import annotations

import pytest

from hodge_pipeline.errors import RecipeError
from hodge_pipeline.recipe.schema import load_recipe


def test_a_recipe_with_the_old_name_of_the_solver_is_told_the_new_one() -> None:
    with pytest.raises(RecipeError, match=r"no stage 'hodge'.*did you mean 'maximum_likelihood'"):
        load_recipe("demo", ["solver=hodge"])

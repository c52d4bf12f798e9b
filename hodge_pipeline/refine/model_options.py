"""Options of refining a model with tracks: the recipe `colmap_refine`."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.recipe import binding, recipe_file
from hodge_pipeline.registration.acceptance import Acceptance
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.stages import OPTIONS, ConsistencySolver, EdgeBuilder, Executor, ModelReader, Registrar

RECIPE = "colmap_refine"


@dataclass(frozen=True, config=OPTIONS)
class ModelRefinement:
    """How a model is refined. Every stage is `{stage: name, option: value, …}`, or its name alone."""

    model: ModelReader = Field(description="what the model is, and what lies beside it")
    edges: EdgeBuilder = Field(description="which images with depth are registered with each other")
    registration: Registrar = Field(description="how their clouds are registered")
    solver: ConsistencySolver = Field(description="how the poses are made consistent with all edges")
    executor: Executor = Field(description="where pairs are registered")
    source: str | None = Field(default=None, description="the model; the command line names it")
    description: str = Field(default="", description="one sentence for `hodge recipes`")
    seed: int = Field(default=0, ge=0, description="of everything random")
    clouds: CloudOptions = CloudOptions()
    acceptance: Acceptance = Acceptance(min_spread=0.0)


def load_model_refinement(name_or_path: str = RECIPE, overrides: Sequence[str] = ()) -> ModelRefinement:
    """The options of a recipe by name or file, with overrides such as `model.depth=depth`.

    Raises `RecipeError`: `file:line: key: what was expected`.
    """
    document = recipe_file.load(name_or_path, overrides)
    return binding.bind(ModelRefinement, document.data, document.where)

"""A recipe: which stages make a run, and their options."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import registry
from hodge_pipeline.complex.parts import ComplexOptions
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.pairs.held_out import GuardOptions
from hodge_pipeline.recipe import binding, recipe_file
from hodge_pipeline.recipe.recording_options import RecordingOptions
from hodge_pipeline.recipe.round_options import SolveWith, SuggestionOptions
from hodge_pipeline.registration.acceptance import Acceptance
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.sources.inspect import guess_reader
from hodge_pipeline.sources.measured_edges import MeasuredOptions
from hodge_pipeline.stages import (
    OPTIONS,
    ConsistencySolver,
    EdgeBuilder,
    Executor,
    FrameReader,
    Fuser,
    Registrar,
    Start,
)
from hodge_pipeline.start.key_frames import KeyFrameStart
from hodge_pipeline.start.known_positions import PositionOptions
from hodge_pipeline.store import yaml_file


@dataclass(frozen=True, config=OPTIONS)
class SourceOptions:
    """What to read, and as what."""

    path: Path | None = Field(
        default=None,
        description="a folder or file, relative to where the command runs; `hodge run --source` sets it",
    )
    reader: FrameReader | None = Field(
        default=None, description="its format; none: the reader that is surest of the path"
    )


@dataclass(frozen=True, config=OPTIONS)
class EvaluationOptions:
    """What is measured at the end."""

    tables: bool = Field(default=True, description="the two score tables, about 2 CPU seconds for 250 frames of a room")
    truth: Path | None = Field(
        default=None,
        description="a file of true poses of the frames; `frames`: the source's own poses are true; none: those of a "
        "benchmark are, no others",
    )
    rpe_delta_frames: int = Field(
        default=1,
        ge=1,
        description="frames from one pose to the other in the relative pose error; 30 are a second of most cameras",
    )


@dataclass(frozen=True, config=OPTIONS)
class Recipe:
    """A whole run. Every stage is `{stage: name, option: value, …}`, or its name alone."""

    edges: EdgeBuilder = Field(description="which pairs of frames to register")
    registration: Registrar = Field(description="how a pair is registered")
    solver: ConsistencySolver = Field(description="how the poses are made consistent")
    executor: Executor = Field(description="where pairs are registered")
    description: str = Field(default="", description="one sentence for `hodge recipes`")
    seed: int = Field(default=0, ge=0, description="of everything random; the same seed gives the same poses")
    source: SourceOptions = SourceOptions()
    scale: Annotated[float, Field(gt=0)] | Literal["auto"] = Field(
        default=1.0,
        description="factor on every length (`…_m`) of clouds, start, edges, registration, complex, "
        "acceptance, solver and fusion, which are written for rooms; auto: such that most scans have 1500 to 40,000 "
        "voxels of `clouds.voxel_m`, so 1 for rooms",
    )
    clouds: CloudOptions = CloudOptions()
    start: Start = Field(
        default=KeyFrameStart(),
        description="where first poses come from: consecutive frames, given poses, no order",
    )
    complex: ComplexOptions = ComplexOptions()
    guard: GuardOptions = GuardOptions()
    acceptance: Acceptance = Acceptance()
    measured: MeasuredOptions = MeasuredOptions()
    positions: PositionOptions = PositionOptions()
    outer_iterations: int = Field(
        default=2,
        ge=1,
        le=20,
        description="rounds of new edges, registration and solve, each from the poses of the last",
    )
    diagnosis: DiagnosisOptions = DiagnosisOptions()
    solve_with: SolveWith = Field(
        default="kept",
        description="kept: edges that the diagnosis calls wrong or suspect are left out of every solve; all: verdicts "
        "are reported alone",
    )
    suggestions: SuggestionOptions = SuggestionOptions()
    fusion: tuple[Fuser, ...] = Field(default=(), description="each makes one model from the final poses")
    evaluation: EvaluationOptions = EvaluationOptions()
    recording: RecordingOptions = RecordingOptions()


REQUIRED = ("edges", "registration", "solver", "executor")
"""Stages that have no default."""


def load_recipe(name_or_path: str, overrides: Sequence[str] = (), source: Path | None = None) -> Recipe:
    """The recipe of a name or file, with overrides such as `solver.inner_iterations=5` and another source.

    Options of a reader without a name are bound to the reader that is surest of the source. Raises `RecipeError`:
    `file:line: key: what was expected`.
    """
    document = recipe_file.load(name_or_path, overrides)
    if "model" in document.data:
        raise RecipeError(f"recipe '{name_or_path}' refines a model: hodge refine colmap MODEL --recipe {name_or_path}")
    recipe = binding.bind(Recipe, _with_reader(document.data, source), document.where)
    return recipe if source is None else with_source(recipe, source)


def _with_reader(data: dict[str, Any], source: Path | None) -> dict[str, Any]:
    """The recipe's data in which a reader with options but no name is the one that is surest of the source."""
    section = data.get("source")
    if not isinstance(section, dict):
        return data
    options, path = section.get("reader"), source or section.get("path")
    if not isinstance(options, dict) or "stage" in options or not isinstance(path, (str, Path)):
        return data
    name = registry.name_of(guess_reader(Path(path)))
    return {**data, "source": {**section, "reader": {"stage": name, **options}}}


def recipe_of_run(path: Path) -> tuple[Recipe, tuple[str, ...]]:
    """The recipe of a run, as far as this version knows its options, and why each other option was left out.

    It serves to show the run; `load_recipe`, which runs it again, refuses unknown options. Unknown stages that are
    required become those of the recipe `tum`. Raises `RecipeError` where the file is no YAML.
    """
    document = yaml_file.read(path)
    basic = {key: value for key, value in recipe_file.load("tum").data.items() if key in REQUIRED}
    return binding.bind_known(Recipe, document.data, document.where, basic)


def with_source(recipe: Recipe, path: Path) -> Recipe:
    """The recipe with another path of its source."""
    return dataclasses.replace(recipe, source=dataclasses.replace(recipe.source, path=path))

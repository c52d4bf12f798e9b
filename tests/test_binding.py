"""Plain data to typed options: errors at their line, stages by name, the schema."""

from pathlib import Path

import pytest

from hodge_adapters.tum.reader import TumReader
from hodge_pipeline import registry
from hodge_pipeline.errors import RecipeError
from hodge_pipeline.recipe import binding
from hodge_pipeline.recipe.recipe_file import recipe_names
from hodge_pipeline.recipe.schema import Recipe, load_recipe
from hodge_pipeline.refine.model_options import RECIPE as MODEL_RECIPE
from hodge_pipeline.refine.model_options import ModelRefinement, load_model_refinement
from hodge_pipeline.store.yaml_file import dump, parse

SMALL = """
edges: {stage: overlap, min_iou: 0.4}
registration: gicp
solver: poisson
executor: local
"""


def load_any(name: str) -> Recipe | ModelRefinement:
    """The recipe of a run, or of the refinement of a model."""
    return load_model_refinement(name) if name == MODEL_RECIPE else load_recipe(name)


def load(tmp_path: Path, text: str) -> Recipe:
    path = tmp_path / "r.yaml"
    path.write_text(text)
    return load_recipe(str(path))


@pytest.mark.parametrize("name", recipe_names())
def test_every_recipe_of_the_package_loads_and_round_trips(name: str) -> None:
    recipe = load_any(name)
    text = dump(binding.unbind(recipe))
    again = binding.bind(type(recipe), parse(text, "again").data, lambda keys: "again")
    assert again == recipe
    assert recipe.description


def test_a_stage_by_name_has_its_defaults(tmp_path: Path) -> None:
    recipe = load(tmp_path, SMALL)
    assert recipe.registration == registry.load("registration", "gicp")()
    assert recipe.edges == registry.load("edges", "overlap")(min_iou=0.4)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("edgse: overlap\n", "r.yaml:6: edgse: unknown option (did you mean 'edges'?)"),
        ("clouds: {voxel: 0.1}\n", "r.yaml:6: clouds.voxel: unknown option (did you mean 'voxel_m'?)"),
        ("clouds:\n  voxel_m: large\n", "r.yaml:7: clouds.voxel_m: input should be a valid number"),
        ("clouds:\n  voxel_m: -1\n", "r.yaml:7: clouds.voxel_m: input should be greater than 0, got -1"),
        ("clouds:\n  voxel_m: true\n", "r.yaml:7: clouds.voxel_m: expected a finite number, got True"),
        ("clouds:\n  voxel_m: .inf\n", "r.yaml:7: clouds.voxel_m: expected a finite number, got inf"),
        ("outer_iterations: true\n", "r.yaml:6: outer_iterations: expected a finite number, got True"),
        ("clouds: 3\n", "r.yaml:6: clouds: expected a mapping of options, got 3"),
        ("outer_iterations: two\n", "r.yaml:6: outer_iterations: input should be a valid integer"),
        ("fusion: [{stage: tsfd}]\n", "r.yaml:6: fusion.0: no stage 'tsfd' of kind 'fusion' (did you mean 'tsdf'?)"),
        ("fusion: [{voxel_m: 1}]\n", "r.yaml:6: fusion.0: expected {stage: NAME"),
        (
            "fusion:\n  - stage: tsdf\n    voxle_m: 1\n",
            "r.yaml:8: fusion.0.voxle_m: unknown option (did you mean 'voxel_m'",
        ),
        (
            "start: {stage: odometry, registration: {stage: gicp, distances_m: []}}\n",
            "r.yaml:6: start.registration.distances_m:",
        ),
        (
            "start: {stage: odometry, registration: {stage: gicp, source_points: [5]}}\n",
            "r.yaml:6: start.registration: distances_m must be positive, source_points at least 11",
        ),
        (
            "source: {reader: tum, depth_scale: 1000}\n",
            "r.yaml:6: source.depth_scale: unknown option (did you mean 'source.reader.depth_scale'?)",
        ),
        (
            "start: {stage: odometry, registration: null}\n",
            "r.yaml:6: start.registration: expected {stage: NAME, …} with a NAME of: coloured_icp",
        ),
        ("seed: -1\n", "r.yaml:6: seed: expected a whole number from 0, got -1"),
        ("source: {path: [a, b]}\n", "r.yaml:6: source.path: expected a path, got ['a', 'b']"),
        ("fusion: none\n", "r.yaml:6: fusion: expected a list, got 'none'"),
        (
            "suggestions: {among: {stage: combined, builders: []}}\n",
            "suggestions.among.builders: expected more items, got ()",
        ),
        ("scale: big\n", "r.yaml:6: scale: expected number or 'auto', got 'big'"),
        (
            "source: {reader: {stage: tum, camera: [525, 525]}}\n",
            "r.yaml:6: source.reader.camera: expected text or [number, number, number, number], got [525, 525]",
        ),
        (
            "recording: {level: loud}\n",
            "r.yaml:6: recording.level: input should be 'off', 'summary', 'normal' or 'full'",
        ),
    ],
)
def test_errors_name_file_line_key_and_what_was_expected(tmp_path: Path, change: str, expected: str) -> None:
    with pytest.raises(RecipeError) as caught:
        load(tmp_path, SMALL + change)
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value) and "ArgsKwargs" not in str(caught.value)


def test_a_misspelt_section_of_an_override_is_where_it_was_given() -> None:
    with pytest.raises(RecipeError, match=r"^--set sorce.path=x: sorce: unknown option \(did you mean 'source'"):
        load_recipe("demo", ["sorce.path=x"])


def test_options_alone_are_those_of_the_surest_reader_of_the_source(tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb.txt").write_text("1.0 rgb/1.0.png\n")
    (tmp_path / "depth.txt").write_text("1.0 depth/1.0.png\n")
    source = load_recipe("slam_refine", ["source.reader.every=3"], tmp_path).source
    assert source.reader == TumReader(every=3) and source.path == tmp_path
    assert load_recipe("slam_refine", [f"source.path={tmp_path}", "source.reader.every=3"]).source == source
    with pytest.raises(RecipeError, match="source.reader: expected {stage: NAME"):
        load_recipe("slam_refine", ["source.reader.every=3"])


def test_a_missing_stage_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="solver: this option is required"):
        load(tmp_path, SMALL.replace("solver: poisson\n", ""))


def test_nested_stages(tmp_path: Path) -> None:
    text = SMALL.replace(
        "{stage: overlap, min_iou: 0.4}", "{stage: combined, builders: [sequential, {stage: overlap, min_iou: 0.2}]}"
    )
    builders = load(tmp_path, text).edges.builders  # type: ignore[attr-defined]
    assert [registry.name_of(builder) for builder in builders] == ["sequential", "overlap"]


def test_the_schema_offers_every_stage_and_refuses_unknown_keys() -> None:
    schema = binding.json_schema(Recipe)
    names = {option["anyOf"][0]["const"] for option in schema["$defs"]["kind-registration"]["anyOf"]}
    assert names == set(registry.names("registration"))
    assert schema["additionalProperties"] is False
    assert schema["properties"]["registration"]["$ref"] == "#/$defs/kind-registration"
    overlap = next(o for o in schema["$defs"]["kind-edges"]["anyOf"] if o["anyOf"][0]["const"] == "overlap")
    assert overlap["anyOf"][1]["properties"]["min_iou"]["description"]


def test_the_schema_agrees_with_the_recipes() -> None:
    import jsonschema

    schemas = {cls: binding.json_schema(cls) for cls in (Recipe, ModelRefinement)}
    for name in recipe_names():
        recipe = load_any(name)
        jsonschema.validate(binding.unbind(recipe), schemas[type(recipe)])


@pytest.mark.parametrize("kind", registry.KINDS)
def test_every_registered_stage_loads_and_keeps_its_contract(kind: str) -> None:
    for name in registry.names(kind):
        cls = registry.load(kind, name)
        assert (cls.__doc__ or "").strip(), f"{kind} {name} does not say what it is"
        for field, info in cls.__pydantic_fields__.items():
            assert info.description, f"{kind} {name}: option {field} does not say what it is for"
        if not any(info.is_required() for info in cls.__pydantic_fields__.values()):
            stage = cls()
            assert isinstance(stage, registry.KINDS[kind].protocol)
            with pytest.raises(AttributeError):
                stage.a_field_that_is_not_there = 1


def test_the_seed_of_a_recipe_reaches_every_stage_that_has_one(tmp_path: Path) -> None:
    recipe = load(tmp_path, SMALL + "seed: 7\nstart: {stage: odometry, registration: {stage: vgicp, seed: 3}}\n")
    assert recipe.registration.seed == 7  # type: ignore[attr-defined]
    assert recipe.start.registration.seed == 3  # type: ignore[attr-defined]

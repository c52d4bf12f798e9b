"""YAML as data, recipe files, overrides."""

from pathlib import Path

import pytest

from hodge_pipeline.errors import RecipeError
from hodge_pipeline.recipe import recipe_file
from hodge_pipeline.store import yaml_file


def test_plain_values_and_their_lines() -> None:
    document = yaml_file.parse("a: 1e-2\nb:\n  c: on\n  d: [1, {e: null}]\n", "x.yaml")
    assert document.data == {"a": 0.01, "b": {"c": "on", "d": [1, {"e": None}]}}
    assert document.origins[("b", "c")] == "x.yaml:3"
    assert document.origins[("b", "d", 1, "e")] == "x.yaml:4"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: !!python/object/apply:os.system [ls]", "bad.yaml:1: the tag"),
        ("x: 1\na: !!python/name:os.system ''", "bad.yaml:2: the tag"),
        ("a: !env HOME", "the tag '!env' is not allowed"),
        ("a: 1\na: 2", "bad.yaml:2: found duplicate key"),
        ("a: [1", "bad.yaml:1"),
        ("- 1", "a recipe is a mapping"),
        ("a: 1\n---\nb: 2", "bad.yaml:2: expected a single document in the stream, but found another document"),
        ("a:\n\tb: 1", "cannot start any token: indent with blanks"),
        ("1: 2", "the key 1 is not a name"),
        ("a: 2026-01-01", "a value of type date"),
        ("a: \0", "bad.yaml: not YAML: unacceptable character"),
        ('x: 1\na: "b\\0c"', "bad.yaml:2: 'b\\x00c' holds a character that no file can have"),
        ('a: "\\ud800"', "bad.yaml:1: '\\ud800' holds a character"),
        ("a: " + "[" * 3000 + "]" * 3000, "bad.yaml:1: more than 50 levels"),
    ],
)
def test_what_is_not_plain_data_is_refused(text: str, expected: str) -> None:
    with pytest.raises(RecipeError, match="^bad.yaml") as caught:
        yaml_file.parse(text, "bad.yaml")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_done_to_a_document_is_not_done_to_the_next_of_the_same_text() -> None:
    changed = yaml_file.parse("a: {b: [1]}", "file.yaml")
    changed.data["a"]["b"].append(2)
    changed.origins.clear()
    again = yaml_file.parse("a: {b: [1]}", "file.yaml")
    assert again.data == {"a": {"b": [1]}} and again.where(("a", "b")) == "file.yaml:1"


def test_aliases_cannot_multiply_without_bound() -> None:
    levels = "".join(f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join([f'*{chr(97 + k)}'] * 9)}]\n" for k in range(9))
    with pytest.raises(RecipeError, match="this is no recipe"):
        yaml_file.parse("a: &a [1, 2, 3]\n" + levels, "bomb.yaml")


def test_a_merge_key_is_read_and_cannot_multiply() -> None:
    document = yaml_file.parse("a: &a {x: 1}\nb: {<<: *a}\nc:\n  <<: *a\n  y: 2\n", "x.yaml")
    assert document.data == {"a": {"x": 1}, "b": {"x": 1}, "c": {"x": 1, "y": 2}}
    assert (document.origins["b", "x"], document.origins["c", "y"]) == ("x.yaml:2", "x.yaml:5")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: " + "[" * 5000 + "]" * 5000, "more than 50 levels"),
        ("a: " + "{a: " * 5000 + "1" + "}" * 5000, "more than 50 levels"),
        ("a:\n  " + "- " * 5000 + "1", "more than 50 levels"),
        ("&a {b: *a}", "50 levels"),
        ("a: &a {<<: *a}", "merged into itself"),
        ("a: 0x" + "f" * 90_000, "a whole number of 360000 bits"),
        ("a: 9223372036854775808", "a whole number of 64 bits"),
        ("a: -1e308", r"a number past 1e\+100"),
        ("a: " + "9" * 90_000, "digits"),
    ],
)
def test_what_would_fill_the_stack_or_a_line_is_refused(text: str, expected: str) -> None:
    with pytest.raises(RecipeError, match=expected) as refused:
        yaml_file.parse(text, "file")
    assert len(str(refused.value)) < 200
    assert "\n" not in str(refused.value)


def test_text_in_another_encoding_is_told(tmp_path: Path) -> None:
    (tmp_path / "latin.yaml").write_bytes(b"a: caf\xe9\n")
    with pytest.raises(RecipeError, match=r"latin\.yaml: no text in UTF-8 at byte 6: save it as UTF-8$"):
        yaml_file.read(tmp_path / "latin.yaml")


def test_a_huge_file_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.yaml"
    path.write_text("a: " + "x" * yaml_file.MAX_BYTES)
    with pytest.raises(RecipeError, match="the limit is"):
        yaml_file.read(path)


def test_dump_reads_back_in_order() -> None:
    data = {"z": 1, "a": {"y": [1, 2.5, "on", "1e-2"], "b": None}, "t": True}
    again = yaml_file.parse(yaml_file.dump(data), "again").data
    assert again == data
    assert list(again) == list(data)


@pytest.fixture
def recipes(tmp_path: Path) -> Path:
    (tmp_path / "base.yaml").write_text(
        "seed: 1\nregistration: {stage: gicp, max_iterations: 20}\nedges: {builders: [{stage: a}, {stage: b, x: 1}]}\n"
    )
    (tmp_path / "child.yaml").write_text("extends: base.yaml\nseed: 2\nregistration: {max_iterations: 5}\n")
    return tmp_path


def test_extends_merges_key_by_key(recipes: Path) -> None:
    document = recipe_file.load(str(recipes / "child.yaml"))
    assert document.data["registration"] == {"stage": "gicp", "max_iterations": 5}
    assert document.data["seed"] == 2
    assert document.origins[("seed",)].endswith("child.yaml:2")
    assert document.origins[("registration", "stage")].endswith("base.yaml:2")


def test_another_stage_drops_the_options_of_the_first(recipes: Path) -> None:
    path = recipes / "other.yaml"
    path.write_text("extends: base.yaml\nregistration: {stage: ndt}\n")
    assert recipe_file.load(str(path)).data["registration"] == {"stage": "ndt"}
    path.write_text("extends: base.yaml\nregistration: ndt\n")
    document = recipe_file.load(str(path))
    assert document.where(("registration", "stage")).endswith("other.yaml:2")


def test_extends_in_a_circle_is_refused(recipes: Path) -> None:
    (recipes / "a.yaml").write_text("extends: b.yaml\n")
    (recipes / "b.yaml").write_text("extends: a.yaml\n")
    with pytest.raises(RecipeError, match="extends"):
        recipe_file.load(str(recipes / "a.yaml"))


def test_what_extends_no_recipe_is_told_where_it_says_so(recipes: Path) -> None:
    (recipes / "a.yaml").write_text("seed: 1\nextends: /etc/passwd\n")
    with pytest.raises(RecipeError, match=r"a\.yaml:2: extends: /etc/passwd: is no recipe"):
        recipe_file.load(str(recipes / "a.yaml"))


@pytest.mark.parametrize(
    ("override", "key", "expected"),
    [
        ("seed=7", "seed", 7),
        ("registration.max_iterations=3", "registration", {"stage": "gicp", "max_iterations": 3}),
        ("registration=ndt", "registration", "ndt"),
        ("registration.stage=ndt", "registration", {"stage": "ndt"}),
        ("registration={max_iterations: 9}", "registration", {"stage": "gicp", "max_iterations": 9}),
        ("new.a=[1, 2]", "new", {"a": [1, 2]}),
        ("edges.builders.1.x=5", "edges", {"builders": [{"stage": "a"}, {"stage": "b", "x": 5}]}),
    ],
)
def test_overrides(recipes: Path, override: str, key: str, expected: object) -> None:
    document = recipe_file.load(str(recipes / "base.yaml"), [override])
    assert document.data[key] == expected


@pytest.mark.parametrize("override", ["seed", "=1", "a..b=1", "edges.builders.7.x=1", "seed.x=1", "a=!tag 1"])
def test_overrides_that_make_no_sense(recipes: Path, override: str) -> None:
    with pytest.raises(RecipeError, match="^--set"):
        recipe_file.load(str(recipes / "base.yaml"), [override])


def test_names_and_suggestions(tmp_path: Path) -> None:
    assert "demo" in recipe_file.recipe_names()
    with pytest.raises(RecipeError, match="did you mean 'demo'"):
        recipe_file.find("dmeo")
    with pytest.raises(RecipeError, match="no such recipe file"):
        recipe_file.find(str(tmp_path / "none.yaml"))
    with pytest.raises(RecipeError, match="no recipe"):
        recipe_file.find("../recipes/demo")


@pytest.mark.parametrize(("length", "allowed"), [(8, True), (9, False)])
def test_recipes_extend_each_other_eight_times_at_most(tmp_path: Path, length: int, allowed: bool) -> None:
    (tmp_path / "0.yaml").write_text("seed: 5\n")
    for number in range(1, length + 1):
        (tmp_path / f"{number}.yaml").write_text(f"extends: {number - 1}.yaml\n")
    last = str(tmp_path / f"{length}.yaml")
    if allowed:
        assert recipe_file.load(last).data["seed"] == 5
    else:
        with pytest.raises(RecipeError, match="a chain of at most 8"):
            recipe_file.load(last)

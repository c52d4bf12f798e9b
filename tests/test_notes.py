"""Notes: facts that travel as values and become sentences at the end."""

import string

import pytest

from hodge_pipeline.types.notes import WORDING, Note, Rank
from hodge_pipeline.types.text import counted


@pytest.mark.parametrize("kind", WORDING)
def test_each_kind_tells_all_that_it_is_given(kind: str) -> None:
    asked = {name for _, name, _, _ in string.Formatter().parse(WORDING[kind][1]) if name}
    sentence = str(Note(kind, 17, "seq-01 {x}"))
    assert ("17" in sentence) == ("count" in asked) and ("seq-01 {x}" in sentence) == ("detail" in asked)
    assert asked <= {"count", "detail"}


def test_an_unknown_kind_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="'frobnicated' is no kind of note"):
        Note("frobnicated")


def test_doubt_comes_before_what_only_informs() -> None:
    notes = [Note("solver", detail="a"), Note("parts", 2), Note("untestable", 3, "9"), Note("depth range", detail="a")]
    assert sorted(note.rank for note in notes) == [Rank.INPUT, Rank.DOUBT, Rank.LOOK, Rank.FACT]


def test_a_note_of_one_speaks_of_one() -> None:
    one, three = (str(Note("alone", count, f"20 frames ({names})")) for count, names in ((1, "7"), (3, "7, 8, 9")))
    assert one.startswith("1 of 20 frames (7) has no edge at all: its pose is not measured, in the files of poses too")
    assert three.startswith("3 of 20 frames (7, 8, 9) have no edge at all: their poses are not measured, in the files")
    assert "1 frame without a given pose is carried" in str(Note("carried", 1))
    assert counted(1, "edge") == "1 edge" and counted(0, "edge") == "0 edges"
    assert counted(2, "vertex is|vertices are") == "2 vertices are"

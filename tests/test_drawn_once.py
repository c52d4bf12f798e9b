"""Pictures that the tests of all workers have in common."""

from pathlib import Path

from conftest import made_once


def test_of_workers_that_draw_at_once_all_get_the_picture_of_the_first(tmp_path: Path) -> None:
    def slower() -> str:
        assert made_once(tmp_path, ("plot",), lambda: "first") == "first"
        return "second"

    assert made_once(tmp_path, ("plot",), slower) == made_once(tmp_path, ("plot",), slower) == "first"
    assert len(list(tmp_path.iterdir())) == 1

from __future__ import annotations

import re
from pathlib import Path

import pycolmap
import pytest

from colmap_data import disturbed, error_px, noisy

PAGE = Path(__file__).parent.parent / "docs/after-colmap.md"


def test_the_python_example_runs_as_it_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    model = noisy(tmp_path, database=True)
    (tmp_path / "sparse").mkdir()
    disturbed(model, tmp_path / "sparse/0")
    (tmp_path / "refined").mkdir()
    monkeypatch.chdir(tmp_path)
    exec(compile(example, str(PAGE), "exec"), {})
    assert error_px(tmp_path / "refined") <= 1.001 * error_px(model)
    assert pycolmap.Reconstruction(tmp_path / "refined").num_rigs() == pycolmap.Reconstruction(model).num_rigs()

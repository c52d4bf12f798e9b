"""The notebooks of docs/examples run as they are, in an empty folder, and what a run shows in a notebook."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat
import pytest
import rerun.notebook
from jupyter_client.manager import KernelManager
from nbclient import NotebookClient

import hodge_pipeline
from hodge_pipeline.cli.console import ProgressBars
from hodge_pipeline.errors import WorkspaceError
from hodge_pipeline.report.notebook import as_html
from hodge_pipeline.run_folder import Run
from synthetic import LIGHT, short_sequence  # noqa: F401 - a fixture

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"
NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))
LAST_WORDS = {
    "sequence": "Run('runs/notebook': 12 frames",
    "pose_graph": "[3, 23], [11, 34]]",
    "colmap_model": "refined - mean error",
    "open3d_script": "mm off",
}
"""What each notebook must come to."""
NEW = """
%reset -f
%cd {}
from hodge_pipeline.executors import local
local._cores = lambda: 0
"""
"""As of a new kernel; blocks run in it, since workers that start cost more than what the notebooks compute."""


def test_there_is_a_notebook_for_each_user() -> None:
    assert {path.stem for path in NOTEBOOKS} == {*LAST_WORDS}


@pytest.fixture(scope="module")
def kernel() -> Iterator[KernelManager]:
    """One for all notebooks, which keeps what they import: a start with all libraries costs seconds."""
    manager = KernelManager()
    manager.start_kernel()
    yield manager
    manager.shutdown_kernel(now=True)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_runs_as_it_is(path: Path, kernel: KernelManager, tmp_path: Path) -> None:
    notebook = nbformat.read(path, 4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "kept without outputs"
    for cells in ([nbformat.v4.new_code_cell(NEW.format(tmp_path))], notebook.cells):
        notebook.cells = cells
        NotebookClient(notebook, timeout=300, km=kernel).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    shown = "".join(output.get("text") or output.get("data", {}).get("text/plain", "") for output in outputs)
    assert LAST_WORDS[path.stem] in shown
    if path.stem == "sequence":
        widgets = [output for output in outputs if "application/vnd.jupyter.widget-view+json" in output.get("data", {})]
        assert widgets, "no bars were drawn in the notebook"
        assert any("<table>" in output.get("data", {}).get("text/html", "") for output in outputs)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, short_sequence: Path) -> Run:  # noqa: F811
    recipe = hodge_pipeline.load_recipe("demo", [*LIGHT, "fusion=[]", "recording.level=summary"])
    return hodge_pipeline.run(recipe, tmp_path_factory.mktemp("notebook") / "run", source=short_sequence)


def test_a_run_shows_verdict_picture_and_errors(run: Run) -> None:
    shown = run._repr_html_()
    assert shown is not None
    assert shown.startswith("<b>") and "data:image/jpeg;base64," in shown and "ATE" in shown
    assert dataclasses.replace(run, ending=None)._repr_html_() is None


def test_what_the_data_says_is_escaped(run: Run) -> None:
    rows = tuple(dataclasses.replace(row, name="<script>") for row in run.report.trajectories)
    shown = as_html(dataclasses.replace(run.report, trajectories=rows))
    assert "<script>" not in shown and "&lt;script&gt;" in shown


def test_the_viewer_gets_the_whole_recording(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rerun's own widget needs a browser; what it is told is kept here."""
    given: dict[str, Any] = {}

    def viewer(**options: Any) -> SimpleNamespace:
        given.update(options)
        monkeypatch.setattr(options["recording"], "log_file_from_path", lambda path: given.update(path=path))
        return SimpleNamespace()

    monkeypatch.setattr(rerun.notebook, "Viewer", viewer)
    run.show(800, 450)
    assert (given["width"], given["height"]) == (800, 450)
    assert given["path"] == run.folder / "recording.rrd"


def test_without_its_extra_or_a_recording_it_says_what_to_do(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun.notebook, "HAS_NOTEBOOK", False)
    with pytest.raises(WorkspaceError, match=r"pip install 'hodge-pipeline\[notebook\]'"):
        run.show()
    with pytest.raises(WorkspaceError, match="hodge record RUN"):
        dataclasses.replace(run, folder=run.folder / "stages").show()


def test_without_ipywidgets_a_notebook_gets_plain_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("hodge_pipeline.cli.console.find_spec", lambda name: None)
    with ProgressBars(verbose=True) as bars, bars.stage("clouds", 1) as advance:
        advance(1)
    assert "clouds: done" in capsys.readouterr().err

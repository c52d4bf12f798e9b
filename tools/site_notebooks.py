"""A hook of mkdocs: each notebook of docs/examples becomes a page, its cells in order."""

from __future__ import annotations

import json
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The files of the site, and a page for each notebook."""
    for notebook in sorted(Path(config.docs_dir).glob("examples/*.ipynb")):
        path = notebook.relative_to(config.docs_dir).with_suffix(".md").as_posix()
        files.append(File.generated(config, path, content=page(notebook)))
    return files


def page(notebook: Path) -> str:
    """The notebook as Markdown."""
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    parts = [_cell(cell["cell_type"], "".join(cell["source"])) for cell in cells]
    parts.insert(1, f"[Download this notebook]({notebook.name})")
    return "\n\n".join(parts) + "\n"


def _cell(kind: str, text: str) -> str:
    return text if kind == "markdown" else f"```python\n{text}\n```"

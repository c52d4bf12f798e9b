"""A plugin's package found as if it were installed."""

from __future__ import annotations

import tomllib
from pathlib import Path


def write_metadata(package: Path, folder: Path) -> None:
    """The metadata that pip would write of a package into a folder on the path."""
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    metadata = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in names.items()) for group, names in groups]
    (metadata / "entry_points.txt").write_text("\n".join(lines))

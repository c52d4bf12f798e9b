"""A plugin's package found as if it were installed."""

from __future__ import annotations

import os
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


def write_metadata(package: Path, folder: Path) -> None:
    """The metadata that pip would write of a package into a folder on the path."""
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    metadata = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{key} = {value}\n" for key, value in names.items()) for group, names in groups]
    (metadata / "entry_points.txt").write_text("\n".join(lines))


@contextmanager
def installed(*folders: Path) -> Iterator[None]:
    """Packages with their metadata found by this process and by those it starts; afterwards they were never there."""
    before = set(sys.modules)
    paths = [*map(str, folders), *filter(None, [os.environ.get("PYTHONPATH")])]
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PYTHONPATH", os.pathsep.join(paths))
            for folder in folders:
                patch.syspath_prepend(str(folder))
            _forget_entries()
            yield
    finally:
        _forget_entries()
        for name in set(sys.modules) - before:
            if Path(getattr(sys.modules[name], "__file__", None) or ".").parent in folders:
                del sys.modules[name]


def _forget_entries() -> None:
    from hodge_pipeline import registry

    registry._installed.cache_clear()
    registry._entries.cache_clear()

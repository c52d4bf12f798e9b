"""The site: it builds without a warning or a dead link, and a browser fetches nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hodge_pipeline

REPOSITORY = Path(__file__).resolve().parents[1]
FETCHED = r'<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)="((?:https?:)?//[^"]*)"'


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    built = subprocess.run(build, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    return out


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        assert re.findall(FETCHED, page.read_text("utf-8")) == [], page
    for style in site.rglob("*.css"):
        assert "url(http" not in style.read_text("utf-8"), style


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    page = (site / "api.html").read_text("utf-8")
    missing = [name for name in hodge_pipeline.__all__ if f'id="hodge_pipeline.{name}"' not in page]
    assert missing == []


def test_every_page_and_notebook_is_in_the_menu(site: Path) -> None:
    menu = (site / "index.html").read_text("utf-8")
    for page in (*(REPOSITORY / "docs").glob("*.md"), *(REPOSITORY / "docs/examples").glob("*.ipynb")):
        target = page.relative_to(REPOSITORY / "docs").with_suffix(".html").as_posix()
        assert page.name == "README.md" or f'href="{target}"' in menu, target

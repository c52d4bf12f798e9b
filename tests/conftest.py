"""Where the real data lies: `HODGE_DATA`, else `shared/data` beside the checkout. It is never part of the project."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, which says why
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.append(str(REPOSITORY))  # for benchmarks/, which is no part of the package


def find_data_dir() -> Path:
    """The folder with the real data sets, whether it exists or not."""
    return Path(os.environ.get("HODGE_DATA", REPOSITORY.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder with the real data sets; the test skips, with the reason, where it is absent."""
    path = find_data_dir()
    if not path.is_dir():
        pytest.skip(f"no real data at {path}: set HODGE_DATA to the folder that holds seven_scenes, tum, …")
    return path

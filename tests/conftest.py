"""Where the real data lies: `HODGE_DATA`, else `shared/data` beside the checkout. It is never part of the project."""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from hypothesis import settings

from plugin_metadata import write_metadata

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, which says why
settings.load_profile("ci")  # everywhere the same examples, and none has a deadline
REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.append(str(REPOSITORY))  # for benchmarks/, which is no part of the package
if find_spec("hodge_paper") is None:  # the plugin with the paper's solver: `make setup` installs it
    PLUGIN = REPOSITORY / "benchmarks" / "paper" / "method"
    sys.path += [str(PLUGIN), found := tempfile.mkdtemp(prefix="hodge-paper-")]
    atexit.register(shutil.rmtree, found)
    write_metadata(PLUGIN, Path(found))


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

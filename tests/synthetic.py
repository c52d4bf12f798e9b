"""Small rendered sequences for tests: import `tiny_sequence` into a test module and it is a fixture there."""

from __future__ import annotations

from pathlib import Path

import pytest

from hodge_pipeline.demo.sequence import DemoOptions, make_sequence

TINY = DemoOptions(frames=24, width=160, height=120)


@pytest.fixture(scope="session")
def tiny_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TUM folder of 24 small noisy frames, going 41 degrees round the room and back; about 1 s of CPU, once."""
    # A module that imports this fixture gets one of its own, so the folder is shared through the base directory.
    return make_sequence(tmp_path_factory.getbasetemp() / "tiny_sequence", TINY)

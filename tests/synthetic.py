"""Small rendered sequences for tests: import `tiny_sequence` or `short_sequence` and it is a fixture there."""

from __future__ import annotations

from pathlib import Path

import pytest

from hodge_pipeline.demo.sequence import DemoOptions, make_sequence

TINY = DemoOptions(frames=24, width=160, height=120)
SHORT = DemoOptions(frames=8, width=80, height=60, turns=0.03)
LIGHT = (
    "clouds.voxel_m=0.1", "executor.workers=0", "evaluation.tables=false", "acceptance.min_fitness=0.05",
    "start.min_fitness=0.05", "outer_iterations=1", "edges.max_edges_per_frame=4",
    "registration=gicp", "start.registration=gicp",
)  # fmt: skip
"""What makes a run of the short sequence cheap; its images are too small for a recipe's own options, and for
landmarks."""


@pytest.fixture(scope="session")
def tiny_sequence(shared_base: Path) -> Path:
    """A TUM folder of 24 small noisy frames, going 41 degrees round the room and back; about 1 s of CPU, once."""
    # A module that imports this fixture gets one of its own, and so does each worker: the folder is shared by all.
    return make_sequence(shared_base / "tiny_sequence", TINY)


@pytest.fixture(scope="session")
def short_sequence(shared_base: Path) -> Path:
    """A TUM folder of 8 frames of 80x60, for what only has to run: with `LIGHT` a run takes 2 s of CPU."""
    return make_sequence(shared_base / "short_sequence", SHORT)

"""A pose graph under review, for tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from diagnosis_graphs import measured, near_pairs, poses_on_a_ring, spoiled
from hodge_adapters.pose_graphs.g2o import write_g2o
from hodge_pipeline.review.session import Session
from hodge_pipeline.review.subject import open_for_review

VIEWS, REACH, PLANTED = 24, 3, (5, 40)
"""A ring of views, each joined to the next three; two of these edges have another motion."""


@pytest.fixture
def graph_file(tmp_path: Path) -> Path:
    poses = poses_on_a_ring(VIEWS)
    graph, _ = spoiled(measured(poses, near_pairs(VIEWS, REACH)), np.array(PLANTED))
    write_g2o(tmp_path / "ring.g2o", graph, poses)
    return tmp_path / "ring.g2o"


@pytest.fixture
def session(graph_file: Path) -> Iterator[Session]:
    opened = Session(open_for_review(graph_file), who="ada", now=lambda: "2026-01-01T00:00:00Z")
    opened.wait()
    yield opened
    opened.close()


def revision(session: Session) -> int:
    return session.decisions.revision

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis_graphs import every_pair_tried
from hodge_pipeline import se3
from hodge_pipeline.diagnosis import diagnosis
from hodge_pipeline.diagnosis.consensus import find_consensus
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.robust_poses import Solved
from hodge_pipeline.diagnosis.search import searched

PART = np.arange(50) < 15
ASIDE = se3.exp(np.array([[0.0, 0.0, 1.0, 4.0, 1.0, 0.0]]))[0]


@pytest.fixture(scope="module")
def solved() -> tuple[Evidence, Solved]:
    """A room in one piece, with the evidence for it."""
    kept: list[tuple[Evidence, Solved]] = []

    def watched(evidence: Evidence) -> Solved:
        kept.append((evidence, find_consensus(evidence)))
        return kept[0][1]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(diagnosis, "find_consensus", watched)
        diagnose(every_pair_tried(3)[0])
    assert np.ptp(kept[0][1].piece) == 0
    return kept[0]


@pytest.mark.parametrize("in_one_piece", [False, True])
def test_a_part_that_lies_elsewhere_is_laid_back(solved: tuple[Evidence, Solved], in_one_piece: bool) -> None:
    evidence, found = solved
    moved = np.where(PART[:, None, None], ASIDE @ found.poses, found.poses)
    i, j = evidence.graph.edges.T
    wrong = replace(found, poses=moved, piece=PART * int(not in_one_piece), used=found.used & (PART[i] == PART[j]))
    back = searched(evidence, wrong)
    assert np.ptp(back.piece) == 0
    relative = se3.inverse(back.poses[:1]) @ back.poses, se3.inverse(found.poses[:1]) @ found.poses
    assert np.linalg.norm((relative[0] - relative[1])[:, :3, 3], axis=1).max() < 0.3

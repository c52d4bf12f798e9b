from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diagnosis_graphs import every_pair_tried
from hodge_pipeline import se3
from hodge_pipeline.diagnosis import consensus
from hodge_pipeline.diagnosis.consensus import best_arrangement
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.placement import arrangement_log_evidence
from hodge_pipeline.diagnosis.robust_poses import Solved
from hodge_pipeline.diagnosis.scene_model import learn_scene_model
from hodge_pipeline.diagnosis.search import searched

PART = np.arange(50) < 15
ASIDE = se3.exp(np.array([[0.0, 0.0, 1.0, 4.0, 1.0, 0.0]]))[0]


@pytest.fixture(scope="module")
def solved() -> tuple[Evidence, Solved]:
    """A room in one piece, with the evidence for it."""
    kept: list[tuple[Evidence, Solved]] = []

    def watched(evidence: Evidence, start: Solved) -> Solved:
        found = best_arrangement(evidence, start)
        kept.append((evidence, found))
        return found

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(consensus, "best_arrangement", watched)
        diagnose(every_pair_tried(3)[0])
    assert np.ptp(kept[0][1].piece) == 0
    return kept[0]


def test_a_scene_is_worth_less_with_a_part_of_it_elsewhere_or_apart(solved: tuple[Evidence, Solved]) -> None:
    evidence, found = solved
    model = learn_scene_model(evidence, found)
    value = arrangement_log_evidence(evidence, found, model)
    moved = np.where(PART[:, None, None], ASIDE @ found.poses, found.poses)
    assert arrangement_log_evidence(evidence, replace(found, poses=moved), model) < value - 5
    apart = np.where(PART, 1, 0)
    assert arrangement_log_evidence(evidence, replace(found, piece=apart), model) < value - 5
    assert arrangement_log_evidence(evidence, replace(found, poses=moved, piece=apart), model) == pytest.approx(
        arrangement_log_evidence(evidence, replace(found, piece=apart), model)
    )


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

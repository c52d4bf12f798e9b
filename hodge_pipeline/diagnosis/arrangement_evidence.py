"""Log-evidence (nats) for a whole arrangement of views.

Views are merged greedily: each step merges the two sets whose relative placement has the largest log-evidence, and
counts it as one cut. So a hundred wrong edges that agree weigh little more than ten right ones, as they do when a
single set of views is moved. The log-evidence of each camera's orientation is added.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline.diagnosis.cuts import PlacementCriteria
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.scene_model import SceneModel
from hodge_pipeline.types import Bools, Floats, Ints


def arrangement_log_evidence(evidence: Evidence, poses: Floats, piece: Ints, models: Sequence[SceneModel]) -> float:
    """Log-evidence for poses (V, 4, 4) in pieces (V,), the mean over several scene models."""
    criteria = [PlacementCriteria.of(evidence, model, poses, piece) for model in models]
    return sum(_log_evidence(each, poses, piece) for each in criteria) / len(models)


def _log_evidence(criteria: PlacementCriteria, poses: Floats, piece: Ints) -> float:
    rotations, upright = poses[:, :3, :3], criteria.model.upright
    upright_evidence = float(upright.log_evidence(rotations, upright.world_up(rotations, piece)).sum())
    together = piece[:, None] == piece[None]
    np.fill_diagonal(together, False)
    layers = criteria.layers(np.eye(4)) * together
    return upright_evidence + _merged(criteria, (layers + layers.swapaxes(1, 2)) / 2, together)


def _merged(criteria: PlacementCriteria, sums: Floats, possible: Bools) -> float:
    """Log-evidence summed over greedy merges, the strongest of the `possible (V, V)` ones first; `sums (3, V, V)` of
    the layers between any two sets are added up on the way.
    """
    count, total = sums.shape[1], 0.0
    value = np.where(possible, criteria.log_evidence(sums), -np.inf)
    for _ in range(count - 1):
        first, second = divmod(int(np.argmax(value)), count)
        if np.isneginf(value[first, second]):
            break
        total += float(value[first, second])
        sums[:, first] += sums[:, second]
        sums[:, :, first] += sums[:, :, second]
        value[second] = value[:, second] = -np.inf
        merged = criteria.log_evidence(sums[:, first])
        value[first] = value[:, first] = np.where(np.isneginf(value[first]), -np.inf, merged)
    return total

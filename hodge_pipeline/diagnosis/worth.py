"""What a whole arrangement is worth, in nats.

Its views come together best first, each time the two sets between which most speaks for their placement, and each time
that counts as one cut: so a hundred wrong edges that agree weigh little more than ten right ones, as they do when a
single set of views is moved. How cameras are held counts for each view.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hodge_pipeline.diagnosis.cuts import Scene, scene_of
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.laws import Laws
from hodge_pipeline.types import Bools, Floats, Ints

FAIR_SHARE = 0.75


def worth(evidence: Evidence, poses: Floats, piece: Ints, laws: Sequence[Laws]) -> float:
    """The mean over several laws of what poses (V, 4, 4) in pieces (V,) are worth."""
    return sum(_worth(scene_of(evidence, law, poses, piece, FAIR_SHARE), poses, piece) for law in laws) / len(laws)


def _worth(scene: Scene, poses: Floats, piece: Ints) -> float:
    rotations, upright = poses[:, :3, :3], scene.laws.upright
    held = float(upright.nats(rotations, upright.world_up(rotations, piece)).sum())
    together = piece[:, None] == piece[None]
    np.fill_diagonal(together, False)
    layers = scene.layers(poses, poses) * together
    return held + _coming_together(scene, (layers + layers.swapaxes(1, 2)) / 2, together)


def _coming_together(scene: Scene, sums: Floats, possible: Bools) -> float:
    """The nats of the cuts by which views come together, the strongest of those that are possible (V, V) first;
    `sums (3, V, V)` of the layers between any two are added up on the way.
    """
    count, total = sums.shape[1], 0.0
    value = np.where(possible, scene.nats(sums), -np.inf)
    for _ in range(count - 1):
        first, second = divmod(int(np.argmax(value)), count)
        if np.isneginf(value[first, second]):
            break
        total += float(value[first, second])
        sums[:, first] += sums[:, second]
        sums[:, :, first] += sums[:, :, second]
        value[second] = value[:, second] = -np.inf
        value[first] = value[:, first] = np.where(np.isneginf(value[first]), -np.inf, scene.nats(sums[:, first]))
    return total

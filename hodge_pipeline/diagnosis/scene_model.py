"""A model of the scene fitted to a solution, by which other arrangements of the views are then judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.joining import Joining, learn_joining
from hodge_pipeline.diagnosis.robust_poses import Fit
from hodge_pipeline.diagnosis.upright import Upright, learn_upright
from hodge_pipeline.types import Floats, Ints

NEIGHBOURS = 12
"""Views of a group: few enough that nearly all groups are placed rightly."""


@dataclass(frozen=True)
class SceneModel:
    """The probability of an edge by the poses of its views, and the distribution of up in camera axes."""

    joining: Joining
    upright: Upright


def learn_scene_model(evidence: Evidence, found: Fit, before: SceneModel | None = None) -> SceneModel:
    """The model fitted to the poses of a solution and the edges it uses, started at `before`."""
    joined = np.zeros((evidence.vertex_count, evidence.vertex_count), bool)
    i, j = evidence.edges[found.used].T
    joined[i, j] = joined[j, i] = True
    joining = learn_joining(found.poses, found.component, joined, evidence.reach_m, before.joining if before else None)
    return SceneModel(joining, learn_upright(found.poses[:, :3, :3], found.component, _neighbours(evidence, found)))


def _neighbours(evidence: Evidence, found: Fit) -> Ints:
    """Groups (V,) of up to NEIGHBOURS views: each grows along the edges in use that are the likeliest to be right."""
    group = np.full(evidence.vertex_count, -1)
    tie = _tie(evidence, found)
    for seed in range(evidence.vertex_count):
        if group[seed] >= 0:
            continue
        members: list[int] = []
        view = seed
        while len(members) < NEIGHBOURS:
            group[view] = seed
            members.append(view)
            strongest = (tie[members] * (group < 0)).max(0)
            view = int(np.argmax(strongest))
            if strongest[view] <= 0:
                break
    return group


def _tie(evidence: Evidence, found: Fit) -> Floats:
    """How strongly each two views (V, V) are tied: by order and by cycles, 0 without an edge in use."""
    i, j = evidence.edges[found.used].T
    odds = (evidence.prior / (1 - evidence.prior) * evidence.support)[found.used]
    tie = np.zeros((evidence.vertex_count, evidence.vertex_count))
    np.maximum.at(tie, (i, j), odds + 1e-3)
    return np.asarray(np.maximum(tie, tie.T))

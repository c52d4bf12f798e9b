"""What a solution shows of its scene, and by what any other arrangement of the scene is then judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.joining import Joining, learn_joining
from hodge_pipeline.diagnosis.robust_poses import Fit
from hodge_pipeline.diagnosis.upright import Upright, learn_upright
from hodge_pipeline.types import Floats, Ints

NEIGHBOURS = 12
"""Views of a group that are laid together rightly nearly always."""


@dataclass(frozen=True)
class Laws:
    """How views are joined, by where they lie, and how cameras are held."""

    joining: Joining
    upright: Upright


def learned(evidence: Evidence, found: Fit, known: Laws | None = None) -> Laws:
    """The laws that a solution shows by its poses and the edges it uses; from `known` on."""
    joined = np.zeros((evidence.vertex_count, evidence.vertex_count), bool)
    i, j = evidence.edges[found.used].T
    joined[i, j] = joined[j, i] = True
    before = known.joining if known else None
    joining = learn_joining(found.poses, found.component, joined, evidence.reach_m, before)
    return Laws(joining, learn_upright(found.poses[:, :3, :3], found.component, _neighbours(evidence, found)))


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

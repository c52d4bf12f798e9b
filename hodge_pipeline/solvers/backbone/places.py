"""Loops of one place: one testimony, however many agree, since a place may be mistaken for another."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.types import Floats, Ints

PLACE = 4.0
"""Loops of which the steps between their ends vary less than so many loops do are of one place."""
STEPS_OF_PLACE, FEWEST_PLACES = 20, 50
"""Steps that a place has at the least, however large the errors of steps are; places that a path has, however small."""


def places_along(chain: Chain) -> Floats:
    """Where the ends of each loop (M, 2) lie along the chain, in places: of one place are loops both ends of which lie
    within 1.
    """
    own = np.median(np.einsum("mii->mi", chain.covariance), axis=0)
    steps = np.where(chain.bridged[:, None], 0.0, np.einsum("nii->ni", chain.step_covariance))
    longest = max(STEPS_OF_PLACE, chain.size / FEWEST_PLACES)
    along = np.clip((steps / own).mean(axis=1) / PLACE, 1 / longest, 1 / STEPS_OF_PLACE)
    return np.asarray(np.cumsum(along)[chain.ends])


def one_of_each_place(ends: Floats) -> Ints:
    """Rows of loops, ascending, whose `ends (M, 2)` are given in places: first those that have the most others near."""
    tree, free, out = cKDTree(ends), np.ones(len(ends), bool), []
    near = tree.query_ball_point(ends, 1.0, p=np.inf, return_length=True)
    for row in np.argsort(-near, kind="stable").tolist():
        if free[row]:
            out.append(row)
            free[tree.query_ball_point(ends[row], 1.0, p=np.inf)] = False
    return np.sort(np.array(out, np.int64))

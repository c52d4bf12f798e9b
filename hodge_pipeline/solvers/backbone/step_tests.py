"""Short cycles of a backbone: whether they test its steps, which loops agree."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.types import Bools, Floats, Ints

LOOPS_AT_A_STEP = 0.5
"""Loops per step beyond which the graph may be a lattice, or a room, in which no edge needs to be trusted."""
TESTED = 0.3
"""Share of the steps in short cycles that close, beyond which every edge is judged and none trusted. On graphs of rooms
.77 to .98 are, on those of places visited again 0 to .1, and as many as there are edges over two steps or three.
"""
LONGEST_CYCLE = 3
"""Most steps of a short cycle with one loop: cycles of several loops also close where all are wrong in one way."""
OF_STEPS = 3.0
"""Divides the median displacement and angle of steps: cycles of right edges close to less, others seldom do."""


def is_tested(chain: Chain) -> bool:
    """Whether short cycles of one loop that close pass over more than `TESTED` of the steps."""
    (low, high), poses = chain.ends.T, chain.poses
    short = np.flatnonzero(~chain.apart & (high - low <= LONGEST_CYCLE))
    closing = short[closes(chain.motion[short], chain.between(poses[low[short]], poses[high[short]]), gate(chain))]
    return bool((chain.over(chain.ends[closing]) > 0).sum() > TESTED * (chain.step_edge >= 0).sum())


def pairs_across(ends: Ints, steps: Bools) -> tuple[Ints, Ints]:
    """Pairs (K, 2) of loops with these ends (M, 2), few steps apart, whose lower ends lie on either side of one of the
    steps (n,) and whose upper ends have none between them, or the other way round; and the spans (K, 2) of the former.
    """
    pairs = cKDTree(ends).query_pairs(LONGEST_CYCLE, p=np.inf, output_type="ndarray")
    two = np.sort(ends[pairs], axis=1)
    across = np.diff(np.cumsum(steps)[two], axis=1)[:, 0]
    one = across.sum(axis=1) == 1
    return pairs[one], np.take_along_axis(two[one], across[one].argmax(axis=1)[:, None, None], axis=2)[..., 0]


def agreeing_loops(chain: Chain, among: Bools) -> int:
    """How many of these loops (M,) agree with a neighbour: their cycle with another one whose ends are at most a step
    away closes within the gate, or within χ² by the covariance of its edges.
    """
    rows, poses = np.flatnonzero(among), chain.poses
    low, high = chain.ends[rows].T
    keys, limits, out = low * chain.size + high, gate(chain), np.zeros(len(rows), bool)
    order, path = np.argsort(keys, kind="stable"), chain.path
    for down, up in ((0, 1), (1, 0), (1, 1), (1, -1)) if len(keys) else ():
        moved = low + down, high + up
        other = order[np.minimum(np.searchsorted(keys, moved[0] * chain.size + moved[1], sorter=order), len(keys) - 1)]
        fits = (low[other] == moved[0]) & (high[other] == moved[1])
        first = np.flatnonzero(fits & (path[low] == path[low[other]]) & (path[high] == path[high[other]]))
        second = other[first]
        before = chain.between(poses[low[first]], poses[low[second]])
        after = chain.between(poses[high[second]], poses[high[first]])
        ahead, motion = before @ chain.motion[rows[second]] @ after, chain.motion[rows[first]]
        spread = chain.covariance[rows[first]] + chain.covariance[rows[second]]
        spread = spread + (chain.step_covariance[low[second]] if down else 0.0)
        spread = spread + (chain.step_covariance[high[first] + max(up, 0)] if up else 0.0)
        chi2 = mahalanobis(chain.log(chain.between(motion, ahead)), spread)[0]
        closing = closes(motion, ahead, limits) | chain.stated & (chi2 < AS_STATED * len(chain.axes))
        out[first[closing]] = out[second[closing]] = True
    return int(out.sum())


AS_STATED = 3.0
"""χ² per axis of a cycle that closes: of right ones 4e-5 have more in space, 3 % in the plane."""


def gate(chain: Chain) -> tuple[float, float]:
    """The gate for closing errors of cycles of right edges: metres, radians."""
    return gate_of(chain.step[chain.step_edge >= 0])


def gate_of(steps: Floats) -> tuple[float, float]:
    """The gate by the motions (N, 4, 4) of all steps."""
    shift, turn = np.linalg.norm(steps[:, :3, 3], axis=1), se3.rotation_angle(steps)
    return float(np.median(shift)) / OF_STEPS, max(float(np.median(turn)), TURN_RAD) / OF_STEPS


TURN_RAD = 0.1
"""Least angle of a step that counts as usual, for backbones that go straight on."""


def closes(motion: Floats, other: Floats, limits: tuple[float, float], widened: Floats | float = 1.0) -> Bools:
    """Which motions (K, 4, 4) are within `limits` (metres, radians) times `widened` of the others."""
    left = se3.inverse(motion) @ other
    near = np.linalg.norm(left[:, :3, 3], axis=1) < limits[0] * widened
    return np.asarray(near & (se3.rotation_angle(left) < limits[1] * widened))

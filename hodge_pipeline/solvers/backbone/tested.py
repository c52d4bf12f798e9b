"""Which steps of a backbone short cycles test: where most are, cycles judge every edge better than trust does."""

from __future__ import annotations

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.types import Bools, Floats, Ints

LONGEST = 3
"""Steps of a cycle with one loop: cycles of several loops close too where these agree on a place that is wrong."""
OF_STEPS = 3.0
"""Of the usual displacement and angle of steps: a cycle of right edges closes to less, and one of places at random
seldom does.
"""


def tested_steps(chain: Chain, poses: Floats) -> Bools:
    """Steps (n,) that lie in a cycle with one loop that closes to less than a step."""
    out = np.zeros(chain.size, bool)
    if not len(chain.ends):
        return out
    same = chain.path[chain.ends[:, 0]] == chain.path[chain.ends[:, 1]]
    low, high = chain.ends.T
    short = np.flatnonzero(same & (high - low <= LONGEST))
    good = short[_closes(chain.motion[short], _between(poses, low[short], high[short]), _gate(chain))]
    for ahead in range(1, LONGEST + 1):
        rows = good[high[good] - low[good] >= ahead]
        out[low[rows] + ahead] = True
    return out


def tested_by_pairs(chain: Chain, poses: Floats) -> Bools:
    """Steps (n,) in cycles of two loops and the steps between neighbouring ends of them that close."""
    out = np.zeros(chain.size, bool)
    low, high = chain.ends.T
    keys = low * chain.size + high
    order, path, gate = np.argsort(keys, kind="stable"), chain.path, _gate(chain)
    for down, up in ((0, 1), (1, 0), (1, 1), (1, -1)) if len(keys) else ():
        moved = low + down, high + up
        at = np.minimum(np.searchsorted(keys, moved[0] * chain.size + moved[1], sorter=order), len(keys) - 1)
        other = order[at]
        fits = (low[other] == moved[0]) & (high[other] == moved[1])
        first = np.flatnonzero(fits & (path[low] == path[low[other]]) & (path[high] == path[high[other]]))
        second = other[first]
        before, after = _between(poses, low[first], low[second]), _between(poses, high[second], high[first])
        good = first[_closes(chain.motion[first], before @ chain.motion[second] @ after, gate)]
        if down:
            out[low[good] + 1] = True
        if up:
            out[high[good] + (1 if up > 0 else 0)] = True
    return out


def _gate(chain: Chain) -> tuple[float, float]:
    """Metres and radians to which cycles of right edges close."""
    inner = np.flatnonzero(chain.step_edge >= 0)
    shift = np.linalg.norm(chain.step[inner, :3, 3], axis=1)
    turn = np.linalg.norm(se3.so3_log(chain.step[inner, :3, :3]), axis=1)
    return float(np.median(shift)) / OF_STEPS, max(float(np.median(turn)), TURN_RAD) / OF_STEPS


TURN_RAD = 0.1
"""Where a backbone goes straight on, the angle that counts as a usual one."""


def _between(poses: Floats, a: Ints, b: Ints) -> Floats:
    return np.asarray(se3.inverse(poses[a]) @ poses[b])


def _closes(motion: Floats, other: Floats, gate: tuple[float, float]) -> Bools:
    left = se3.inverse(motion) @ other
    near = np.linalg.norm(left[:, :3, 3], axis=1) < gate[0]
    return np.asarray(near & (np.linalg.norm(se3.so3_log(left[:, :3, :3]), axis=1) < gate[1]))

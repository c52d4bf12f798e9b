"""What short cycles say of the steps of a backbone: which they test, and which they refute."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.chain import Chain, linear_forest, make_chain, sequential_edges
from hodge_pipeline.solvers.backbone.evidence import gaussian
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

TESTED = 0.3
"""Of the steps in short cycles that close: from there on every edge is judged, none trusted at first. On graphs of
rooms .77 to .98 are, on those of places visited again 0 to .1, and as many as there are edges over two steps or three.
"""
LONGEST = 3
"""Steps of a cycle with one loop: cycles of several loops close too where these agree on a place that is wrong."""
OF_STEPS = 3.0
"""Of the usual displacement and angle of steps: a cycle of right edges closes to less, and one of places at random
seldom does.
"""


def is_tested(chain: Chain) -> bool:
    """Whether short cycles test so many of the steps that none needs to be trusted."""
    return bool(tested_steps(chain, chain.poses).sum() > TESTED * (chain.step_edge >= 0).sum())


def tested_steps(chain: Chain, poses: Floats) -> Bools:
    """Steps (n,) that lie in a cycle with one loop that closes to less than a step."""
    out = np.zeros(chain.size, bool)
    short, closes = closing(chain, poses)
    low, high = chain.ends[short[closes]].T
    for ahead in range(1, LONGEST + 1):
        out[low[high - low >= ahead] + ahead] = True
    return out


def closing(chain: Chain, poses: Floats) -> tuple[Ints, Bools]:
    """The loops (K,) over few steps, and which of them close to less than a step."""
    low, high = chain.ends.T
    short = np.flatnonzero((chain.path[low] == chain.path[high]) & (high - low <= LONGEST))
    closes = _closes(chain.motion[short], _between(poses, low[short], high[short]), _gate(chain))
    return short, closes


def contradicted_from_afar(graph: ViewGraph, kept: Bools, *, by_pairs: bool = False) -> Bools:
    """Consecutive edges (E,) that are not kept, though no edge over few of them is kept which passes over them: where
    one was measured wrong, those that begin or end beside it tell. `by_pairs`: or two that do, one on either side, and
    whose other ends lie as near, where nothing is left out.
    """
    steps = linear_forest(graph.edges, graph.vertex_count, sequential_edges(graph))
    chain = make_chain(graph, steps)
    inner, out = chain.step_edge >= 0, np.zeros(graph.edge_count, bool)
    ends = chain.ends[kept[chain.loop_edge]]
    near = [ends[np.diff(ends, axis=1)[:, 0] <= LONGEST]]
    left_out = ~np.append(kept, True)[chain.step_edge]
    if by_pairs and len(ends):
        two = np.sort(ends[cKDTree(ends).query_pairs(LONGEST, p=np.inf, output_type="ndarray")], axis=1)
        low, high = np.diff(np.cumsum(left_out | ~inner)[two], axis=1)[:, 0].T
        near += [two[(low == 1) & (high == 0), :, 0], two[(low == 0) & (high == 1), :, 1]]
    at = np.flatnonzero(inner & left_out & (chain.over(np.concatenate(near)) == 0))
    out[chain.step_edge[at]] = True
    return out


@dataclass(frozen=True)
class PairCycles:
    """Cycles (C,) of two loops and the steps between neighbouring ends of them.

    - `loops (C, 2)`; `steps (C, 2)`: positions that the steps lead to, −1 for none; `near (C,)`: whether one closes to
      less than a step; `closes (C,)`: or within what its edges state.
    """

    loops: Ints
    steps: Ints
    near: Bools
    closes: Bools

    @classmethod
    def of(cls, chain: Chain, poses: Floats) -> PairCycles:
        """All of a chain, whose steps lead from pose to pose."""
        low, high = chain.ends.T
        keys, gate = low * chain.size + high, _gate(chain)
        order, path, found = np.argsort(keys, kind="stable"), chain.path, []
        for down, up in ((0, 1), (1, 0), (1, 1), (1, -1)) if len(keys) else ():
            moved = low + down, high + up
            at = np.minimum(np.searchsorted(keys, moved[0] * chain.size + moved[1], sorter=order), len(keys) - 1)
            other = order[at]
            fits = (low[other] == moved[0]) & (high[other] == moved[1])
            first = np.flatnonzero(fits & (path[low] == path[low[other]]) & (path[high] == path[high[other]]))
            second, none = other[first], np.full(len(first), -1)
            before, after = _between(poses, low[first], low[second]), _between(poses, high[second], high[first])
            ahead = before @ chain.motion[second] @ after
            steps = low[second] if down else none, high[first] + max(up, 0) if up else none
            spread = chain.covariance[first] + chain.covariance[second]
            for step in steps:
                spread = spread + np.where(step[:, None, None] < 0, 0.0, chain.step_covariance[step])
            chi2 = gaussian(chain.log(se3.inverse(chain.motion[first]) @ ahead), spread)[1]
            near = _closes(chain.motion[first], ahead, gate)
            closes = near | (chi2 < AS_STATED * len(chain.axes))
            found.append((np.stack([first, second], axis=1), np.stack(steps, axis=1), near, closes))
        none_found = np.zeros((0, 2), np.int64), np.zeros((0, 2), np.int64), np.zeros(0, bool), np.zeros(0, bool)
        return cls(*(np.concatenate(each) for each in zip(none_found, *found, strict=True)))

    def tested(self, size: int) -> Bools:
        """Steps (n,) in those that close to less than a step."""
        out = np.zeros(size + 1, bool)
        out[self.steps[self.near]] = True
        return out[:-1]

    def refuted(self, size: int) -> float:
        """The share of wrong steps among those that these cycles test: in none that closes, and alone in one or in two
        that do not though both loops are in others that do.
        """
        sound = np.bincount(self.loops[self.closes].ravel(), minlength=int(self.loops.max(initial=0)) + 1) > 0
        fails = ~self.closes & sound[self.loops].all(axis=1)
        worth = np.where((self.steps < 0).any(axis=1), 2, 1)
        closing, failing = np.zeros(size + 1), np.zeros(size + 1)
        np.add.at(closing, self.steps[self.closes], 1)
        np.add.at(failing, self.steps[fails], worth[fails, None])
        right, wrong = closing[:-1] > 0, (failing[:-1] >= 2) & (closing[:-1] == 0)
        return float(wrong.sum() / max((right | wrong).sum(), 1))


AS_STATED = 3.0
"""χ² to an axis of a cycle that closes as its edges state: of right ones 4e-5 have more in space, 3 % in the plane."""


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

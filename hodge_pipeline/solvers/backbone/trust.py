"""Whether a graph has a backbone that can be trusted, and the loops judged on it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline import se3
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.backbone.bridged import infer_bridged
from hodge_pipeline.solvers.backbone.chain import (
    Chain,
    linear_forest,
    make_chain,
    one_of_each_place,
    sequential_edges,
)
from hodge_pipeline.solvers.backbone.evidence import gaussian
from hodge_pipeline.solvers.backbone.inference import Inferred
from hodge_pipeline.solvers.backbone.polish import LOCAL
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph
from hodge_pipeline.types.text import counted

AUTO, SEQUENTIAL, NONE = "auto", "sequential", "none"
FEWEST_STEPS = 100
"""Of a backbone that is looked for: and of its paths on average: shorter sequences are fragments of rooms, whose
edges test each other."""
COVERED = 0.9
"""Of the vertices that consecutive edges must join, so that a sequence is a backbone."""
TESTED = 0.3
"""Of the steps in short cycles that close: from there on every edge is judged, none trusted at first. On graphs of
rooms .77 to .98 are, on those of places visited again 0 to .1, and as many as there are edges over two steps or three.
"""
LOOPS_AT_A_STEP = 0.5
"""From there on loops may make a lattice, or a room, in which no edge needs to be trusted."""
AGREEING = 0.05
"""Where loops are more than steps and no backbone confirms any, so large a share of the steps between loops that agree
with each other says that the backbone may be wrong: loops at random hardly agree.
"""
REFUTING = 0.5
"""Of the loops over few steps, that close: where fewer do, they are wrong, and not the odometry, which is right between
its wrong steps. In simulated lattices with wrong steps .76 and more do, of loops that take two places for one none.
"""
REFUTED = 0.03
"""Of the steps that cycles of two loops test: where so many are wrong, the loops are a lattice that judges itself. In
simulated lattices of 200 and 1000 poses a twentieth of whose edges is wrong .04 to .06, with a fifth .06 to .16; in
ring, ringCity, Manhattan and INTEL with 1000 wrong loops in groups of five or ten .027 at the most.
"""


@dataclass(frozen=True)
class Backbone:
    """The edges that are trusted and what they say of the others.

    - `steps`, `used (E,)`: edges of the backbone, and all that count: a step that does not is broken; `right (E,)`:
      the probability of each loop, NaN for steps; `chi2 (E,)`: of each loop at the poses that the others lead to.
    - `world_from_cam (V, 4, 4)`: each path begins at the identity where no loop ties it.
    - `doubted`: whether many loops agree with each other, and none with the backbone, which may be what is wrong; or
      cycles of them refute many of its steps.
    """

    chain: Chain
    found: Inferred
    steps: Bools
    used: Bools
    right: Floats
    chi2: Floats
    world_from_cam: Floats
    doubted: bool

    def weighted(self, graph: ViewGraph) -> ViewGraph:
        """The graph of the edges that count, with the information that their errors were found to have."""
        step, loop = self.found.scales.units(self.chain)
        width = np.ones((graph.edge_count, len(self.chain.axes)))
        width[self.chain.step_edge[self.chain.step_edge >= 0]] = step * LOCAL
        width[self.chain.loop_edge] = loop * self.found.loop_width[:, None]
        whole = np.ones((graph.edge_count, 6))
        whole[:, self.chain.axes] = width
        information = graph.information / (whole[:, :, None] * whole[:, None, :])
        return replace(graph, information=information).select(np.flatnonzero(self.used))

    def places(self, edges: Bools) -> int:
        """How many places these edges (E,) join: those of one place are one testimony, as `Chain.places` has it."""
        chain = self.found.scales.applied(self.chain)
        at = np.flatnonzero(chain.step_edge >= 0)
        ends = np.concatenate([chain.ends, np.stack([at - 1, at], axis=1)])
        chosen = edges[np.concatenate([chain.loop_edge, chain.step_edge[at]])]
        return len(one_of_each_place(replace(chain, ends=ends).places[chosen]))

    @property
    def note(self) -> str:
        """What was trusted and what that led to."""
        loops, used = len(self.chain.loop_edge), int(self.found.used.sum())
        trusted = f"{int(self.steps.sum())} consecutive edges are trusted as a backbone"
        if not self.found.confirmed:
            return f"{trusted}, {counted(loops, 'loop')} that nothing confirms: the poses are the backbone's"
        broken = int((self.steps & ~self.used).sum())
        said = f", {broken} of them called wrong by the loops over it" if broken else ""
        return f"{trusted}{said}, {used} of {loops} loops confirmed"


def find_backbone(graph: ViewGraph, trust: str = AUTO, *, anyway: bool = False) -> Backbone | None:
    """The backbone of a graph, None where it has none that should be trusted; `auto` takes none of a large lattice or
    of a room, in which loops suffice, unless it is asked for one of these `anyway`, and of these alone.

    `trust`: `auto` learns from the graph whether its consecutive edges are one; `sequential` trusts them, `none` no
    edge; any other word those edges whose `source` it is. Raises `GraphError` where no edge is meant.
    """
    if trust == NONE or not graph.edge_count:
        return None
    chosen = sequential_edges(graph) if trust in (AUTO, SEQUENTIAL) else _of_source(graph, trust)
    if trust == AUTO and (graph.priors is not None or chosen.sum() < max(FEWEST_STEPS, COVERED * graph.vertex_count)):
        return None
    if not chosen.any():
        raise GraphError("no edge joins consecutive vertices, so that there is no sequence to trust: use --trust none")
    steps = linear_forest(graph.edges, graph.vertex_count, chosen)
    chain = make_chain(graph, steps)
    if not len(chain.loop_edge):
        return None
    if trust == AUTO and steps.sum() < FEWEST_STEPS * len(np.unique(chain.path[chain.step_edge >= 0])):
        return None
    loops = len(chain.loop_edge)
    many_loops = loops > LOOPS_AT_A_STEP * steps.sum()
    if anyway and not many_loops:
        return None
    if trust == AUTO and many_loops and not anyway and is_tested(chain):
        return None
    always = chosen[chain.loop_edge] if trust not in (AUTO, SEQUENTIAL) else np.zeros(len(chain.loop_edge), bool)
    inferred = infer_bridged(chain, always, trust != AUTO or anyway or not many_loops)
    if inferred is None:
        return None
    chain, found = inferred
    doubted = trust == AUTO and not found.confirmed and loops > steps.sum()
    pairs = PairCycles.of(chain, chain.poses) if trust == AUTO and many_loops else None
    doubted = doubted and pairs is not None and bool(pairs.tested(chain.size).sum() > AGREEING * steps.sum())
    if doubted:
        closes = closing(chain, chain.poses)[1]
        doubted = bool(closes.sum() >= REFUTING * len(closes))
    doubted = doubted or (pairs is not None and pairs.refuted(chain.size) > REFUTED)
    return _backbone(graph, chain, found, steps, doubted)


def _of_source(graph: ViewGraph, source: str) -> Bools:
    chosen = np.array([source in word.split("+") for word in graph.source.tolist()], bool)
    if not chosen.any():
        known = ", ".join(sorted(set(graph.source.tolist())))
        raise GraphError(f"--trust {source}: no edge comes from it; the edges come from {known}")
    return chosen


def _backbone(graph: ViewGraph, chain: Chain, found: Inferred, steps: Bools, doubted: bool) -> Backbone:
    used, right, chi2 = steps.copy(), np.full(graph.edge_count, np.nan), np.full(graph.edge_count, np.nan)
    used[chain.loop_edge] = found.used
    used[chain.step_edge[chain.bridged & (chain.step_edge >= 0)]] = False
    probability = 1 / (1 + np.exp(-np.clip(found.judged.log_odds, -500, 500)))
    right[chain.loop_edge] = np.where(found.used, probability, np.minimum(probability, UNUSED))
    chi2[chain.loop_edge] = found.judged.chi2
    poses = np.empty((graph.vertex_count, 4, 4))
    poses[chain.order] = found.poses
    return Backbone(chain, found, steps, used, right, chi2, poses, doubted)


UNUSED = 0.49
"""The most probable that a loop which does not count is: too little speaks for it."""

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

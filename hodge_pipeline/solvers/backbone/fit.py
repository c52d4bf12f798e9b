"""Gauss–Newton on a chain with some of its loops: exact on all poses, at the cost of the loops' ends alone.

In the world frame the steps' residuals ρ and covariances C add up along a path, so that a run of steps between two ends
of loops is one edge (Σρ, ΣC), and the poses inside follow from those of its ends. Twists are in axes parallel to the
world's, about the pose itself, those of runs and loops about their later ends: far from the world's origin, a lever arm
to it would make every block of the normal equations ill-conditioned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS, SINGULAR, TOLERANCE
from hodge_pipeline.solvers.backbone.linear import Linear, cholesky, graph_of, inverse, linearise, loops_at
from hodge_pipeline.solvers.backbone.sparse import Factored, NormalEquations
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Bools, Floats, Ints


@dataclass(frozen=True)
class Reduced:
    """The graph of the ends of the active loops, joined by these loops and by runs of steps.

    - `ends (R,)`: positions, ascending; `runs (S, 2)`: rows of `ends`; `active (L,)`: rows of the chain's loops.
    - `network`: its edges are the runs and then the active loops.
    - `anchor (n,)`: the row of the end that each position follows, the one before it or else the next; `touched (n,)`:
      whether its path has one.
    """

    ends: Ints
    runs: Ints
    active: Ints
    network: NormalEquations
    anchor: Ints
    touched: Bools

    @classmethod
    def of(cls, chain: Chain, active: Ints) -> Reduced:
        """The graph of these loops (rows)."""
        ends = np.unique(chain.ends[active])
        after = np.flatnonzero(chain.path[ends[1:]] == chain.path[ends[:-1]])
        runs = np.stack([after, after + 1], axis=1)
        loops = np.searchsorted(ends, chain.ends[active])
        network = NormalEquations.of(np.concatenate([runs, loops]), len(ends))
        return cls(ends, runs, active, network, *_anchor(chain, ends))

    @property
    def of_runs(self) -> slice:
        """Rows of the network that are runs."""
        return slice(len(self.runs))

    @property
    def of_loops(self) -> slice:
        """Rows of the network that are loops."""
        return slice(len(self.runs), None)

    @cached_property
    def inside(self) -> tuple[Ints, Ints]:
        """Positions (K,) that the steps of runs lead to, and the run of each, ascending."""
        low, high = self.ends[self.runs].T
        run = np.repeat(np.arange(len(low)), high - low)
        return low[run] + 1 + np.arange(len(run)) - self.first[run], run

    @cached_property
    def first(self) -> Ints:
        """The first row (S,) of each run in `inside`."""
        length = self.ends[self.runs[:, 1]] - self.ends[self.runs[:, 0]]
        return np.asarray(np.cumsum(length) - length)


def _anchor(chain: Chain, ends: Ints) -> tuple[Ints, Bools]:
    """`Reduced.anchor` and `Reduced.touched`."""
    where = np.arange(chain.size)
    if not len(ends):
        return where, where < 0
    right = np.searchsorted(ends, where)
    left, right = np.maximum(right - 1, 0), np.minimum(right, len(ends) - 1)
    has_left = (chain.path[ends[left]] == chain.path) & (ends[left] <= where)
    return np.where(has_left, left, right), has_left | (chain.path[ends[right]] == chain.path)


def thinned(chain: Chain, rows: Ints) -> Reduced:
    """The graph of these loops, or of an evenly spread subset with at most `MOST_UNKNOWNS` in its dense part."""
    spread, count = rows[np.argsort(chain.ends[rows, 0], kind="stable")], min(len(rows), MOST_ACTIVE)
    while True:
        chosen = spread[np.linspace(0, len(spread) - 1, count).astype(np.int64)]
        reduced = Reduced.of(chain, np.sort(chosen))
        unknowns = (reduced.network.plan.size - reduced.network.plan.core) * len(chain.axes)
        if unknowns <= MOST_UNKNOWNS:
            return reduced
        count = round(THINNING * count * MOST_UNKNOWNS / unknowns)


MOST_UNKNOWNS = 1500
"""Unknowns of a dense matrix, which takes .5 CPU s to invert."""
MOST_ACTIVE = 2000
"""Active loops: between the ends of so many even a long path drifts by little. With 400, lattices are judged in three
fifths of the time, but of INTEL's 500 wrong loops in groups of ten 422 are kept; none with 1000.
"""
THINNING = 0.8
"""Factor on the number of loops that would leave `MOST_UNKNOWNS` if unknowns were proportional to loops. Without it a
drive of 20,000 poses and 1500 loops takes 14.4 CPU s for 12.6.
"""


@dataclass(frozen=True)
class Fit:
    """A reduced graph linearised at some poses; its edges are the runs and then the active loops."""

    reduced: Reduced
    linear: Linear

    @cached_property
    def steps(self) -> Floats:
        """The covariance (K, p, p) of each step of a run, about the run's later end."""
        chain, (at, run) = self.linear.chain, self.reduced.inside
        frame = self.linear.poses[at]
        frame[:, :3, 3] -= self.linear.poses[self.reduced.ends[self.reduced.runs[:, 1]][run], :3, 3]
        return chain.carried(frame, chain.step_covariance[at])

    @cached_property
    def runs(self) -> Floats:
        """The covariance (S, p, p) of each run, at its later end."""
        return np.add.reduceat(self.steps, self.reduced.first, axis=0) if len(self.reduced.first) else self.steps

    @cached_property
    def loops(self) -> tuple[Floats, Floats]:
        """Residuals (L, p) and covariances (L, p, p) of the active loops, at their later ends."""
        return loops_at(self.linear.chain, self.linear.poses, self.reduced.active)

    @cached_property
    def covariance(self) -> Floats:
        """Covariances (S + L, p, p) of the runs and the active loops."""
        return np.concatenate([self.runs, self.loops[1]])

    @cached_property
    def precision(self) -> Floats:
        """Information (S + L, p, p) of the runs and the active loops."""
        return inverse(self.covariance)

    @cached_property
    def residual(self) -> Floats:
        """Residuals (S + L, p) of the runs and the active loops, about their later ends."""
        linear, (low, high) = self.linear, self.reduced.ends[self.reduced.runs].T
        along = linear.shift(high) @ (linear.residual[high] - linear.residual[low])[..., None]
        return np.concatenate([along[..., 0], self.loops[0]])

    @cached_property
    def carry(self) -> Floats:
        """Matrices (S + L, p, p) that take twists from the first end of each edge to its second."""
        return self.linear.carry(*self.reduced.ends[self.reduced.network.edges].T)

    @cached_property
    def factor(self) -> Factored:
        """The factorised normal equations."""
        return self.reduced.network.factor(self.precision, self.carry)

    def force(self, pushed: Floats) -> Floats:
        """Minus half the gradient of χ² (R, p, c) by the ends, of residuals times precisions `pushed (S + L, p, c)`."""
        edges = self.reduced.network.edges
        out = np.zeros((len(self.reduced.ends), *pushed.shape[1:]))
        np.add.at(out, edges[:, 0], np.swapaxes(self.carry, 1, 2) @ pushed)
        np.add.at(out, edges[:, 1], -pushed)
        return out

    @cached_property
    def cost(self) -> float:
        """χ² of the chain and the active loops."""
        return float(np.einsum("mi,mij,mj->", self.residual, self.precision, self.residual))

    @cached_property
    def log_det(self) -> float:
        """The logarithm of the determinant of the covariance of all active loops' closing errors together."""
        return self.factor.log_det - float(np.linalg.slogdet(self.precision)[1].sum())

    @cached_property
    def step(self) -> tuple[Floats, float]:
        """The Gauss–Newton step (R, p) of the ends, each about itself, and the predicted decrease of χ²."""
        force = self.force(self.precision @ self.residual[..., None])
        at_ends = self.factor.solve(force)
        return at_ends[..., 0], float((at_ends * force).sum())

    @cached_property
    def least_residual(self) -> Floats:
        """Residuals (S + L, p) after this step, at the minimum of the linearised χ²."""
        first, second = self.reduced.network.edges.T
        move = self.step[0][..., None]
        return np.asarray(self.residual + (move[second] - self.carry @ move[first])[..., 0])

    def left_out(self, rows: slice) -> tuple[Floats, Floats]:
        """Leave-one-out residuals `V S⁻¹ r` (K, p) of these edges, at poses solved without each, and their covariances
        V (K, p, p); S is the covariance of an edge and r its least residual: V S⁻¹ makes what `optimised` leaves of the
        descent up to a million times larger, 0.04 mm of a loop to 90 m.
        """
        own = self.covariance[rows]
        there = _without(own, self.factor.across()[rows])
        return (there @ np.linalg.solve(own, self.least_residual[rows, :, None]))[..., 0], there

    def moves(self) -> tuple[Floats, float]:
        """The Gauss–Newton step (R, p) of the ends, about the world's origin, and the predicted decrease of χ²."""
        at_ends, won = self.step
        lever = self.linear.chain.lever(self.linear.poses[self.reduced.ends, :3, 3])
        return _to_origin(lever, at_ends), won

    def moved(self, move: Floats) -> Floats:
        """The poses (n, 4, 4) after motions `move (R, 4, 4)` of the ends, however large, from the left: the gap of a
        run is spread over its steps by their covariance, positions beyond the outermost ends follow them rigidly.
        """
        linear, (first, second), touched = self.linear, self.reduced.runs.T, self.reduced.touched
        chain = linear.chain
        out = self._bent(chain.log(chain.between(move[first], move[second])))
        out[~touched] = 0.0
        moved = chain.exp(out) @ linear.poses
        moved[touched] = move[self.reduced.anchor[touched]] @ moved[touched]
        return moved

    def _bent(self, gap: Floats) -> Floats:
        """The step (n, p) of each position relative to that of its anchor, for steps `gap (S, p)` of the second end of
        each run relative to its first; about the world's origin.
        """
        reduced, linear = self.reduced, self.linear
        (at, run), (begin, end) = reduced.inside, reduced.ends[reduced.runs].T
        out = linear.residual[reduced.ends[reduced.anchor]] - linear.residual
        gap = gap + linear.residual[end] - linear.residual[begin]
        pull = (self.precision[: len(gap)] @ linear.shift(end) @ gap[..., None])[..., 0]
        bent = np.zeros((len(at) + 1, gap.shape[1]))
        np.cumsum(np.einsum("kij,kj->ki", self.steps, pull[run]), axis=0, out=bent[1:])
        lever = linear.chain.lever(linear.poses[end, :3, 3])
        out[at] += _to_origin(lever[run], bent[1:] - bent[reduced.first[run]])
        return out


def _to_origin(lever: Floats, twists: Floats) -> Floats:
    """Twists (K, p) taken from other origins to the world's: see `Chain.lever`."""
    out = twists.copy()
    out[:, -lever.shape[1] :] -= np.einsum("kij,kj->ki", lever, twists[:, : lever.shape[2]])
    return out


LEAST_WON = 0.01
"""Decrease of χ² below which a step moves nothing by more than a tenth of its standard deviation."""
TORN = 10.0
"""χ² per component of the loops' residuals beyond which loops contradict each other and no poses make them fit."""


def optimised(fit: Fit, steps: int = MOST_ROUNDS) -> Fit:
    """The fit after up to `steps` of Gauss–Newton with halving, until the predicted decrease of χ² is below
    `LEAST_WON`, or below `TOLERANCE` of χ² where loops contradict each other. With four halvings a descent over 15,000
    poses that wrong loops had bent ended at four times the least χ².
    """
    torn = TORN * len(fit.reduced.active) * len(fit.linear.chain.axes)
    for _ in range(steps if len(fit.reduced.active) else 0):
        (moves, won), before = fit.moves(), fit.cost
        if won < (LEAST_WON if before < torn else TOLERANCE * before):
            break
        for _ in range(MOST_ROUNDS):
            with np.errstate(over="ignore", invalid="ignore"):  # far too long a step ends in no number, and is halved
                tried = replace(fit, linear=linearise(fit.linear.chain, fit.moved(fit.linear.chain.exp(moves))))
                is_better = tried.cost < before
            if is_better:
                fit = tried
                break
            moves = moves / 2
        if not fit.cost < before:
            break
    return fit


def from_rotations(bare: Fit) -> Linear:
    """The chain at the poses of its reduced graph, solved from chordal rotations, which need no start.

    `bare`: the fit at the chain's own poses, where the motions of runs are edges. In few steps, as loops that
    contradict each other may take hundreds.
    """
    chain, reduced, poses = bare.linear.chain, bare.reduced, bare.linear.poses[bare.reduced.ends]
    first, second = reduced.runs.T
    back = se3.inverse(poses[second])
    motion = np.concatenate([chain.between(poses[first], poses[second]), chain.motion[reduced.active]])
    back[:, :3, 3] = 0.0  # the covariances of runs lie along the world's axes
    covariance = np.concatenate([chain.carried(back, bare.runs), chain.covariance[reduced.active]])
    graph = graph_of(chain, len(poses), reduced.network.edges, motion, covariance)
    found = solve(graph, start=poses, max_iterations=MOST_ROUNDS)
    return linearise(chain, bare.moved(found.world_from_cam @ se3.inverse(poses)))


def _without(own: Floats, across: Floats) -> Floats:
    """Leave-one-out covariances `S (S − K)⁻¹ S` (M, p, p): S of the edges alone, K of the same motions by all edges."""
    factor = cholesky(own)
    inverse = np.linalg.inv(factor)
    values, vectors = np.linalg.eigh(inverse @ across @ np.swapaxes(inverse, 1, 2))
    left = np.maximum(1 - values, SINGULAR)  # less is of an edge that alone joins two parts
    wide = factor @ vectors
    return np.asarray((wide / left[:, None]) @ np.swapaxes(wide, 1, 2))

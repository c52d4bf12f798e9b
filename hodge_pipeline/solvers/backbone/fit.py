"""Gauss–Newton on a chain with some of its loops: exact on all poses, at the cost of the loops' ends alone.

In the world frame a step's residual ρ and covariance C add up along a path, so that a run of steps between two ends of
loops is one edge (Σρ, ΣC), and the poses inside follow from those of its ends. Loops, ends and what is solved for are
in axes parallel to the world's with the origin at the pose itself: far from the world's origin, its own lever arm would
make every block of the normal equations ill-conditioned.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.sparse import Factored, Network
from hodge_pipeline.types import Floats, Ints


@dataclass(frozen=True)
class Linear:
    """The chain at some poses, in world axes: sums over positions of the steps' residuals `residual (n, p)` and
    covariances `covariance (n, p, p)`; of each loop, at its later end, `loop_residual (M, p)` and `loop_covariance
    (M, p, p)`; `shift (n, p, p)` takes a twist from the world's origin to a pose's own.
    """

    poses: Floats
    residual: Floats
    covariance: Floats
    loop_residual: Floats
    loop_covariance: Floats
    shift: Floats

    def path(self, a: Ints, b: Ints, at: Ints | None = None) -> Floats:
        """The covariance (K, p, p) of the path between two positions of one path, in either order: in the axes of a
        third position, by default the second.
        """
        low, high = np.minimum(a, b), np.maximum(a, b)
        return shifted(self.covariance[high] - self.covariance[low], self.shift[b if at is None else at])

    def carry(self, a: Ints, b: Ints) -> Floats:
        """What takes twists (K, p, p) at one position's origin to another's."""
        out = np.broadcast_to(np.eye(self.shift.shape[-1]), (len(a), *self.shift.shape[1:])).copy()
        split = out.shape[-1] - (2 if out.shape[-1] == 3 else 3)
        out[:, split:, :split] = self.shift[b, split:, :split] - self.shift[a, split:, :split]
        return out


def shifted(covariance: Floats, shift: Floats) -> Floats:
    """Covariances (K, p, p) about the world's origin, in extended precision, in axes with another (K, p, p) there."""
    split = shift.shape[-1] - (2 if shift.shape[-1] == 3 else 3)
    lever = shift[:, split:, :split]
    turn, across = covariance[:, :split, :split], covariance[:, split:, :split]
    moved = across + lever @ turn
    out = np.empty(covariance.shape)
    out[:, :split, :split], out[:, split:, :split], out[:, :split, split:] = turn, moved, np.swapaxes(moved, 1, 2)
    far = lever @ np.swapaxes(across, 1, 2) + moved @ np.swapaxes(lever, 1, 2)
    out[:, split:, split:] = covariance[:, split:, split:] + far
    return out


def linearise(chain: Chain, poses: Floats) -> Linear:
    """The chain's sums at these poses (n, 4, 4)."""
    before = np.concatenate([poses[:1], poses[:-1]])
    inner = chain.inner[:, None]
    frame = chain.adjoint(poses)
    moved_origin = np.broadcast_to(np.eye(4), poses.shape).copy()
    moved_origin[:, :3, 3] = -poses[:, :3, 3]
    shift = chain.adjoint(moved_origin)
    left = chain.log(se3.inverse(chain.step) @ se3.inverse(before) @ poses)
    residual = np.where(inner, np.einsum("nij,nj->ni", frame, left), 0.0)
    covariance = frame @ chain.step_covariance @ np.swapaxes(frame, 1, 2)
    loop_residual, loop_covariance = loops_at(chain, poses)
    return Linear(
        poses,
        np.cumsum(residual, axis=0),
        np.cumsum(covariance, axis=0, dtype=np.longdouble),
        loop_residual,
        loop_covariance,
        shift,
    )


def loops_at(chain: Chain, poses: Floats) -> tuple[Floats, Floats]:
    """Residuals (M, p) and covariances (M, p, p) of the loops, in the world's directions at their later ends."""
    a, b = chain.ends.T
    turned = poses[b].copy()
    turned[:, :3, 3] = 0.0
    left = chain.log(se3.inverse(chain.motion) @ se3.inverse(poses[a]) @ poses[b])
    turned = chain.adjoint(turned)
    return np.einsum("nij,nj->ni", turned, left), turned @ chain.covariance @ np.swapaxes(turned, 1, 2)


ROUNDING = 1e-12
"""Of a diagonal of ones: what differences of long sums may have wrong."""


def scaled(covariance: Floats) -> tuple[Floats, Floats]:
    """Covariances (M, p, p) in units (M, p) that make their diagonals one, positive definite for certain."""
    unit = np.sqrt(np.maximum(np.einsum("mii->mi", covariance), np.finfo(float).tiny))
    ones = covariance / (unit[:, :, None] * unit[:, None, :])
    return 0.5 * (ones + np.swapaxes(ones, 1, 2)) + ROUNDING * np.eye(covariance.shape[-1]), unit


def inverse(covariance: Floats) -> Floats:
    """The inverses (M, p, p), symmetric."""
    ones, unit = scaled(covariance)
    found = np.linalg.inv(ones) / (unit[:, :, None] * unit[:, None, :])
    return np.asarray(0.5 * (found + np.swapaxes(found, 1, 2)))


@dataclass(frozen=True)
class Reduced:
    """The ends of the active loops and the runs of steps between them.

    - `ends (R,)`: positions, ascending; `runs (S, 2)`, `loops (L, 2)`: rows of it; `active (L,)`: rows of the loops.
    - `network`: of the runs and then the loops.
    """

    ends: Ints
    runs: Ints
    loops: Ints
    active: Ints
    network: Network

    @classmethod
    def of(cls, chain: Chain, active: Ints) -> Reduced:
        """The network of these loops."""
        ends = np.unique(chain.ends[active])
        after = np.flatnonzero(chain.path[ends[1:]] == chain.path[ends[:-1]])
        runs = np.stack([after, after + 1], axis=1)
        loops = np.searchsorted(ends, chain.ends[active])
        return cls(ends, runs, loops, active, Network.of(np.concatenate([runs, loops]), len(ends)))

    def precisions(self, linear: Linear) -> tuple[Floats, Floats]:
        """Of the runs (S, p, p) and the active loops (L, p, p)."""
        runs = linear.path(*self.ends[self.runs].T)
        return inverse(runs), inverse(linear.loop_covariance[self.active])

    def residuals(self, linear: Linear) -> tuple[Floats, Floats]:
        """Of the runs (S, p) and the active loops (L, p)."""
        low, high = self.ends[self.runs].T
        along = linear.shift[high] @ (linear.residual[high] - linear.residual[low])[..., None]
        return along[..., 0], linear.loop_residual[self.active]

    def carry(self, linear: Linear) -> Floats:
        """From the first end of each run and active loop to its second (S + L, p, p)."""
        return linear.carry(*self.ends[self.network.edges].T)

    def factor(self, linear: Linear) -> Factored:
        """The factorised normal equations."""
        return self.network.factor(np.concatenate(self.precisions(linear)), self.carry(linear))

    def force(self, linear: Linear, pushed: Floats) -> Floats:
        """Minus half the gradient (R, p, c) for residuals times precisions (S + L, p, c)."""
        out = np.zeros((len(self.ends), *pushed.shape[1:]))
        np.add.at(out, self.network.edges[:, 0], np.swapaxes(self.carry(linear), 1, 2) @ pushed)
        np.add.at(out, self.network.edges[:, 1], -pushed)
        return out

    def cost(self, linear: Linear) -> float:
        """χ² of the chain and the active loops."""
        residual, precision = np.concatenate(self.residuals(linear)), np.concatenate(self.precisions(linear))
        return float(np.einsum("mi,mij,mj->", residual, precision, residual))

    def moves(self, linear: Linear) -> Floats:
        """The Gauss–Newton move (R, p) of the ends, about the world's origin."""
        precision = np.concatenate(self.precisions(linear))
        residual = np.concatenate(self.residuals(linear))
        factored = self.network.factor(precision, self.carry(linear))
        at_ends = factored.solve(self.force(linear, precision @ residual[..., None]))
        return np.asarray((np.linalg.inv(linear.shift[self.ends]) @ at_ends)[..., 0])


def moved(chain: Chain, reduced: Reduced, linear: Linear, moves: Floats) -> Floats:
    """The poses (n, 4, 4) after a move (R, p) of the loops' ends: runs bend by their covariance, what lies beyond the
    outermost ends follows them rigidly.
    """
    count, ends = chain.size, reduced.ends
    where = np.arange(count)
    right = np.searchsorted(ends, where)
    left = np.maximum(right - 1, 0)
    right = np.minimum(right, len(ends) - 1)
    has_left = chain.path[ends[left]] == chain.path
    has_left &= ends[left] <= where
    has_right = (chain.path[ends[right]] == chain.path) & (ends[right] >= where)
    left, right = np.where(has_left, left, right), np.where(has_right, right, left)
    low, high = ends[left], ends[right]
    touched = has_left | has_right
    bent = has_left & has_right & (low < high)
    out = moves[left] - (linear.residual - linear.residual[low])
    out[~touched] = 0.0
    k = np.flatnonzero(bent)
    begin, end = ends[reduced.runs].T
    first, second = reduced.runs.T
    gap = moves[second] - moves[first] + linear.residual[end] - linear.residual[begin]
    pull = np.empty((len(ends), gap.shape[1], 1))
    pull[first] = inverse(linear.path(begin, end)) @ linear.shift[end] @ gap[..., None]
    back = 2 * np.eye(gap.shape[1]) - linear.shift[k]
    along = np.swapaxes(linear.carry(k, high[k]), 1, 2) @ pull[left[k]]
    out[k] += (back @ linear.path(low[k], k) @ along)[..., 0]
    return np.asarray(chain.exp(out) @ linear.poses)


def settled(chain: Chain, reduced: Reduced, poses: Floats, steps: int, tolerance: float) -> Linear:
    """The chain at the poses of least cost with the active loops, or after as many steps: until a step wins less than
    this share of the cost. A step that wins nothing is halved.
    """
    linear = linearise(chain, poses)
    if not len(reduced.active):
        return linear
    cost = reduced.cost(linear)
    for _ in range(steps):
        moves, before = reduced.moves(linear), cost
        for _ in range(HALVINGS):
            tried = linearise(chain, moved(chain, reduced, linear, moves))
            if (found := reduced.cost(tried)) < cost:
                linear, cost = tried, found
                break
            moves = moves / 2
        if not cost < (1 - tolerance) * before:
            break
    return linear


HALVINGS = 4


LEAST_LEFT = 1e-6


def without(own: Floats, across: Floats) -> Floats:
    """`S (S − K)⁻¹ S` for the covariances S of edges and K of the same motions with all edges, S among them."""
    ones, unit = scaled(own)
    factor = np.linalg.cholesky(ones) * unit[:, :, None]
    inverse = np.linalg.inv(factor)
    values, vectors = np.linalg.eigh(inverse @ across @ np.swapaxes(inverse, 1, 2))
    left = np.maximum(1 - values, LEAST_LEFT)
    wide = factor @ vectors
    return np.asarray((wide / left[:, None]) @ np.swapaxes(wide, 1, 2))


def without_run(reduced: Reduced, linear: Linear) -> tuple[Floats, Floats, Floats]:
    """The residual (S, p) of each run at poses solved without it, its covariance (S, p, p), and that part of it which
    is of these poses.
    """
    own = np.asarray(linear.path(*reduced.ends[reduced.runs].T), float)
    total = without(own, reduced.factor(linear).across()[: len(own)])
    ahead = np.linalg.solve(own, reduced.residuals(linear)[0][..., None])
    return (total @ ahead)[..., 0], total, total - own

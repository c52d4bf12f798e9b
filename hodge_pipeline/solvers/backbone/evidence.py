"""What speaks for a loop: the density of its residual if it is right, against that if it joins places at random; and
how large errors are, as factors on what the information of steps and loops states.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaln

from hodge_pipeline import se3
from hodge_pipeline.solvers.backbone.chain import MOST_OF_A_STEP, Chain
from hodge_pipeline.solvers.backbone.fit import linearise, root
from hodge_pipeline.types import Bools, Floats, Ints

PAIRS, FEWEST_PAIRS = 4000, 200
"""Random pairs of positions that say how far apart places lie; of fewer, any two are taken instead."""


@dataclass(frozen=True)
class Wrong:
    """The residual of a loop between two places at random: a Cauchy distribution of a shape (p, p) in axes that are
    parallel to the world's and begin at the loop's later end.

    `spread (B, p)` and `axes (B, p, p)`, in columns: the eigenvalues and eigenvectors of the shape, for places that are
    so many steps apart, in octaves; the last of any two.
    """

    spread: Floats
    axes: Floats

    @classmethod
    def of(cls, chain: Chain, poses: Floats) -> Wrong:
        """As the motions of the loops are between random positions of one path."""
        rng = np.random.default_rng(0)
        pairs = rng.integers(0, chain.size, (PAIRS, 2))
        shapes = [_shape(chain, poses, pairs[_on_one_path(chain, pairs)], rng)]
        for octave in reversed(range(int(np.log2(max(chain.size, 2))))):
            pairs[:, 1] = pairs[:, 0] + rng.integers(2**octave, 2 ** (octave + 1), PAIRS)
            near = pairs[_on_one_path(chain, pairs)]
            shapes.append(_shape(chain, poses, near, rng) if len(near) >= FEWEST_PAIRS else shapes[0])
        return cls(*np.linalg.eigh(np.stack(shapes[::-1])))

    def log_density(self, chain: Chain, rows: Ints, residual: Floats, covariance: Floats) -> Floats:
        """Of these loops (K,), with their residuals (K, p) and the covariances (K, p, p) that these have of right ones:
        along an axis in which places hardly differ a wrong loop is as far off as a right one.
        """
        a, b = chain.ends[rows].T
        apart, size = chain.path[a] != chain.path[b], residual.shape[1]
        octave = np.minimum(np.log2(np.maximum(b - a, 1)).astype(np.int64), len(self.spread) - 1)
        octave[apart] = len(self.spread) - 1
        along = np.swapaxes(self.axes, 1, 2)[octave]
        shape = np.maximum(self.spread[octave], ((along @ covariance) * along).sum(axis=2))
        squares = ((along @ residual[:, :, None])[..., 0] ** 2 / shape).sum(axis=1)
        squares[apart] = size  # how two paths lie is not known
        norm = gammaln((1 + size) / 2) - gammaln(0.5) - 0.5 * size * np.log(np.pi)
        return np.asarray(norm - 0.5 * np.log(shape).sum(axis=1) - 0.5 * (1 + size) * np.log1p(squares))


def _on_one_path(chain: Chain, pairs: Ints) -> Bools:
    """Pairs (K, 2) of positions, the second of which may lie beyond the last, of one path."""
    second = np.minimum(pairs[:, 1], chain.size - 1)
    return np.asarray((second == pairs[:, 1]) & (chain.path[pairs[:, 0]] == chain.path[second]))


def _shape(chain: Chain, poses: Floats, pairs: Ints, rng: np.random.Generator) -> Floats:
    """The spread (p, p) of the residuals of loops between other positions (K, 2)."""
    motion = chain.motion[rng.integers(0, len(chain.motion), len(pairs))]
    residual = parallel(chain, motion, poses[pairs[:, 0]], poses[pairs[:, 1]])
    moment, split = residual.T @ residual / max(len(residual), 1), turns(chain)
    shape = np.zeros_like(moment)
    shape[:split, :split], shape[split:, split:] = moment[:split, :split], moment[split:, split:]
    return shape


def turns(chain: Chain) -> int:
    """How many of a twist's free axes are rotations."""
    return 1 if len(chain.axes) == 3 else 3


def parallel(chain: Chain, motion: Floats, from_a: Floats, from_b: Floats) -> Floats:
    """Residuals (M, p) of motions between two poses, turned into the world's directions."""
    left = se3.log(se3.inverse(motion) @ se3.inverse(from_a) @ from_b).reshape(-1, 2, 3)
    return np.asarray(np.einsum("nij,nkj->nki", from_b[:, :3, :3], left).reshape(-1, 6)[:, chain.axes])


def gaussian(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """The log-density (M,) and χ² (M,) of residuals (M, p) with covariances (M, p, p)."""
    factor, white = root(covariance), np.empty_like(residual)
    for row in range(residual.shape[1]):  # by substitution, for all at once
        above = np.einsum("mk,mk->m", factor[:, row, :row], white[:, :row])
        white[:, row] = (residual[:, row] - above) / factor[:, row, row]
    chi2 = np.einsum("mi,mi->m", white, white)
    half_log = np.log(np.einsum("mii->mi", factor)).sum(axis=1) + 0.5 * residual.shape[1] * np.log(2 * np.pi)
    return -0.5 * chi2 - half_log, chi2


FREEDOM = 4.0
"""Of Student's distribution of right loops: their errors have heavier tails than a Gaussian's."""


def student(residual: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """The log-density (M,) of Student's distribution, and χ² (M,), of residuals (M, p) with shapes (M, p, p)."""
    log_density, chi2 = gaussian(residual, covariance)
    size = residual.shape[1]
    norm = gammaln((FREEDOM + size) / 2) - gammaln(FREEDOM / 2) - 0.5 * size * np.log(FREEDOM / 2)
    return log_density + 0.5 * chi2 + norm - 0.5 * (FREEDOM + size) * np.log1p(chi2 / FREEDOM), chi2


FOLD = np.log(4.0)
"""Standard deviation of a scale's logarithm beforehand: stated information is seldom wrong by more."""
FIRST, FINEST = np.log(4.0), np.log(2.0) / 3
"""Steps of the search, in the logarithm of a scale."""
MOST_RATIO = np.log(2.0)
"""Between the scales of rotation and of translation, where information is stated."""
UNITS, TRIED = np.log(4.0) * np.array([-8, -7, -6, -5, -4, -3, -2, 2, 3, 4, 5, 6, 7, 8]), 3
"""Logarithms of scales at which the search begins too, and how many of them, the likeliest. Where the information is
the identity that stands for unknown, rotation and translation have each a unit of their own then.
"""
FARTHEST = 3 * np.log(4.0)
"""Where information is stated, the search begins at such units alone: one that is nearer explains mistaken places."""
BY_CHANCE = float(np.log(100.0))
"""Nats by which loops must be likelier there."""
LEAST_SHARE = 1e-3
EVEN = np.full(2, 0.5)
DECOYS = 4
"""To a loop: with one, scales of loops differed up to eightfold from one draw to the next."""
FEWEST_LOOPS = 10
"""Within the paths that were joined, so that these alone are learned from: a bridge between paths allows for errors
much larger than those of steps, which were found to be a quarter of what they are then.
"""
MOST_LOOPS = 3000
"""That scales are learned from: more tell hardly more."""


@dataclass(frozen=True)
class Scales:
    """Factors on stated standard deviations: of steps and of loops, each of rotation and of translation."""

    step_turn: float = 1.0
    step_shift: float = 1.0
    loop_turn: float = 1.0
    loop_shift: float = 1.0

    def applied(self, chain: Chain) -> Chain:
        """The chain with the covariances that follow."""
        step, loop = self.units(chain)
        return replace(
            chain,
            step_covariance=np.where(
                chain.bridged[:, None, None], chain.step_covariance, chain.step_covariance * np.outer(step, step)
            ),
            covariance=chain.covariance * np.outer(loop, loop),
        )

    def surprise(self) -> float:
        """How improbable it is beforehand that steps err by so much more than stated, in nats."""
        return float(0.5 * (np.log(np.maximum([self.step_turn, self.step_shift], 1.0)) ** 2).sum() / FOLD**2)

    def units(self, chain: Chain) -> tuple[Floats, Floats]:
        """The factor on each free axis (p,), of steps and of loops."""
        split, size = turns(chain), len(chain.axes)
        pairs = (self.step_turn, self.step_shift), (self.loop_turn, self.loop_shift)
        step, loop = (np.repeat(pair, (split, size - split)) for pair in pairs)
        return step, loop


def learn_scales(chain: Chain, poses: Floats, wrong: Wrong) -> tuple[Scales, Floats]:
    """The scales at which the loops' residuals against the bare chain are likeliest, and the shares of right and wrong
    loops.

    Each loop counts by itself: that loops at one place err alike, and steps too, would else be taken for small errors.
    Decoys, motions of loops between other places, tell what as many would explain by chance at each scale.
    """
    path = chain.path * (chain.size + 1) + np.cumsum(chain.bridged & (chain.step_edge < 0))  # before they were joined
    if (path[chain.ends[:, 0]] == path[chain.ends[:, 1]]).sum() < FEWEST_LOOPS:
        path = chain.path
    alone = _learned_from(path, np.arange(len(chain.ends)), chain.ends)
    of_decoys = _learned_from(path, *decoys(chain, DECOYS))
    rows, ends = (np.concatenate(each) for each in zip(alone, of_decoys, strict=True))
    models = _Model.of(chain.with_loops(rows, ends), poses, wrong)
    own, elsewhere = models.select(slice(len(alone[0]))), models.select(slice(len(alone[0]), None))
    share = len(own.residual) / max(len(elsewhere.residual), 1)
    most = _most(chain)

    def value(logs: Floats, unit: float) -> float:
        logs = np.minimum(logs, most)
        ratios = np.array([logs[1] - logs[0], logs[3] - logs[2]])
        if (chain.stated or not unit) and (np.abs(ratios) > MOST_RATIO + 1e-9).any():
            return -np.inf
        prior = -0.5 * float((logs - unit) @ (logs - unit)) / FOLD**2
        return float(own.value(logs)[0] - share * max(elsewhere.value(logs)[0], 0.0) + prior)

    found = _likeliest(value, 0.0)
    units = UNITS[np.abs(UNITS) >= FARTHEST] if chain.stated else UNITS
    values = np.array([value(np.full(4, unit), unit) for unit in units])
    tried = np.argsort(-values, kind="stable")[:TRIED]
    tried = tried[values[tried] > found[1]] if chain.stated else tried
    others = [_likeliest(value, unit) for unit in units[tried].tolist()]
    other = max(others, key=lambda each: each[1], default=found)
    found = other if other[1] > found[1] + BY_CHANCE else found
    logs = np.minimum(found[0], most)
    return Scales(*map(float, np.exp(logs))), own.value(logs)[1]


def _most(chain: Chain) -> Floats:
    """The logarithms (4,) of the largest scales. An odometry errs by no more than a share of what it moves, step by
    step, unless it states more: else wrong loops that agree pass for right ones of an odometry that tells nothing.
    Where something is stated, the error of rotation is bound to that of translation: who goes straight hardly turns.
    """
    most = np.full(4, np.inf)
    steps = (chain.step_edge >= 0) & ~chain.bridged
    moved, spread = chain.log(chain.step[steps]), np.sqrt(np.einsum("mii->mi", chain.step_covariance[steps]))
    for kind, axes in enumerate((slice(0, turns(chain)), slice(turns(chain), None))):
        size, unit = np.linalg.norm(moved[:, axes]), np.linalg.norm(spread[:, axes])
        if size > 0 and unit > 0 and not (chain.stated and kind == 0):
            most[kind] = max(np.log(MOST_OF_A_STEP * size / unit), 0.0 if chain.stated else -np.inf)
    return most


def _likeliest(value: Callable[[Floats, float], float], unit: float) -> tuple[Floats, float]:
    """The logarithms (4,) of scales about that of a unit that have the largest value, and this."""
    best, width = np.full(4, unit), FIRST
    top = value(best, unit)
    while width >= FINEST:
        axis = still = 0
        while still < len(best):
            still += 1
            for sign in (-1, 1):
                tried = best.copy()
                tried[axis % len(best)] += sign * width
                if (found := value(tried, unit)) > top:
                    best, top, still = tried, found, 0
                    break
            axis += 1
        width /= 2
    return best, top


def decoys(chain: Chain, times: int) -> tuple[Ints, Ints]:
    """Each loop (K,), so many times, and two other places (K, 2) of one path, at random."""
    rng = np.random.default_rng(1)
    loop = np.repeat(np.arange(len(chain.loop_edge)), times)
    first = rng.integers(0, chain.size, len(loop))
    begin = np.searchsorted(chain.path, chain.path[first])
    length = np.searchsorted(chain.path, chain.path[first], side="right") - begin
    second = begin + np.minimum((rng.random(len(loop)) * length).astype(np.int64), length - 1)
    return loop, np.sort(np.stack([first, second], axis=1), axis=1)


def _learned_from(path: Ints, loop: Ints, ends: Ints) -> tuple[Ints, Ints]:
    """Those of the loops within a path and their ends that scales are learned from."""
    rows = np.flatnonzero(path[ends[:, 0]] == path[ends[:, 1]])
    if len(rows) > MOST_LOOPS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MOST_LOOPS, replace=False))
    return loop[rows], ends[rows]


@dataclass(frozen=True)
class _Model:
    """Residuals (M, p) of loops, with the covariances of their paths and their own as parts (3, M, p, p): of rotation,
    of translation, and of both together.
    """

    chain: Chain
    wrong: Wrong
    residual: Floats
    fixed: Floats
    path: Floats
    own: Floats

    @classmethod
    def of(cls, chain: Chain, poses: Floats, wrong: Wrong) -> _Model:
        """Of all loops of a chain."""
        linear, parts = linearise(chain, poses), []
        for step in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
            part = replace(linear, chain=Scales(*step, *step).applied(chain))
            parts.append((part.path(*chain.ends.T), part.loops[1]))
        path, own = (np.stack(each) for each in zip(*parts, strict=True))
        fixed, path, own = path[0], path[1:] - path[0], own[1:]
        for parted in (path, own):
            parted[2] -= parted[0] + parted[1]
        return cls(chain, wrong, linear.loops[0], fixed, path, own)

    def select(self, rows: slice) -> _Model:
        """That of these loops."""
        chosen = self.chain.with_loops(np.arange(len(self.residual))[rows], self.chain.ends[rows])
        parts = self.residual[rows], self.fixed[rows], self.path[:, rows], self.own[:, rows]
        return _Model(chosen, self.wrong, *parts)

    def value(self, logs: Floats) -> tuple[float, Floats]:
        """The log-likelihood of scales, against all loops being wrong, and the shares of right and wrong loops."""
        if not len(self.residual):
            return 0.0, EVEN
        turn, shift, own_turn, own_shift = np.exp(logs)
        covariance = self.fixed + _weighed(self.path, turn, shift) + _weighed(self.own, own_turn, own_shift)
        rows = np.arange(len(self.residual))
        away = self.wrong.log_density(self.chain, rows, self.residual, covariance)
        factor = student(self.residual, covariance)[0] - away
        shares, likelihood = mixture(np.stack([factor, np.zeros_like(factor)]))
        return likelihood, shares


def _weighed(parts: Floats, turn: float, shift: float) -> Floats:
    return np.asarray(turn**2 * parts[0] + shift**2 * parts[1] + turn * shift * parts[2])


def mixture(log_densities: Floats) -> tuple[Floats, float]:
    """The shares (k,) of classes with these log-densities (k, M) that are likeliest, and the log-likelihood."""
    shares, top = np.full(len(log_densities), 1 / len(log_densities)), log_densities.max(axis=0)
    density = np.exp(log_densities - top)
    for _ in range(30):
        total = shares @ density
        weight = shares * (density @ (1 / total)) + 0.5
        shares = np.maximum(weight / weight.sum(), LEAST_SHARE)
        shares /= shares.sum()
    return shares, float((np.log(total) + top).sum())

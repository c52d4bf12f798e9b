"""By how much errors are larger than stated: learned from what the loops of a chain close to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from hodge_pipeline.solvers.backbone.breaks import Testimony
from hodge_pipeline.solvers.backbone.chain import MOST_OF_A_STEP, Chain
from hodge_pipeline.solvers.backbone.evidence import EVEN, Wrong, WrongLoops, mixture, student
from hodge_pipeline.solvers.backbone.fit import linearise
from hodge_pipeline.types import Floats, Ints

FOLD = np.log(4.0)
"""Standard deviation of a scale's logarithm beforehand: stated information is seldom wrong by more."""
FIRST, FINEST = np.log(4.0), np.log(2.0) / 2
"""Steps of the search, in the logarithm of a scale."""
MOST_RATIO = np.log(2.0)
"""Between the scales of rotation and of translation, where information is stated."""
UNITS, TRIED = np.log(4.0) * np.array([-8, -7, -6, -5, -4, -3, -2, 2, 3, 4, 5, 6, 7, 8]), 3
"""Logarithms of scales at which the search begins too, and how many of them, the likeliest. Where the information is
the identity that stands for unknown, rotation and translation have each a unit of their own then.
"""
FARTHEST = 3 * np.log(4.0)
"""Where information is stated, the search begins at such units alone: one that is nearer explains mistaken places."""
LIKELIER_BY = float(np.log(100.0))
"""Nats by which loops must be likelier there."""
DECOYS = 4
"""To a loop: with one, scales of loops differed up to eightfold from one draw to the next."""
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
        split, size = chain.turns, len(chain.axes)
        pairs = (self.step_turn, self.step_shift), (self.loop_turn, self.loop_shift)
        step, loop = (np.repeat(pair, (split, size - split)) for pair in pairs)
        return step, loop


def learn_scales(chain: Chain, wrong: Wrong) -> tuple[Scales, Floats]:
    """The scales at which the loops' residuals against the bare chain are likeliest, and the shares of right and wrong
    loops.

    Each loop counts by itself: that loops at one place err alike, and steps too, would else be taken for small errors.
    Decoys, motions of loops between other places, tell what as many would explain by chance at each scale. Of loops
    between two paths, which may be joined, each is held against the one beside it.
    """
    if chain.joins.any():  # as before, since beside what bridges allow for rounding hides how little steps err
        chain = chain.parted()
    poses = chain.poses
    alone = _within(chain, np.arange(len(chain.ends)), chain.ends)
    of_decoys = _within(chain, *decoys(chain, DECOYS))
    rows, ends = (np.concatenate(each) for each in zip(alone, of_decoys, strict=True))
    models = _Model.within(chain.with_loops(rows, ends), poses, wrong)
    own, elsewhere = models.select(slice(len(alone[0]))), models.select(slice(len(alone[0]), None))
    both = [(own, elsewhere)]
    one, near = _neighbours(chain)
    if len(one):
        drawn = np.random.default_rng(2).integers(0, len(chain.ends), DECOYS * len(one))
        by_chance = _Model.beside(chain, poses, wrong, np.repeat(one, DECOYS), np.repeat(near, DECOYS), drawn)
        both.append((_Model.beside(chain, poses, wrong, one, near), by_chance))
    most = _most(chain)

    def value(logs: Floats, unit: float) -> float:
        logs = np.minimum(logs, most)
        ratios = np.array([logs[1] - logs[0], logs[3] - logs[2]])
        if (chain.stated or not unit) and (np.abs(ratios) > MOST_RATIO + 1e-9).any():
            return -np.inf
        prior = -0.5 * float((logs - unit) @ (logs - unit) / FOLD**2)
        return prior + sum(_beyond_chance(logs, *each) for each in both)

    found = _likeliest(value, 0.0)
    units = UNITS[np.abs(UNITS) >= FARTHEST] if chain.stated else UNITS
    values = np.array([value(np.full(4, unit), unit) for unit in units])
    tried = np.argsort(-values, kind="stable")[:TRIED]
    tried = tried[values[tried] > found[1]] if chain.stated else tried
    others = [_likeliest(value, unit) for unit in units[tried].tolist()]
    other = max(others, key=lambda each: each[1], default=found)
    found = other if other[1] > found[1] + LIKELIER_BY else found
    logs = np.minimum(found[0], most)
    return Scales(*map(float, np.exp(logs))), own.value(logs)[1]


def _beyond_chance(logs: Floats, own: _Model, elsewhere: _Model) -> float:
    """The log-likelihood of scales beyond what decoys give as many cycles."""
    share = len(own.residual) / max(len(elsewhere.residual), 1)
    return float(own.value(logs)[0] - share * max(elsewhere.value(logs)[0], 0.0))


def _neighbours(chain: Chain) -> tuple[Ints, Ints]:
    """Loops (K,) between two paths, and for each that loop between them whose ends are nearest to its own."""
    pairs = chain.path[chain.ends]
    rows = _some(np.flatnonzero(np.not_equal(*pairs.T)))
    if len(rows) < 2:
        return rows[:0], rows[:0]
    near = cKDTree(chain.ends[rows]).query(chain.ends[rows], k=2, p=np.inf)[1]
    other = rows[np.where(near[:, 0] == np.arange(len(rows)), near[:, 1], near[:, 0])]
    same = (pairs[rows] == pairs[other]).all(axis=1)
    return rows[same], other[same]


def _most(chain: Chain) -> Floats:
    """The logarithms (4,) of the largest scales. An odometry errs by no more than a share of what it moves, step by
    step, unless it states more: else wrong loops that agree pass for right ones of an odometry that tells nothing.
    Where something is stated, the error of rotation is bound to that of translation: who goes straight hardly turns.
    """
    most = np.full(4, np.inf)
    steps = (chain.step_edge >= 0) & ~chain.bridged
    moved, spread = chain.log(chain.step[steps]), np.sqrt(np.einsum("mii->mi", chain.step_covariance[steps]))
    for kind, axes in enumerate((slice(0, chain.turns), slice(chain.turns, None))):
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


def _within(chain: Chain, loop: Ints, ends: Ints) -> tuple[Ints, Ints]:
    """Those of the loops within a path and their ends that scales are learned from."""
    rows = _some(np.flatnonzero(np.equal(*chain.path[ends].T)))
    return loop[rows], ends[rows]


def _some(rows: Ints) -> Ints:
    return (
        rows if len(rows) <= MOST_LOOPS else np.sort(np.random.default_rng(0).choice(rows, MOST_LOOPS, replace=False))
    )


@dataclass(frozen=True)
class _Model:
    """Residuals (M, p) of cycles of one loop or two, with the covariances of their paths and of their loops as parts
    (3, M, p, p): of rotation, of translation, and of both together; `fixed (M, p, p)`: what no scale changes; `away`:
    where the loops lead if they are wrong.
    """

    away: WrongLoops
    residual: Floats
    fixed: Floats
    path: Floats
    own: Floats

    @classmethod
    def of(
        cls,
        chain: Chain,
        wrong: Wrong,
        rows: Ints,
        residual: Floats,
        parted: Callable[[Chain], tuple[Floats, Floats]],
    ) -> _Model:
        """`rows (M,)`: the loops of the chain whose cycles these are; `parted` gives the covariances of paths and loops
        where the chain has some errors.
        """
        kinds = (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)
        parts = [parted(Scales(*kind, *kind).applied(chain)) for kind in kinds]
        path, own = (np.stack(each) for each in zip(*parts, strict=True))
        fixed, path, own = path[0], path[1:] - path[0], own[1:]
        for each in (path, own):
            each[2] -= each[0] + each[1]
        return cls(wrong.at(chain, rows, residual), residual, fixed, path, own)

    @classmethod
    def within(cls, chain: Chain, poses: Floats, wrong: Wrong) -> _Model:
        """Of all loops of a chain and the path between the ends of each."""
        linear = linearise(chain, poses)

        def parted(scaled: Chain) -> tuple[Floats, Floats]:
            part = replace(linear, chain=scaled)
            return part.path(*chain.ends.T), part.loops[1]

        return cls.of(chain, wrong, np.arange(len(chain.ends)), linear.loops[0], parted)

    @classmethod
    def beside(
        cls, chain: Chain, poses: Floats, wrong: Wrong, one: Ints, other: Ints, drawn: Ints | None = None
    ) -> _Model:
        """Of loops `one (M,)` of a chain beside `other (M,)` ones: of the paths between their lower ends and between
        their upper ends. `drawn (M,)`: loops whose motions stand in place of the others'.
        """
        motions = np.concatenate([one, other if drawn is None else drawn])
        chain = chain.with_loops(motions, chain.ends[np.concatenate([one, other])])
        first, second = np.arange(2 * len(one)).reshape(2, -1)
        linear, none = linearise(chain, poses), np.zeros(len(motions))

        def told(scaled: Chain) -> tuple[Floats, Floats]:
            return Testimony.of(replace(linear, chain=scaled), none).against(second, first)

        def parted(scaled: Chain) -> tuple[Floats, Floats]:
            path = told(replace(scaled, covariance=0 * scaled.covariance))[1]
            return path, told(scaled)[1] - path

        return cls.of(chain, wrong, first, told(chain)[0], parted)

    def select(self, rows: slice) -> _Model:
        """That of these cycles."""
        away = WrongLoops(self.away.along[rows], self.away.spread[rows], self.away.squared[rows], self.away.apart[rows])
        return _Model(away, self.residual[rows], self.fixed[rows], self.path[:, rows], self.own[:, rows])

    def value(self, logs: Floats) -> tuple[float, Floats]:
        """The log-likelihood of scales, against all loops being wrong, and the shares of right and wrong loops."""
        if not len(self.residual):
            return 0.0, EVEN
        turn, shift, own_turn, own_shift = np.exp(logs)
        covariance = self.fixed + _weighed(self.path, turn, shift) + _weighed(self.own, own_turn, own_shift)
        factor = student(self.residual, covariance)[0] - self.away.log_density(covariance)
        shares, likelihood = mixture(factor)
        return likelihood, shares


def _weighed(parts: Floats, turn: float, shift: float) -> Floats:
    return np.asarray(turn**2 * parts[0] + shift**2 * parts[1] + turn * shift * parts[2])

"""Scales of stated errors, learned from the closing errors of a chain's loops, and anew from what a solution leaves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import astuple, dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from hodge_pipeline.solvers.backbone.chain import Chain
from hodge_pipeline.solvers.backbone.credible import MOST_OF_A_STEP
from hodge_pipeline.solvers.backbone.evidence import (
    BY_CHANCE,
    OutlierModel,
    OutlierResiduals,
    mahalanobis,
    mixture,
    student_log_density,
)
from hodge_pipeline.solvers.backbone.fit import Fit
from hodge_pipeline.solvers.backbone.levels import FEWEST, MOST_TRIED
from hodge_pipeline.solvers.backbone.linear import Linear, linearise
from hodge_pipeline.solvers.backbone.pairwise import PairwiseConsistency
from hodge_pipeline.types import Floats, Ints

FOLD = np.log(4.0)
"""Prior standard deviation of the logarithm of a scale: stated information is seldom wrong by more. The search begins
with steps so long, from starts so far apart, and ends with a quarter of it.
"""
MOST_RATIO = FOLD / 2 + 1e-9
"""Largest log-ratio of the scales of rotation and of translation, where information is stated; two scales farther apart
differ much. Learned scales are often two last steps of the search apart, of which rounding must not decide: to count
them as different takes RobotCar's 2438 loops from 2.3 to 3.6 CPU s, and from 2.76 to 2.63 m.
"""
DRIFTING = 1.5 * FOLD
"""The same of the scales of steps whose turns err for long in one way. Allowed to all graphs, and to loops as well, it
keeps 1392 wrong loops of `alike` for 38, and a factor of four 391: turns explain mistaken places.
"""
UNITS = FOLD * np.array([-8, -7, -6, -5, -4, -3, -2, 2, 3, 4, 5, 6, 7, 8])
"""Further starts of the search, logarithms of a common scale, of which the likeliest are searched. From them the scales
of rotation and translation are independent where the information is the identity, for unknown.
"""
DECOYS = 4
"""Decoys per loop: with one, scales of loops differed up to eightfold from one draw to the next."""
SURPRISING = 2.5
"""Learned scale of steps that tells something: right loops of 288 walks that err as stated ask for up to 2."""
MOST_LOOPS = 3000
"""Loops that scales are learned from: more hardly change them."""


@dataclass(frozen=True)
class Scales:
    """Factors on stated standard deviations: of steps and of loops, each of rotation and of translation."""

    step_turn: float = 1.0
    step_shift: float = 1.0
    loop_turn: float = 1.0
    loop_shift: float = 1.0

    def applied(self, chain: Chain) -> Chain:
        """The chain with scaled covariances, but for bridges; those of units are then of both ends."""
        step, loop = self.units(chain)
        of_steps, of_loops = chain.step_covariance * np.outer(step, step), chain.covariance * np.outer(loop, loop)
        if chain.unit:
            of_steps = chain.of_both_ends(chain.step, of_steps)
            of_loops = chain.of_both_ends(chain.motion, of_loops)
        of_steps = np.where(chain.bridged[:, None, None], chain.step_covariance, of_steps)
        return replace(chain, step_covariance=of_steps, covariance=of_loops, unit=False)

    def times(self, factor: float) -> Scales:
        """All of these scales times a factor."""
        return Scales(*(factor * each for each in astuple(self)))

    @property
    def at_most_stated(self) -> Scales:
        """Those of these scales that are below 1, the others 1."""
        return Scales(*(min(each, 1.0) for each in astuple(self)))

    @property
    def of_steps(self) -> float:
        """The larger scale of steps."""
        return max(self.step_turn, self.step_shift)

    @property
    def steps_surprise(self) -> bool:
        """Whether steps err by over `SURPRISING` times what they state."""
        return self.of_steps > SURPRISING

    @property
    def surprise(self) -> bool:
        """Whether steps surprise, or loops err more than what they state by over a standard deviation of the prior."""
        return bool(self.steps_surprise or max(self.loop_turn, self.loop_shift) > np.exp(FOLD))

    @property
    def exceed_stated(self) -> bool:
        """Whether some errors are at least twice what they are stated to be."""
        return bool(np.log(max(astuple(self))) > MOST_RATIO - FOLD / 4)

    def differ_much(self, other: Scales) -> bool:
        """Whether one of them differs from the other's more than twofold."""
        return bool((np.abs(np.log(astuple(self)) - np.log(astuple(other))) > MOST_RATIO).any())

    def at_solution(self, fit: Fit) -> Scales:
        """These scales, by which the fit was made, times how much larger residuals are there than they should be: the
        median of each kind, of runs of steps or loops, at poses solved without it. The same where these are few.
        Not above the bounds of `learned_scales`: bent poses make errors of any size.
        """
        split, factors = fit.linear.chain.rotation_axes, np.ones(4)
        for kind, rows in enumerate((fit.reduced.of_runs, fit.reduced.of_loops)):
            residual, covariance = fit.left_out(rows)
            for part, axes in enumerate((slice(0, split), slice(split, None))):
                if len(residual) >= FEWEST:
                    chi2 = mahalanobis(residual[:, axes], covariance[:, axes, axes])[0]
                    usual = np.median(chi2) / chdtri(residual[:, axes].shape[1], 0.5)
                    factors[2 * kind + part] = np.sqrt(max(usual, np.finfo(float).eps))
        chain, logs = fit.linear.chain, np.log(astuple(self))
        # the chain has these scales, so that its bounds are relative to them
        turn, shift, *own = (logs + np.minimum(np.log(factors), _upper_bounds(chain))).tolist()
        if chain.stated:
            turn, shift = min(turn, shift + MOST_RATIO), min(shift, turn + MOST_RATIO)
        return Scales(*np.exp([turn, shift, *own]).tolist())

    def units(self, chain: Chain) -> tuple[Floats, Floats]:
        """The factor on each free axis (p,), of steps and of loops."""
        step, loop = np.reshape(astuple(self), (2, 2))[:, (chain.axes >= 3).astype(int)]
        return step, loop


def learned_scales(
    chain: Chain, outliers: OutlierModel, most_turn: float = MOST_RATIO
) -> Iterator[tuple[Scales, Floats]]:
    """The most probable scales given the loops' residuals against the bare chain, and the shares (2,) of right and
    wrong loops; then those that a search from smaller scales finds, where they differ much: the solutions have to tell.

    Loops count as independent: correlated errors of loops at one place, and of steps, would else pass for small errors.
    The log-likelihood of decoys, motions of loops between other places, is that of chance at each scale, and is
    subtracted. A loop between two paths, which may not be joined, is compared with the one beside it. `most_turn`: the
    largest log-ratio of the scales of rotation and translation of steps.
    """
    if chain.joins.any():  # beside the covariance of bridges, that of steps is lost in rounding
        chain = chain.parted()
    linear = linearise(chain, chain.poses)
    alone = np.arange(len(chain.ends)), chain.ends
    own, elsewhere = (_Model.within(linear, outliers, *each) for each in (alone, decoys(chain, DECOYS)))
    both = [(own, elsewhere)]
    one, near = _neighbours(chain)
    if len(one):
        drawn = np.random.default_rng(2).integers(0, len(chain.ends), DECOYS * len(one))
        by_chance = _Model.beside(linear, outliers, np.repeat(one, DECOYS), np.repeat(near, DECOYS), drawn)
        both.append((_Model.beside(linear, outliers, one, near, near), by_chance))
    most = _upper_bounds(chain)

    def value(logs: Floats, unit: float) -> float:
        logs = np.minimum(logs, most)
        turn, shift, own_turn, own_shift = logs
        ratio = max(shift - turn, abs(own_turn - own_shift))
        if (chain.stated or not unit) and (ratio > MOST_RATIO or turn - shift > most_turn):
            return -np.inf
        prior = -0.5 * float((logs - unit) @ (logs - unit) / FOLD**2)
        return prior + sum(_beyond_chance(logs, *each) for each in both)

    found = _likeliest(value, 0.0)
    # starts near the stated scale would explain mistaken places
    units = UNITS[np.abs(UNITS) > 2 * FOLD] if chain.stated else UNITS
    values = np.array([value(np.full(4, unit), unit) for unit in units])
    tried = np.argsort(-values, kind="stable")[:MOST_TRIED]
    tried = tried[values[tried] > found[1]] if chain.stated else tried
    others = [_likeliest(value, unit) for unit in units[tried].tolist()]
    other = max(others, key=lambda each: each[1], default=found)
    found = other if other[1] > found[1] + BY_CHANCE else found

    def learned(logs: Floats) -> tuple[Scales, Floats]:
        logs = np.minimum(logs, most)
        return Scales(*map(float, np.exp(logs))), own.value(logs)[1]

    first = learned(found[0])
    yield first
    # by stated errors far too large right loops say no more than chance does, and no change of one scale alone makes
    # them likelier
    start = max((0.0, -FOLD, -2 * FOLD), key=lambda log: value(np.full(4, log), 0.0)) if chain.stated else 0.0
    if start and (second := learned(_likeliest(value, 0.0, start)[0]))[0].differ_much(first[0]):
        yield second


def _beyond_chance(logs: Floats, own: _Model, elsewhere: _Model) -> float:
    """The log-likelihood of scales, less that of as many decoys."""
    share = len(own.residual) / max(len(elsewhere.residual), 1)
    return float(own.value(logs)[0] - share * max(elsewhere.value(logs)[0], 0.0))


def _neighbours(chain: Chain) -> tuple[Ints, Ints]:
    """Loops (K,) between two paths, and for each the loop between the same two whose ends are nearest."""
    pairs = chain.path[chain.ends]
    rows = _some(np.flatnonzero(chain.apart))
    if len(rows) < 2:
        return rows[:0], rows[:0]
    near = cKDTree(chain.ends[rows]).query(chain.ends[rows], k=2, p=np.inf)[1]
    other = rows[np.where(near[:, 0] == np.arange(len(rows)), near[:, 1], near[:, 0])]
    same = (pairs[rows] == pairs[other]).all(axis=1)
    return rows[same], other[same]


def _upper_bounds(chain: Chain) -> Floats:
    """Upper bounds (4,) on the logarithms of scales. Steps err by no more than `MOST_OF_A_STEP` of their motion, unless
    they state more: else wrong loops that agree pass for right ones of a useless odometry. Where information is stated,
    rotations have no bound of their own, but `MOST_RATIO`: on a straight path their motion is small.
    """
    most = np.full(4, np.inf)
    moved = chain.log(chain.step[chain.measured])
    spread = np.sqrt(np.einsum("mii->mi", chain.step_covariance[chain.measured]))
    for kind, axes in enumerate((slice(0, chain.rotation_axes), slice(chain.rotation_axes, None))):
        size, unit = np.linalg.norm(moved[:, axes]), np.linalg.norm(spread[:, axes])
        if size > 0 and unit > 0 and not (chain.stated and kind == 0):
            most[kind] = max(np.log(MOST_OF_A_STEP * size / unit), 0.0 if chain.stated else -np.inf)
    return most


def _likeliest(
    value: Callable[[Floats, float], float], unit: float, start: float | None = None
) -> tuple[Floats, float]:
    """The maximum of `value` by coordinate search from a common scale `start`, by default the unit: the logarithms (4,)
    of scales, and the value.
    """
    best = np.full(4, unit if start is None else start)
    top = value(best, unit)
    for width in (FOLD, FOLD / 2, FOLD / 4):
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
    return best, top


def decoys(chain: Chain, times: int) -> tuple[Ints, Ints]:
    """Each loop `times` over (K,), and random ends (K, 2) on one path for each."""
    rng = np.random.default_rng(1)
    loop = np.repeat(np.arange(len(chain.loop_edge)), times)
    first = rng.integers(0, chain.size, len(loop))
    begin = np.searchsorted(chain.path, chain.path[first])
    length = np.searchsorted(chain.path, chain.path[first], side="right") - begin
    second = begin + np.minimum((rng.random(len(loop)) * length).astype(np.int64), length - 1)
    return loop, np.sort(np.stack([first, second], axis=1), axis=1)


def _some(rows: Ints) -> Ints:
    """Up to `MOST_LOOPS` of these rows, drawn at random."""
    if len(rows) <= MOST_LOOPS:
        return rows
    return np.sort(np.random.default_rng(0).choice(rows, MOST_LOOPS, replace=False))


@dataclass(frozen=True)
class _Model:
    """Closing errors of cycles of one loop or two, whose covariance is a quadratic function of the scales.

    - `residual (M, p)`; `outliers`: the same if the loops are wrong.
    - `path`, `own (3, M, p, p)`: the terms of rotation, of translation and of both in the covariances of the paths and
      of the loops; `fixed (M, p, p)`: the term that no scale changes.
    """

    outliers: OutlierResiduals
    residual: Floats
    fixed: Floats
    path: Floats
    own: Floats

    @classmethod
    def of(
        cls,
        chain: Chain,
        outliers: OutlierModel,
        rows: Ints,
        residual: Floats,
        parted: Callable[[Chain], tuple[Floats, Floats]],
    ) -> _Model:
        """The model of the cycles of loops `rows (M,)`; `parted` gives the covariances of paths and of loops in a
        chain.
        """
        kinds = (0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)
        parts = [parted(Scales(*kind, *kind).applied(chain)) for kind in kinds]
        path, own = (np.stack(each) for each in zip(*parts, strict=True))
        fixed, path, own = path[0], path[1:] - path[0], own[1:]
        for each in (path, own):
            each[2] -= each[0] + each[1]
        return cls(outliers.at(chain, rows, residual), residual, fixed, path, own)

    @classmethod
    def within(cls, linear: Linear, outliers: OutlierModel, loop: Ints, ends: Ints) -> _Model:
        """The cycle of each loop (K,), moved to these ends (K, 2), with the path between them, if that is one."""
        rows = _some(np.flatnonzero(np.equal(*linear.chain.path[ends].T)))
        chain = linear.chain.with_loops(loop[rows], ends[rows])
        linear = replace(linear, chain=chain)

        def parted(scaled: Chain) -> tuple[Floats, Floats]:
            part = replace(linear, chain=scaled)
            return part.path(*chain.ends.T), part.loops[1]

        return cls.of(chain, outliers, np.arange(len(chain.ends)), linear.loops[0], parted)

    @classmethod
    def beside(cls, linear: Linear, outliers: OutlierModel, one: Ints, other: Ints, drawn: Ints) -> _Model:
        """The cycle of each loop `one (M,)` with a loop `other (M,)` and the paths between their lower ends and between
        their upper ends. `drawn (M,)`: loops whose motions those of the others are.
        """
        ends = linear.chain.ends[np.concatenate([one, other])]
        chain = linear.chain.with_loops(np.concatenate([one, drawn]), ends)
        first, second = np.arange(2 * len(one)).reshape(2, -1)
        linear, none = replace(linear, chain=chain), np.zeros(len(ends))

        def residuals(scaled: Chain) -> tuple[Floats, Floats]:
            return PairwiseConsistency.of(replace(linear, chain=scaled), none).residuals(second, first)

        def parted(scaled: Chain) -> tuple[Floats, Floats]:
            path = residuals(replace(scaled, covariance=0 * scaled.covariance))[1]
            return path, residuals(scaled)[1] - path

        return cls.of(chain, outliers, first, residuals(chain)[0], parted)

    def value(self, logs: Floats) -> tuple[float, Floats]:
        """The log-likelihood of scales, against all loops being wrong, and the shares of right and wrong loops."""
        turn, shift, own_turn, own_shift = np.exp(logs)
        covariance = self.fixed + _weighed(self.path, turn, shift) + _weighed(self.own, own_turn, own_shift)
        factor = student_log_density(self.residual, covariance)[0] - self.outliers.log_density(covariance)
        shares, likelihood = mixture(factor)
        return likelihood, shares


def _weighed(parts: Floats, turn: float, shift: float) -> Floats:
    return np.asarray(turn**2 * parts[0] + shift**2 * parts[1] + turn * shift * parts[2])

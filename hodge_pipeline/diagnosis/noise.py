"""The noise of right edges, estimated from the cycles that close."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import MEDIAN_CHI2, has_unit_information, mean_variances
from hodge_pipeline.complex.cycles import Loops
from hodge_pipeline.solvers.backbone.levels import FEWEST, SIGMAS
from hodge_pipeline.solvers.backbone.step_tests import LONGEST_CYCLE
from hodge_pipeline.types import Bools, Floats, ViewGraph

DEFAULT_ANGLE_RAD, DEFAULT_SHARE = 0.03, 0.05
"""Standard deviations of an edge where too few cycles close to estimate them; of translation as a share of the reach.
"""
ABOUT_A_POINT = 0.2
"""Least reach as a share of the usual step between views: where all turn about one point, nothing moves there."""
FIRST_GATE_RAD, FIRST_GATE_SHARE = 0.35, 0.6
"""Gates of cycles that errors are estimated from; of translation as a share of the reach."""
SOME_CYCLES = 4
"""Fewest cycles to bound errors by where fewer than `FEWEST` close."""
COPIES = 1e-5
"""Share of the gate below which cycles join copies of one measurement and are no evidence."""
COVERED = 0.95
"""Share of closing cycles: if the stated information explains so many, errors are scaled to cover as many."""
MAXWELL_MEDIAN, MAXWELL_COVERED = math.sqrt(MEDIAN_CHI2[3]), math.sqrt(chdtri(3, 1 - COVERED))
"""Quantiles of the length of a vector of three normal errors."""
GAP = 5.0
"""Factor on the error that `COVERED` closing cycles stay below, beyond which cycles are apart from these. With 3 the
cubicle's graph loses 185 right edges for 127.
"""
HEAVY_TAILS = 1.9
"""Factor on a Gaussian's standard deviation of the same median: errors of registration have heavier tails."""
LEAST_CREDIBLE = 0.2
"""Least credible stated error in units of the default; the largest is `SIGMAS` times that."""
LEVER = 1.8
"""Radius of what is seen about the working point, in reaches, at which an error of rotation acts as one of translation.
"""


@dataclass(frozen=True)
class Noise:
    """Standard deviations per axis (E,) of each edge, radians and metres at the working point; `doubts`: notes on
    stated information that is not credible.
    """

    rotation_rad: Floats
    translation_m: Floats
    doubts: tuple[str, ...] = ()

    @property
    def information(self) -> Floats:
        """The information (E, 6, 6) at the working point."""
        out = np.zeros((len(self.rotation_rad), 6, 6))
        out[:, range(3), range(3)] = 1 / self.rotation_rad[:, None] ** 2
        out[:, range(3, 6), range(3, 6)] = 1 / self.translation_m[:, None] ** 2
        return out


def edge_noise(
    graph: ViewGraph,
    there: ViewGraph,
    loops: Loops,
    angle: Floats,
    displacement_m: Floats,
    prior: Floats,
    reach_m: float,
) -> Noise:
    """The noise of each edge: proportions by the information `there`, at the working point, scale by closing cycles.

    Where the stated information explains nearly all closing cycles, the scale covers them too, since edges of several
    kinds make long tails. Where too few cycles close to estimate a scale, stated errors are clipped to credible bounds:
    with errors as large as motions any loop would close, with errors as small as rounding none.
    """
    informed, ones = not has_unit_information(graph), np.ones(graph.edge_count)
    own = [ones, ones]
    if informed:
        variances = mean_variances(there, graph.dimension == 2)
        own = [np.asarray(np.sqrt(np.where(each > 0, each, np.inf))) for each in variances]
    rotation, translation = map(_proportions, own)
    short = np.flatnonzero(loops.lengths <= LONGEST_CYCLE + 1)  # errors of longer ones add up until any seems to close
    any_cycle, loops = len(loops) > 0, loops.select(short)
    turned = _Errors(loops, rotation, angle[short], FIRST_GATE_RAD)
    shifted = _Errors(loops, translation, displacement_m[short], FIRST_GATE_SHARE * reach_m)
    step_m = float(np.median(np.linalg.norm(graph.i_from_j[:, :3, 3], axis=1))) if graph.edge_count else 0.0
    usual = DEFAULT_ANGLE_RAD, DEFAULT_SHARE * max(reach_m, ABOUT_A_POINT * step_m)
    stated = usual if not informed else (_median(rotation), _median(translation))
    credible = tuple(map(_credible, stated, usual, (turned.median_scale(), shifted.median_scale())))
    if informed:
        turn = turned.scale(prior, credible[0], usual[0] / stated[0])
        shift = shifted.scale(prior, credible[1], usual[1] / stated[1])
    else:
        turn, shift = turned.scale(prior, usual[0], usual[0]), shifted.scale(prior, usual[1], usual[1])
    closes = (turned.error < turned.gate) & (shifted.error < shifted.gate)
    sound = (turned.ratio < SIGMAS) & (shifted.ratio < SIGMAS)
    if informed and not shifted.are_exact and closes.sum() >= FEWEST and sound[closes].mean() >= COVERED:
        turn = max(turn, turned.covering_scale(sound, closes))
        shift = max(shift, shifted.covering_scale(sound, closes))
    if not informed:
        shift = max(shift, LEVER * turn * reach_m)
    taken = turn == credible[0], shift == credible[1]
    changed = any(own and not 1 / SIGMAS < by < SIGMAS for own, by in zip(taken, credible, strict=True))
    is_reported = informed and changed and any_cycle
    doubts = (_doubt(stated, (turn * stated[0], shift * stated[1])),) if is_reported else ()
    return Noise(_scaled(turn, rotation, own[0]), _scaled(shift, translation, own[1]), doubts)


def recentred(graph: ViewGraph, point: Floats) -> ViewGraph:
    """The graph between frames that are moved to the point (3,): motions `S⁻¹ Z S`, and their information there."""
    shift = se3.from_parts(np.eye(3), point)
    there = se3.adjoint(shift)
    motions = np.asarray(se3.inverse(shift) @ graph.i_from_j @ shift)
    return replace(graph, i_from_j=motions, information=there.T @ graph.information @ there)


def _median(deviation: Floats) -> float:
    return float(np.median(deviation)) if len(deviation) else 1.0


def _credible(stated: float, usual: float, median_scale: float) -> float:
    """The factor that makes a stated error credible beside a `usual` one and one `shown` by cycles; 1 if it is."""
    if stated > SIGMAS * usual:
        return min(max(usual / stated, median_scale), 1.0)
    return max(1.0, LEAST_CREDIBLE * usual / stated)


def _doubt(stated: tuple[float, float], taken: tuple[float, float]) -> str:
    turn, shift = (own / before for own, before in zip(taken, stated, strict=True))
    return (
        "the information states errors that the graph does not show, and too few short cycles close to tell: judged "
        f"with {turn:.2g} times these in rotation, {shift:.2g} times in translation"
    )


def _proportions(stated: Floats) -> Floats:
    """Standard deviations (E,), clipped to √10 times the median either way; infinite ones become the median."""
    usual = float(np.median(stated[np.isfinite(stated)])) if np.isfinite(stated).any() else 1.0
    return np.clip(np.where(np.isfinite(stated), stated, usual), usual / math.sqrt(10), usual * math.sqrt(10))


def _scaled(scale: float, proportions: Floats, stated: Floats) -> Floats:
    """Scaled standard deviations (E,), but none below the stated one, or the median one if that is less.

    Odometry and loops often state errors in different units, and the scale is that of the loops.
    """
    return np.maximum(scale * proportions, np.minimum(stated, scale * _median(proportions)))


class _Errors:
    """Closing errors of short cycles, `error (L,)`, and their `ratio (L,)` to those by the edges' relative noise.

    `closes (L,)`: within the `gate`, but for those that close exactly; `are_exact`: whether more cycles of three edges
    and more close exactly than otherwise, as where edges were made of poses.
    """

    def __init__(self, loops: Loops, relative: Floats, error: Floats, gate: float) -> None:
        self.loops, self.error, self.gate = loops, error, gate
        self.ratio = error / np.sqrt(loops.sums(relative**2))
        exact = error <= COPIES * gate
        self.closes = ~exact & (error < gate)
        self.are_exact = bool((exact & (loops.lengths > 2)).sum() > self.closes.sum())

    def scale(self, prior: Floats, fallback: float, usual: float) -> float:
        """The scale at which half of the cycles that close have an error below the median of its distribution; at most
        `usual` where most close exactly and the others hardly within the gate, as by chance.
        """
        closes = np.flatnonzero(self.closes)
        if len(closes) < FEWEST:
            return fallback
        weight = np.exp(self.loops.sums(np.log(prior)))[closes]
        order = np.argsort(self.ratio[closes])
        total = np.cumsum(weight[order])
        middle = closes[order[np.searchsorted(total, total[-1] / 2)]]
        found = max(HEAVY_TAILS * float(self.ratio[middle]) / MAXWELL_MEDIAN, 1e-3 * fallback)
        by_chance = max(self.error[middle], np.median(self.error[closes])) > self.gate / 2
        return min(found, usual) if by_chance and self.are_exact else found

    def median_scale(self) -> float:
        """The scale by the median of all cycles, 0 of fewer than `SOME_CYCLES`: hardly half of a few are wrong."""
        if len(self.ratio) < SOME_CYCLES:
            return 0.0
        return HEAVY_TAILS * float(np.median(self.ratio)) / MAXWELL_MEDIAN

    def covering_scale(self, sound: Bools, closes: Bools) -> float:
        """The scale that covers nearly all cycles that the information explains, `sound (L,)`, up to a gap after those
        that close (L,): stated errors that are far too large would explain wrong edges too.
        """
        ratios = self.ratio[closes & (self.ratio > COPIES)]
        limit = GAP * float(np.quantile(ratios, COVERED)) if len(ratios) else np.inf
        return float(np.quantile(self.ratio[sound & (self.ratio < limit)], COVERED)) / MAXWELL_COVERED

"""Whether edges know the shape of given poses better than these do, and given poses less their own white noise.

Edges measure from frame to frame, so their errors add up to a slow bend that no pair of overlapping frames shows; given
poses may be rough and yet not bend at all.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.errors import GraphError
from hodge_pipeline.refine.uncertainty import reduced_chi2
from hodge_pipeline.solvers.covariance import relative_covariances
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.types import Floats, Ints, Priors, Solution, ViewGraph
from hodge_pipeline.types.arrays import evenly

STATED_SHARE = 0.2
"""An edge's variance is taken to be this share of the stated one, or `GuardOptions.shared_errors` times what edges
leave over (reduced χ²), whichever is larger; where no cycle tests the edges, the stated one. Errors that all edges of a
frame share, as of shutter, sampling and the delay between depth and colour, close every cycle: true poses are off by 9
to 84 times what edges leave over in rendered rooms, by 1 to 9 times in drives of a LiDAR.
"""
FARTHER, CHANCE = 3.5, 0.01
"""Times as far off as edges and noise err, root mean square over the pairs of a distance, from which edges decide; or
times as far as any pair is by chance, as at a jump. True poses reach 0.3 to 1.1 times in rendered rooms and drives and
2.0 in real recordings (red kitchen): so far edges may be off, and from 3.5 on the squared error of the given poses is
twice that of edges. The farthest pair alone, 1.6 times as far as by chance, called edges nearer wrongly twice as often.
"""
JUMP = 1.75
"""Times as far as any step is by chance from which a given one is a jump. True steps reach 0.3 in rendered rooms, 0.5
in fr1/xyz, 1.0 in fr1/rpy and 1.4 in red kitchen; there a pose 30 cm off reaches 6 to 11, a turn of 5 degrees 5.5.
"""
MEDIAN_OF_THREE = float(chdtri(3, 0.5))
"""The median of the sum of three squares of a standard normal."""
PLACES = 16
"""Pairs of each distance, evenly along the path."""
LEAST = 1e-6
"""Share of the larger variance, of rotations or translations, below which poses are as good as held."""


def without_noise(
    graph: ViewGraph, solution: Solution, given: Floats, firsts: Ints, shared_errors: float
) -> Floats | None:
    """The given poses (K, 4, 4) less their white noise, where it exceeds that of the edges, which led to the solution;
    `firsts (S,)`: the rows that are followed by another one of their sequence; `shared_errors`: of `GuardOptions`.

    The very array given, where its noise is no larger. None where edges decide alone: pairs of some distance lie so far
    from where edges put them that the given poses must err by more than edges, see `FARTHER`.
    """
    edges = _weakened(graph, solution, shared_errors)
    component = connected_components(edges.edges, edges.vertex_count)
    octaves = _octaves(component)
    try:
        covariances = [relative_covariances(edges, solution.world_from_cam, pairs) for pairs in octaves]
    except (GraphError, np.linalg.LinAlgError, RuntimeError):  # a singular graph has no covariance
        return None
    white = _white(solution, given, firsts[component[firsts] == component[firsts + 1]])
    chance = float(chdtri(6, CHANCE / max(1, sum(map(len, octaves)))))
    for pairs, spread in zip(octaves, covariances, strict=True):
        chi2 = _chi2(solution, given, pairs, spread, white)
        if len(chi2) and max(chi2.mean() / 6, chi2.max() / chance) > FARTHER**2:
            return None
    if not (white > _white_at_most(covariances[0])).any():
        return given
    information = np.diag(np.repeat(1 / np.maximum(white, LEAST * white.max()), 3))
    priors = Priors(np.arange(len(given)), given, np.tile(information, (len(given), 1, 1)))
    return solve(edges, start=given, initial="given", priors=priors).world_from_cam


def far_steps(graph: ViewGraph, solution: Solution, given: Floats, firsts: Ints, shared_errors: float) -> Ints:
    """The rows from which given poses (K, 4, 4) jump to the next, of `firsts (S,)`: by `JUMP` times as far as edges and
    white noise make any step err by chance, the farthest first. None where a singular graph tells no covariance.
    """
    edges = _weakened(graph, solution, shared_errors)
    component = connected_components(edges.edges, edges.vertex_count)
    firsts = firsts[component[firsts] == component[firsts + 1]]
    pairs = np.stack([firsts, firsts + 1], axis=1)
    try:
        covariances = relative_covariances(edges, solution.world_from_cam, pairs)
    except (GraphError, np.linalg.LinAlgError, RuntimeError):
        return firsts[:0]
    chi2 = _chi2(solution, given, pairs, covariances, _white(solution, given, firsts, has_jumps=True))
    far = np.flatnonzero(chi2 > JUMP**2 * chdtri(6, CHANCE / max(1, len(pairs))))
    return firsts[far[np.argsort(-chi2[far])]]


def _weakened(graph: ViewGraph, solution: Solution, shared_errors: float) -> ViewGraph:
    """The edges used, with the information that they have with the errors that they share."""
    used, reduced = np.flatnonzero(solution.kept), reduced_chi2(graph, solution)
    share = 1.0 if np.isnan(reduced) else max(STATED_SHARE, shared_errors * reduced)
    weights = solution.weights[used] / share
    return replace(graph.select(used), information=graph.information[used] * weights[:, None, None])


def _octaves(component: Ints) -> list[Ints]:
    """Pairs (P, 2) of rows 1, 2, 4, 8 ... apart, each in one component."""
    out, apart = [], 1
    while apart < len(component):
        starts = evenly(len(component) - apart, PLACES)
        out.append(np.stack([starts, starts + apart], axis=1)[component[starts] == component[starts + apart]])
        apart *= 2
    return out


def _corrections(solution: Solution, given: Floats, pairs: Ints) -> Floats:
    """How the motions of pairs (P, 2) by the solution differ from given ones: ξ (P, 6) in the second pose's axes."""
    return se3.log(se3.between(given, pairs[:, ::-1]) @ se3.between(solution.world_from_cam, pairs))


def _white(solution: Solution, given: Floats, firsts: Ints, *, has_jumps: bool = False) -> Floats:
    """The variances (2,) of rotations and translations that each pose has on its own; medians where it `has_jumps`.

    What white noise adds to a step the next one takes back: two steps are off by no more than one. By a random walk
    they are off by twice its variance, by a bend more.
    """
    twice = firsts[:-1][np.diff(firsts) == 1]
    if not len(twice):
        return np.zeros(2)
    of_one, of_two = (
        (_corrections(solution, given, np.stack([starts, starts + apart], axis=1)) ** 2).reshape(-1, 2, 3).sum(axis=2)
        for starts, apart in ((firsts, 1), (twice, 2))
    )
    one, two = (
        np.median(of, axis=0) / MEDIAN_OF_THREE if has_jumps else of.mean(axis=0) / 3 for of in (of_one, of_two)
    )
    return np.asarray(np.maximum(one - two / 2, 0.0))


def _white_at_most(of_steps: Floats) -> Floats:
    """The variances (2,) of white noise of edges with such covariances (P, 6, 6) of steps, if these have no other."""
    spread = np.einsum("pii->pi", of_steps).reshape(-1, 2, 3)
    return spread.mean(axis=(0, 2)) / 2 if len(spread) else np.full(2, np.inf)


def _chi2(solution: Solution, given: Floats, pairs: Ints, covariances: Floats, white: Floats) -> Floats:
    """χ² (P,) of how far pairs (P, 2) of given poses lie from where edges put them, as edges and white noise err."""
    noise = np.diag(np.repeat(white, 3))
    second_from_first = se3.adjoint(se3.between(given, pairs[:, ::-1]))
    both = covariances + noise + second_from_first @ noise @ np.swapaxes(second_from_first, 1, 2)
    off = _corrections(solution, given, pairs)
    return np.asarray(np.einsum("pi,pi->p", off, np.linalg.solve(both, off[..., None])[..., 0]))

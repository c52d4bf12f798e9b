"""Odometry with a window, each frame registered to several before it: its edges over a few steps fused into steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline.complex.chi2 import (
    EXACT,
    MEDIAN_CHI2,
    STUDENT_99,
    chi2_by_information,
    has_unit_information,
    tail_weight,
)
from hodge_pipeline.solvers.backbone.chain import STEPS_OF_PLACE, Chain, make_chain
from hodge_pipeline.solvers.backbone.evidence import mahalanobis
from hodge_pipeline.solvers.backbone.judge import by_path
from hodge_pipeline.solvers.backbone.levels import MOST_ROUNDS, NEARLY_ALL, TOLERANCE
from hodge_pipeline.solvers.backbone.linear import graph_of, inverse, linearise
from hodge_pipeline.solvers.backbone.parallel import Fused
from hodge_pipeline.solvers.backbone.sequence import sequential_edges, steps_apart
from hodge_pipeline.solvers.backbone.step_tests import (
    AS_STATED,
    LONGEST_CYCLE,
    LOOPS_AT_A_STEP,
    TESTED,
    closes,
    gate,
    pairs_across,
)
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.reweighted import SETTLED
from hodge_pipeline.solvers.weights import FLOOR
from hodge_pipeline.types import Bools, Floats, Ints

WRITTEN, TURNED_RAD = 5e-6, 10.0
"""Largest rounding error, as a share of the number, where six digits are written, as streams of C++ do; and an angle
that was not taken back to half a turn.
"""


def windowed(given: Fused) -> Fused:
    """The graph whose edges over a few steps are fused into the steps, if they are many and nearly all agree; else the
    same. A step that they contradict is replaced by what they imply. Of edges between fragments of rooms, every pair of
    which was tried, .6 to .84 agree.
    """
    graph = given.graph
    steps, apart = sequential_edges(graph), steps_apart(graph)
    if ((apart > 0) & (apart <= LONGEST_CYCLE)).sum() <= (1 + LOOPS_AT_A_STEP) * steps.sum():
        return given
    chain = make_chain(graph, steps)
    at, near = np.flatnonzero(chain.step_edge >= 0), _near(chain)
    if not _many(chain, near):
        return given
    low, high = chain.ends[near].T
    along = chain.between(chain.poses[low], chain.poses[high])
    closing, unknown = closes(chain.motion[near], along, gate(chain), np.sqrt(high - low)), has_unit_information(graph)
    if unknown and 2 * closing.sum() < len(near):  # errors that are learned from wrong edges would explain all
        return given
    learned = _with_learned_covariance(chain, near) if unknown else chain
    fits, scale, untested, doubted = _fitting(learned, near, closing)
    near, fits = near[~untested], fits[~untested]
    weights, poses = _agreeing(learned, near, fits, scale, doubted)
    (of_step, of_near), agree = np.split(weights, [len(at)]), weights[len(at) :] > 0
    good = near[agree]
    if len(good) < NEARLY_ALL * len(near):
        return given
    replaced = (of_step == 0) & (chain.over(chain.ends[good]) > 0)[at]
    contradicted = np.concatenate([chain.step_edge[at[replaced]], chain.loop_edge[near[~agree]]])
    fused_steps = replaced | (of_step > 0)
    edges, motions, information = graph.edges.copy(), graph.i_from_j.copy(), graph.information.copy()
    to = at[fused_steps]
    step = chain.step_edge[to]
    edges[step] = np.stack([chain.order[to - 1], chain.order[to]], axis=1)
    motions[step] = chain.between(poses[to - 1], poses[to])
    if not unknown:
        own = np.zeros(chain.size)
        own[at] = of_step
        found = _information(chain, poses, own, good, of_near[agree])
        information[step] = 0.0
        information[step[:, None, None], chain.axes[:, None], chain.axes] = found[to]
    left = np.setdiff1d(np.arange(graph.edge_count), chain.loop_edge[near])
    fused = replace(graph, edges=edges, i_from_j=motions, information=information).select(left)
    merged = np.concatenate([given.merged, given.rows[chain.loop_edge[good]]])
    return replace(given, graph=fused, rows=given.rows[left], merged=merged, contradicted=given.rows[contradicted])


def _near(chain: Chain) -> Ints:
    """Rows of the loops within a path over up to `STEPS_OF_PLACE` steps."""
    return np.flatnonzero(~chain.apart & (np.diff(chain.ends, axis=1)[:, 0] <= STEPS_OF_PLACE))


def _many(chain: Chain, rows: Ints) -> bool:
    """Whether loops (rows) over two or three steps are as many, and cover as many steps, as those of a window."""
    steps, ends = chain.step_edge >= 0, chain.ends[rows]
    short = ends[np.diff(ends, axis=1)[:, 0] <= LONGEST_CYCLE]
    many = len(short) > LOOPS_AT_A_STEP * steps.sum()
    return bool(many and (chain.over(short)[steps] > 0).sum() > TESTED * steps.sum())


def _with_learned_covariance(chain: Chain, near: Ints) -> Chain:
    """The chain with covariances from the closing errors of the `near` loops, in place of the identity that stands for
    unknown information: half of the variance to the steps, and as many times a step's to a loop as it passes over.
    """
    ends, variance = chain.ends[near], np.empty(len(chain.axes))
    per_step = linearise(chain, chain.poses).loops[0][near] ** 2 / np.diff(ends, axis=1)
    unit = float(np.mean(chain.log(chain.step)[:, chain.rotation_axes :] ** 2))
    for kind, least in ((slice(0, chain.rotation_axes), 1.0), (slice(chain.rotation_axes, None), max(unit, EXACT))):
        variance[kind] = max(np.median(per_step[:, kind]) / MEDIAN_CHI2[1] / 2, EXACT**2 * least)
    step, loop = np.zeros_like(chain.step_covariance), chain.covariance.copy()
    step[chain.step_edge >= 0] = np.diag(variance)
    loop[near] = np.diff(ends, axis=1)[:, :, None] * np.diag(variance)
    return replace(chain, step_covariance=step, covariance=loop)


def _fitting(chain: Chain, near: Ints, closing: Bools) -> tuple[Bools, float, Bools, Bools]:
    """Which of the `near` loops (K,) agree with the chain; the factor on χ² by which loops err more than stated, from
    those `closing (K,)`; which of the others (K,) are left to the judging of loops; and the doubted steps (n,).

    Left to it are loops over a doubted step where fewer than half as many of them are short as elsewhere: wrong ones of
    one place agree with each other, and nothing of a window says otherwise there.
    """
    linear, ends, size = linearise(chain, chain.poses), chain.ends[near], len(chain.axes)
    chi2 = mahalanobis(linear.loops[0][near], by_path(linear, near))[0]
    usual = chi2[closing | (chain.stated & (chi2 < AS_STATED * size))]
    usual_scale = float(np.median(usual)) / MEDIAN_CHI2[size] if len(usual) else 1.0
    scale = max(usual_scale, _rounding(chain, near))
    fits = chi2 <= STUDENT_99[size] * scale
    short, over = (chain.over(each) for each in (ends[np.diff(ends, axis=1)[:, 0] <= LONGEST_CYCLE], ends))
    doubted = _doubted(chain, near, fits, closing)
    untested = doubted & (2 * short * over.sum() < over * short.sum())
    return fits, scale, ~fits & _pass_over(chain, ends, untested), doubted


def _doubted(chain: Chain, near: Ints, fits: Bools, closing: Bools) -> Bools:
    """Steps (n,) that none of the `near` loops (K,) which fit confirms; nor do, where all near loops over them are far
    off, two others that close a cycle across them.
    """
    ends, poses = chain.ends, chain.poses
    doubted = chain.over(ends[near[fits]]) == 0
    far_off = doubted & (chain.over(ends[near]) > 0) & (chain.over(ends[near[closing]]) == 0)
    around = np.stack([np.maximum(ends - LONGEST_CYCLE, 0), np.minimum(ends + LONGEST_CYCLE, chain.size - 1)], axis=2)
    others = np.setdiff1d(np.flatnonzero(_pass_over(chain, around, far_off).any(axis=1)), near)
    if not len(others):
        return np.asarray(doubted)
    pairs, spans = pairs_across(ends[others], far_off | ~chain.inner)
    one, other = others[pairs].T
    (low, high), (low_other, high_other) = ends[one].T, ends[other].T
    before, after = chain.between(poses[low], poses[low_other]), chain.between(poses[high_other], poses[high])
    passed = np.abs(ends[one] - ends[other]).sum(axis=1)
    confirms = closes(chain.motion[one], before @ chain.motion[other] @ after, gate(chain), np.sqrt(passed))
    return np.asarray(doubted & (chain.over(spans[confirms]) == 0))


def _pass_over(chain: Chain, ends: Ints, steps: Bools) -> Bools:
    """Which of the spans (..., 2) of positions pass over one of these steps (n,)."""
    count = np.append(0, np.cumsum(steps & chain.inner))
    return np.asarray(count[ends[..., 1] + 1] > count[ends[..., 0] + 1])


def _agreeing(chain: Chain, near: Ints, fits: Bools, scale: float, doubted: Bools) -> tuple[Floats, Floats]:
    """Weights (N,) of all steps and then of the `near` loops, 0 for those that disagree; and the poses (n, 4, 4) of a
    solve with Student's t; `fits`, `scale` and `doubted`: see `_fitting`.

    It starts without loops that disagree with the chain over steps which other loops confirm, and without steps that
    two loops or more contradict and none confirms. An edge that errs no more than it states, and closes as right cycles
    do, agrees however exact the others are.
    """
    ends, size = chain.ends[near], len(chain.axes)
    fits = fits | _pass_over(chain, ends, doubted)
    at = np.flatnonzero(chain.step_edge >= 0)
    step = np.where(doubted & (chain.over(ends) > 1), 0.0, 1.0)[at]
    weights = np.concatenate([step, fits.astype(float)])
    edges = np.concatenate([np.stack([at - 1, at], axis=1), ends])
    motion, covariance = (
        np.concatenate(each)
        for each in ((chain.step[at], chain.motion[near]), (chain.step_covariance[at], chain.covariance[near]))
    )
    graph = graph_of(chain, chain.size, edges, motion, covariance)

    def solved(weights: Floats, start: Floats) -> Floats:
        weighted = replace(graph, information=graph.information * np.maximum(weights, FLOOR)[:, None, None])
        return solve(weighted, start=start, initial="given", relative_tolerance=TOLERANCE).world_from_cam

    poses = solved(weights, chain.poses)
    for _ in range(MOST_ROUNDS):
        chi2 = chi2_by_information(graph, poses) / scale
        before, weights = weights, np.minimum(tail_weight(chi2, size), 1.0)
        if np.abs(weights - before).max() < SETTLED:
            break
        poses = solved(weights, poses)
    i, j = edges.T
    near_enough = closes(motion, chain.between(poses[i], poses[j]), gate(chain), np.sqrt(j - i))
    agree = (chi2 <= STUDENT_99[size]) | chain.stated & near_enough & (chi2 * scale < AS_STATED * size)
    return np.where(agree, weights, 0.0), poses


def _rounding(chain: Chain, near: Ints) -> float:
    """The χ² per axis of what rounding of coordinates may displace a loop by: no edge is wrong for that."""
    extent = max(float(np.ptp(chain.poses[:, :3, 3], axis=0).max()), np.finfo(float).tiny)
    written = WRITTEN * np.where(chain.axes < 3, TURNED_RAD, extent)
    chi2 = mahalanobis(np.tile(written, (len(near), 1)), chain.covariance[near])[0]
    return float(np.median(chi2)) / len(written)


def _information(chain: Chain, poses: Floats, own: Floats, near: Ints, weights: Floats) -> Floats:
    """Information (n, p, p) on the step to each position: its own, with weights `own (n,)`, and a share of that of the
    `near` loops over it, with theirs. A loop over g steps counts g times on each, so that over many steps the fused
    steps have the information of all edges together.
    """
    low, high = chain.ends[near].T
    total = np.zeros_like(chain.step_covariance)
    at = np.flatnonzero(own)
    total[at] = own[at, None, None] * inverse(chain.step_covariance[at])
    each = (weights * (high - low))[:, None, None] * inverse(chain.covariance[near])
    for back in range(int((high - low).max())):
        rows = np.flatnonzero(high - low > back)
        at = high[rows] - back
        carry = chain.adjoint(chain.between(poses[high[rows]], poses[at]))
        np.add.at(total, at, np.swapaxes(carry, 1, 2) @ each[rows] @ carry)
    return total

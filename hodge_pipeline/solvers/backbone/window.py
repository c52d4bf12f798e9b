"""Edges over a few steps, as of an odometry that registers each frame to several before it: one backbone of all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.judging import (
    EXACT,
    MEDIAN_CHI2,
    STUDENT_99,
    chi2_by_information,
    has_unit_information,
    tail_weight,
)
from hodge_pipeline.solvers.backbone.chain import (
    STEPS_OF_PLACE,
    Chain,
    make_chain,
    sequential_edges,
    steps_apart,
)
from hodge_pipeline.solvers.backbone.evidence import squares
from hodge_pipeline.solvers.backbone.fit import inverse, linearise
from hodge_pipeline.solvers.backbone.judge import by_path
from hodge_pipeline.solvers.backbone.parallel import Fused
from hodge_pipeline.solvers.backbone.step_tests import AS_STATED, LONGEST_CYCLE, LOOPS_AT_A_STEP, TESTED, closes, gate
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.reweighted import SETTLED
from hodge_pipeline.types import Floats, Ints, ViewGraph

AGREEING = 0.9
"""Of those edges, that agree with each other and the steps. Of edges between fragments of rooms, every pair of which
was tried, .69 to .84 do, of the cubicle's .6; of graphs whose odometry has a window nearly all.
"""
ROUNDS = 10
"""Times that poses are solved for, while edges change sides: a limit on cost."""
TOLERANCE, LEAST = 1e-4, 1e-9
"""How precisely their poses are solved for, of χ²; and the least weight, so that they do not fall into pieces."""


def windowed(one: Fused) -> Fused:
    """The graph with steps that say what the edges over a few of them do too, in place of these: where they are many
    and nearly all of them agree. A step that they contradict is what they say of it.
    """
    graph = one.graph
    steps, apart = sequential_edges(graph), steps_apart(graph)
    if ((apart > 0) & (apart <= LONGEST_CYCLE)).sum() <= (1 + LOOPS_AT_A_STEP) * steps.sum():
        return one  # nor need a chain be made for it
    chain = make_chain(graph, steps)
    at, near = np.flatnonzero(chain.step_edge >= 0), _near(chain)
    if not _many(chain, near):
        return one
    unknown = has_unit_information(graph)
    weights, poses = _agreeing(_as_they_close(chain, near) if unknown else chain, near)
    (of_step, of_near), agree = np.split(weights, [len(at)]), weights[len(at) :] > 0
    good = near[agree]
    if len(good) < AGREEING * len(near) or not _many(chain, good):
        return one
    replaced = (of_step == 0) & (chain.over(chain.ends[good]) > 0)[at]
    contradicted = np.concatenate([chain.step_edge[at[replaced]], chain.loop_edge[near[~agree]]])
    told = replaced | (of_step > 0)
    edges, motions, information = graph.edges.copy(), graph.i_from_j.copy(), graph.information.copy()
    step = chain.step_edge[at[told]]
    edges[step] = np.stack([chain.order[at[told] - 1], chain.order[at[told]]], axis=1)
    motions[step] = se3.inverse(poses[at[told] - 1]) @ poses[at[told]]
    if not unknown:
        own = np.zeros(chain.size)
        own[at] = of_step
        found = _information(chain, poses, own, good, of_near[agree])
        information[step] = 0.0
        information[step[:, None, None], chain.axes[:, None], chain.axes] = found[at[told]]
    left = np.setdiff1d(np.arange(graph.edge_count), chain.loop_edge[near])
    fused = replace(graph, edges=edges, i_from_j=motions, information=information).select(left)
    part = np.concatenate([one.part, one.rows[chain.loop_edge[good]]])
    return Fused(fused, one.rows[left], part, one.rows[contradicted])


def _near(chain: Chain) -> Ints:
    """Rows of the loops within a path over up to `STEPS_OF_PLACE` steps, or over more where at least half of all
    positions have one over as many, and over each number below.
    """
    low, high = chain.ends.T
    same = chain.path[low] == chain.path[high]
    gap = np.where(same, high - low, chain.size)
    rare = np.bincount(gap, minlength=chain.size)[2:] < 0.5 * chain.size
    return np.flatnonzero(same & (gap <= max(STEPS_OF_PLACE, 1 + int(np.argmax(np.append(rare, True))))))


def _many(chain: Chain, rows: Ints) -> bool:
    """Whether so many of these loops pass over two steps or three, and over so many steps, as a window has."""
    steps, ends = chain.step_edge >= 0, chain.ends[rows]
    short = ends[np.diff(ends, axis=1)[:, 0] <= LONGEST_CYCLE]
    many = len(short) > LOOPS_AT_A_STEP * steps.sum()
    return bool(many and (chain.over(short)[steps] > 0).sum() > TESTED * steps.sum())


def _as_they_close(chain: Chain, near: Ints) -> Chain:
    """The chain with errors as the `near` loops close, of rotation and of translation, in place of the identity that
    stands for unknown information: half of what they close to of each, as many times a step's as it passes over.
    """
    ends, variance = chain.ends[near], np.empty(len(chain.axes))
    squares = linearise(chain, chain.poses).loops[0][near] ** 2 / np.diff(ends, axis=1)
    unit = float(np.mean(chain.log(chain.step)[:, chain.turns :] ** 2))
    for kind, least in ((slice(0, chain.turns), 1.0), (slice(chain.turns, None), max(unit, EXACT))):
        variance[kind] = max(np.median(squares[:, kind]) / MEDIAN_CHI2[1] / 2, EXACT**2 * least)
    step, loop = np.zeros_like(chain.step_covariance), chain.covariance.copy()
    step[chain.step_edge >= 0] = np.diag(variance)
    loop[near] = np.diff(ends, axis=1)[:, :, None] * np.diag(variance)
    return replace(chain, step_covariance=step, covariance=loop)


def _agreeing(chain: Chain, near: Ints) -> tuple[Floats, Floats]:
    """The weights (N,) of all steps and then of the `near` loops, 0 of what does not agree, and the poses (n, 4, 4)
    that they lead to. At first all count, but for loops that disagree with the chain over steps which others agree
    with, and for steps that two or more speak against, and none for.
    """
    linear, ends, size = linearise(chain, chain.poses), chain.ends[near], len(chain.axes)
    chi2 = squares(linear.loops[0][near], by_path(linear, near))[0]
    low, high = chain.poses[ends[:, 0]], chain.poses[ends[:, 1]]
    closing = closes(chain.motion[near], se3.inverse(low) @ high, gate(chain), np.sqrt(np.diff(ends, axis=1)[:, 0]))
    usual = chi2[closing | (chain.stated & (chi2 < AS_STATED * size))]
    scale = max(float(np.median(usual)) / MEDIAN_CHI2[size], EXACT) if len(usual) else 1.0
    fits = chi2 <= STUDENT_99[size] * scale
    doubted = chain.over(ends[fits]) == 0
    over = np.append(0, np.cumsum(doubted & chain.inner))
    fits |= over[ends[:, 1] + 1] > over[ends[:, 0] + 1]
    at = np.flatnonzero(chain.step_edge >= 0)
    step = np.where(doubted & (chain.over(ends) > 1), 0.0, 1.0)[at]
    weights = np.concatenate([step, fits.astype(float)])
    information = np.zeros((len(weights), 6, 6))
    information[:, chain.axes[:, None], chain.axes] = inverse(
        np.concatenate([chain.step_covariance[at], chain.covariance[near]])
    )
    graph = ViewGraph.from_edges(
        np.arange(chain.size),
        np.concatenate([np.stack([at - 1, at], axis=1), ends]),
        np.concatenate([chain.step[at], chain.motion[near]]),
        information,
        dimension=3 if chain.is_spatial else 2,
    )

    def solved(weights: Floats, start: Floats) -> Floats:
        weighed = information * np.maximum(weights, LEAST)[:, None, None]
        known = replace(graph, information=weighed)
        return solve(known, start=start, initial="given", relative_tolerance=TOLERANCE).world_from_cam

    poses = solved(weights, chain.poses)
    for _ in range(ROUNDS):
        chi2 = chi2_by_information(graph, poses) / scale
        before, weights = weights, np.minimum(tail_weight(chi2, size), 1.0)
        if np.abs(weights - before).max() < SETTLED:
            break
        poses = solved(weights, poses)
    return np.where(chi2 <= STUDENT_99[size], weights, 0.0), poses


def _information(chain: Chain, poses: Floats, own: Floats, near: Ints, weights: Floats) -> Floats:
    """The information (n, p, p) on the step to each position: its own with a weight (n,), and of the edges in rows
    `near` with theirs an even share for each step. One over g steps states as much of each as g times its own: of many
    steps they tell then as much as all edges together do.
    """
    low, high = chain.ends[near].T
    total = np.zeros_like(chain.step_covariance)
    at = np.flatnonzero(own)
    total[at] = own[at, None, None] * inverse(chain.step_covariance[at])
    each = (weights * (high - low))[:, None, None] * inverse(chain.covariance[near])
    for back in range(int((high - low).max())):
        rows = np.flatnonzero(high - low > back)
        at = high[rows] - back
        carry = chain.adjoint(se3.inverse(poses[high[rows]]) @ poses[at])
        np.add.at(total, at, np.swapaxes(carry, 1, 2) @ each[rows] @ carry)
    return total

"""Poses in the world of known positions, such as satellite fixes: aligned to them, then bent to them along the path.

Neither how far edges drift nor how far positions scatter is as their information states: both factors are estimated
(solvers/bending.py), and a position that the others and the edges contradict is rejected. Poses are `world_from_cam`,
lengths metres, distances of positions from what the others say sigmas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import chi2_by_information
from hodge_pipeline.complex.components import by_size, connected_components
from hodge_pipeline.solvers.bending import Bending, Bent
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.setup import NO_ROWS
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph, Words
from hodge_pipeline.types.positions import PositionFit
from hodge_pipeline.types.text import counted

FEWEST = 3
"""Positions that place a piece: two leave it free to turn about the line between them."""
TRIALS = 300
"""Of three positions each: with half of them wrong, one trial of 8 has three right ones."""
GROSS = 5.0
"""Times the median misfit after the alignment, which drift spreads evenly: what is farther off is no drift."""
REJECTED_SIGMA = 5.0
"""A position so far from what all others say is rejected: of right ones one in 65,000 is (three dimensions)."""
SPREAD_SIGMA = 5.0
"""Nine in ten positions nearer together say nothing of the heading: of a robot at rest they span 3.3 sigma."""
MOST_ROUNDS = 30
"""Of rejections."""
LEAST_FACTOR = 1e-3
"""On the sigma of positions that state none: exact ones would have none at all."""
TORN, CALM, MOST_STRETCHES = 25.0, 5.0, 6
"""Times the median chi-squared of edges. Of six numbers, whose median is 5.35, one edge in 6,000 has more than 5 times
that, and none (2e-26) more than 25 times: edges below the former hold a stretch together, those above the latter tear.
"""
FEWEST_SPARE = 30
"""Numbers measured beyond those sought, below which nothing tells how far edges drift: then positions bend nothing."""
NEAR_CERTAIN = 0.95
"""Largest share of a position's variance that its own pose is taken to have, since to first order it may have all."""


@dataclass(frozen=True)
class Fixes:
    """Known `points (P, 3)` of the world with their `covariances (P, 3, 3)`; each is `arms (P, 3)` in the axes of one
    of the `vertices (P,)`, an antenna's lever arm. `stated (P,)`: whether its covariance is stated, not assumed;
    `labels (P,)` and `origin`: what a report calls each, and where they come from.
    """

    vertices: Ints
    arms: Floats
    points: Floats
    covariances: Floats
    stated: Bools
    labels: Words
    origin: str

    def __len__(self) -> int:
        return len(self.vertices)

    def select(self, rows: Bools | Ints) -> Fixes:
        """Those of these rows."""
        return Fixes(
            self.vertices[rows], self.arms[rows], self.points[rows], self.covariances[rows], self.stated[rows],
            self.labels[rows], self.origin,
        )  # fmt: skip

    def found(self, world_from_cam: Floats) -> Floats:
        """Where (P, 3) poses (V, 4, 4) put them."""
        poses = world_from_cam[self.vertices]
        return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], self.arms) + poses[:, :3, 3])


@dataclass(frozen=True)
class Placed:
    """Poses (V, 4, 4) in the world of known positions, the `component (V,)` of one gauge of each, and how they fit."""

    world_from_cam: Floats
    component: Ints
    fit: PositionFit


class _Aligned(NamedTuple):
    """Poses (V, 4, 4) whose components were brought to their positions rigidly: which vertices (V,) were, which
    positions (P,) agree with that, and why others were not.
    """

    world_from_cam: Floats
    placed: Bools
    used: Bools
    problems: tuple[str, ...]


@dataclass(frozen=True)
class _Settled:
    """Poses `world_from_cam (V, 4, 4)`, which positions are `used (P,)`, the `distance (P,)` of each from what all
    others say, in sigmas, and the estimated factors on the sigmas of edges and of positions.
    """

    world_from_cam: Floats
    used: Bools
    distance: Floats
    edge_factor: float
    fix_factor: float


def place(
    graph: ViewGraph, world_from_cam: Floats, component: Ints, weights: Floats, fixes: Fixes, up: Floats
) -> Placed:
    """The poses (V, 4, 4) solved again with known positions; `weights (E,)` are those of the solve before.

    Each component is first brought to its positions, robustly; `up (3,)` of the poses' world settles how it turns about
    positions on a line. One with fewer than three positions, or with those of one place, stays where it is. Where there
    are so few that nothing tells how far edges drift, nothing more is done.
    """
    poses, placed, used, problems = _aligned(world_from_cam, component, fixes, up)
    reached = placed[fixes.vertices]
    left = fixes.points - fixes.found(poses)
    settled = _Settled(poses, used, np.linalg.norm(_whitened(fixes, left), axis=1), 1.0, 1.0)
    joined = placed[graph.edges[:, 0]] & (weights > 0)
    if 6 * int(joined.sum()) + 3 * int(used.sum()) > 6 * int(placed.sum()) + FEWEST_SPARE:
        weighed = replace(graph, information=graph.information * weights[:, None, None], priors=None, fixed=NO_ROWS)
        rest = solve(weighed, start=poses, initial="given", fixed=NO_ROWS).world_from_cam
        pieces = [np.flatnonzero(placed & (component == label)) for label in np.unique(component[placed])]
        settled = _untorn(weighed, fixes, used, reached, partial(_settled, Bending(weighed, rest, pieces), fixes))
    solved = np.where(placed[:, None, None], settled.world_from_cam, world_from_cam)
    fit = PositionFit(
        fixes.labels,
        fixes.points,
        settled.used,
        np.where(reached[:, None], fixes.points - fixes.found(solved), np.nan),
        np.where(reached, settled.distance, np.nan),
        settled.edge_factor,
        settled.fix_factor,
        fixes.origin,
        problems,
    )
    return Placed(solved, by_size(np.where(placed, component.max(initial=0) + 1, component)), fit)


def _aligned(world_from_cam: Floats, component: Ints, fixes: Fixes, up: Floats) -> _Aligned:
    """Each component by the rigid motion that lays it on its positions, where these can place it."""
    poses, problems = world_from_cam.copy(), list[str]()
    placed, used = np.zeros(len(poses), bool), np.zeros(len(fixes), bool)
    for label in np.unique(component[fixes.vertices]):
        rows, members = np.flatnonzero(component[fixes.vertices] == label), component == label
        own = fixes.select(rows)
        if problem := _cannot_place(own, poses):
            problems.append(f"{counted(int(members.sum()), 'frame is|frames are')} not placed: {problem}")
            continue
        motion, used[rows] = align_positions(own.found(poses), own.points, _sigma(own), up)
        poses[members], placed[members] = motion @ poses[members], True
    return _Aligned(poses, placed, used, tuple(problems))


def align_positions(found: Floats, known: Floats, sigma: Floats, up: Floats) -> tuple[Floats, Bools]:
    """The motion (4, 4) that lays found points (P, 3) on known ones, by least median of squares (Rousseeuw 1984) with
    three refits to the inliers; and which points (P,) these are.

    `sigma (P,)` of each, metres; `up (3,)` is what points up among the found ones: it settles what points on a line
    leave open. The trials are seeded: the same points give the same motion.
    """
    rng = np.random.default_rng(0)
    count = len(found)
    chosen = np.stack([rng.choice(count, FEWEST, replace=False) for _ in range(TRIALS)])
    chosen = chosen if count > FEWEST else np.arange(FEWEST)[None]
    tie = np.median(sigma) ** 2
    trials = [_motion(found[rows], known[rows], tie, up) for rows in chosen]
    middle = [np.median(np.linalg.norm(known - se3.transform(trial, found), axis=1)) for trial in trials]
    best = trials[int(np.argmin(middle))]
    inliers = np.ones(count, bool)
    for _ in range(3):
        misfit = np.linalg.norm(known - se3.transform(best, found), axis=1)
        inliers = misfit <= GROSS * np.maximum(np.median(misfit), sigma)
        best = _motion(found[inliers], known[inliers], tie, up)
    return best, inliers


def _motion(found: Floats, known: Floats, tie_m2: float, up: Floats) -> Floats:
    """The least-squares motion (4, 4) from found points to known ones (Arun 1987). `tie_m2`, the variance of a point,
    weighs that up stays up: it decides where positions differ across their line by their noise alone.
    """
    moment = (known - known.mean(axis=0)).T @ (found - found.mean(axis=0)) / len(found)
    rotation = se3.project_to_so3(moment + tie_m2 * np.outer([0.0, 0.0, 1.0], up))
    return se3.from_parts(rotation, known.mean(axis=0) - rotation @ found.mean(axis=0))


def _sigma(fixes: Fixes) -> Floats:
    """The sigma (P,) of one axis, the root mean square of the three, metres."""
    return np.asarray(np.sqrt(np.trace(fixes.covariances, axis1=1, axis2=2) / 3))


def _cannot_place(fixes: Fixes, poses: Floats) -> str:
    """Why these positions of one component cannot place it; empty where they can."""
    if len(fixes) < FEWEST:
        return f"{len(fixes)} known positions among them, {FEWEST} are needed"
    spread_m = min(_extent_m(fixes.points), _extent_m(fixes.found(poses)))
    needed_m = SPREAD_SIGMA * float(np.median(_sigma(fixes)))
    if spread_m < needed_m:
        return f"their known positions span {spread_m:.2g} m, which tells no heading: {needed_m:.2g} m would"
    return ""


def _extent_m(points: Floats) -> float:
    """How far nine in ten of the points (P, 3) spread along their main axis, metres."""
    middle = points - np.median(points, axis=0)
    axis = np.linalg.svd(middle, full_matrices=False)[2][0]
    return float(np.ptp(np.quantile(middle @ axis, [0.05, 0.95])))


def _untorn(
    graph: ViewGraph, fixes: Fixes, used: Bools, reached: Bools, settle: Callable[[Bools, Bools, bool], _Settled]
) -> _Settled:
    """Poses settled without the positions of a stretch whose two ends tear edges, where those before and after it then
    agree along the edges: a receiver that is off by the same for a while agrees with itself. Edges torn in one place
    alone may be at fault themselves: then all positions stay, as do those that the rest does not contradict.
    """
    allowed, settled = reached, settle(used, reached, True)
    for _ in range(MOST_STRETCHES):
        torn = _torn(graph, settled.world_from_cam)
        if torn.max(initial=0.0) <= TORN:
            break
        part = connected_components(graph.edges[torn <= CALM], len(settled.world_from_cam))[fixes.vertices]
        labels, counts = np.unique(part[settled.used], return_counts=True)
        labels = labels[np.argsort(counts)][np.sort(counts) >= FEWEST]
        others = [part != label for label in labels[:MOST_STRETCHES]]
        if len(labels) < FEWEST:  # where a loop joins what is before and after, these are one
            others = [own for own in others if _encloses(fixes.vertices, settled.used & own, settled.used & ~own)]
        if not others:
            break
        tried = [settle(settled.used & own, allowed & own, True) for own in others]
        left = [float(_torn(graph, each.world_from_cam).max()) for each in tried]
        if min(left) > torn.max() / 2:
            break
        best = int(np.argmin(left))
        settled, allowed = tried[best], allowed & others[best]
    final, without = settle(settled.used, allowed, False), reached & ~allowed
    if without.any() and np.median(final.distance[without]) <= REJECTED_SIGMA:
        return settle(settled.used | without, reached, False)
    return final


def _encloses(vertices: Ints, others: Bools, stretch: Bools) -> bool:
    """Whether others are both before and after a stretch."""
    if not others.any() or not stretch.any():
        return False
    low, high = vertices[stretch].min(), vertices[stretch].max()
    return bool(vertices[others].min() < low and high < vertices[others].max())


def _torn(graph: ViewGraph, poses: Floats) -> Floats:
    """χ² (E,) of each edge over their median; 0 of an edge without weight."""
    chi2 = chi2_by_information(graph, poses)
    return np.asarray(chi2 / max(float(np.median(chi2[graph.information.any(axis=(1, 2))])), 1e-12))


def _settled(bending: Bending, fixes: Fixes, used: Bools, allowed: Bools, finest: bool) -> _Settled:
    """The poses bent to the `used (P,)` positions, once those rejected among the `allowed (P,)` do not change any more.

    `finest`: with the most nodes, whatever the evidence, so that a jump of positions shows in the edges at its ends.
    """
    least = 1.0 if fixes.stated.all() else LEAST_FACTOR
    for _ in range(MOST_ROUNDS):
        own = fixes.select(used)
        bent = bending.towards(own.vertices, own.arms, own.points, own.covariances, least, finest)
        distance = _distance(bent, fixes, used)
        found = _Settled(bent.poses, used, distance, bent.edge_factor, bent.point_factor)
        used = allowed & (distance <= REJECTED_SIGMA)
        if np.array_equal(used, found.used) or used.sum() < FEWEST:
            break
    return found


def _whitened(fixes: Fixes, vectors: Floats) -> Floats:
    """Vectors (P, 3) in units of the fixes' own sigmas."""
    return np.asarray(np.einsum("nij,nj->ni", np.linalg.inv(np.linalg.cholesky(fixes.covariances)), vectors))


def _distance(bent: Bent, fixes: Fixes, used: Bools) -> Floats:
    """How far each position (P,) is from what all others say, in sigmas: what a used one contributes to its own pose is
    taken out along each axis of the pose's variance (leave-one-out, to first order).
    """
    found = fixes.found(bent.poses)
    half = np.linalg.inv(np.linalg.cholesky(fixes.covariances * bent.point_factor**2))
    known = half @ bent.covariances(fixes.vertices, found) @ np.swapaxes(half, 1, 2)
    values, axes = np.linalg.eigh(known)
    values = np.where(used[:, None], np.clip(values, 0, NEAR_CERTAIN), values)
    left = np.einsum("nij,ni->nj", axes, _whitened(fixes, fixes.points - found) / bent.point_factor)
    return np.asarray(np.sqrt((left**2 / np.where(used[:, None], 1 - values, 1 + values)).sum(axis=1)))

"""The solution that most edges agree with, and the probability that each edge is right, given that solution.

Pieces that were merged are never parted again, and where several wrong edges that agree came first, the right ones
stay outside. So a solution is mended where edges that it leaves out agree with each other and outweigh the edges it
uses. Each edge that is left out proposes a motion of the world for its second end. Edges that propose the same motion
are weighed against the lightest set of used edges that separates their ends, a minimum cut (Ford and Fulkerson 1956):
where that is lighter, the side of the cut moves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from hodge_pipeline import se3
from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.growth import Alignment, Proposals, align
from hodge_pipeline.diagnosis.rearrange import best_arrangement
from hodge_pipeline.diagnosis.robust_poses import ANNEALED, GATE, LARGE, TWICE, Fit, chi2_at, fit
from hodge_pipeline.solvers.backbone.chain import linear_forest, make_chain, sequential_edges
from hodge_pipeline.solvers.backbone.trust import COVERED, FEWEST_STEPS
from hodge_pipeline.types import Bools, Floats, Ints

PRIOR_SHARE = 0.25
"""Of the prior's log odds. The probability, its root of 1 - chi2 / gate among it, was chosen for calibration: of right
edges of 90 simulated rings, corridors and streets and 16 rooms, and of nine graphs of real fragments.
"""
EXTREME = 0.01
UNVOUCHED = 0.9
MOST_GROWTHS, WORTH = 3, 1e-3
"""Times that pieces grow again, while more than this share of the edges is to be won by it."""
SMALL = 3000
"""Vertices, up to which another solve costs little."""


def find_consensus(evidence: Evidence) -> tuple[Fit, Floats]:
    """The solution that most edges agree with, and the probability (E,) that each edge is right, given it."""
    grown = align(evidence)
    best = best_arrangement(evidence, fit(evidence, grown, TWICE)) if evidence.exhaustive else _mended(evidence, grown)
    best = _one_of_each_series(best, evidence)
    agreeing = np.sqrt(np.maximum(0.0, 1 - best.chi2 / GATE))
    return best, _unvouched(_with_prior(agreeing, evidence.prior), best, evidence)


def _one_of_each_series(best: Fit, evidence: Evidence) -> Fit:
    """The solution in which, of edges that exactly the same cycles pass, the one of the largest χ² alone is left out:
    nothing tests the others without it, and without two of them a piece would come off.
    """
    classes = series_classes(evidence.graph.edges, evidence.graph.vertex_count)
    out = np.flatnonzero(~best.used & (classes >= 0))
    out = out[np.lexsort((-best.chi2[out], classes[out]))]
    spared = out[1:][np.diff(classes[out]) == 0]
    chi2, used = best.chi2.copy(), best.used.copy()
    chi2[spared], used[spared] = 0.0, True
    return replace(best, chi2=chi2, used=used)


def _mended(evidence: Evidence, grown: Alignment) -> Fit:
    """The solution that grown pieces lead to where the order tells nothing of pairs that were tried."""
    graph, best = evidence.graph, _regrown(evidence, fit(evidence, grown, ANNEALED, rough=True))
    best = fit(evidence, best, (GATE,))
    if graph.edge_count > LARGE:  # one exact solve is all that there is time for
        return best
    if not best.used.all() and graph.vertex_count <= SMALL:
        # an error that is spread over a loop in annealing can put all of its edges out of use
        best = max(best, fit(evidence, grown, TWICE), key=_used)
    if not best.used.all() and (ordered := _in_order(evidence)) is not None:
        roughly = fit(evidence, ordered, ANNEALED, rough=True)
        best = max(best, fit(evidence, roughly, (GATE,)), key=_used)
    return mend(evidence, best)


def _in_order(evidence: Evidence) -> Alignment | None:
    """The alignment that begins with the paths of consecutive edges; None where these are too few for a sequence. Where
    a chain hangs by one end and by wrong edges, no cycle tells that it is these.
    """
    graph = evidence.graph
    steps = sequential_edges(graph)
    if steps.sum() < max(FEWEST_STEPS, COVERED * graph.vertex_count):
        return None
    chain = make_chain(graph, linear_forest(graph.edges, graph.vertex_count, steps))
    piece, poses = np.empty(chain.size, np.int64), np.empty((chain.size, 4, 4))
    piece[chain.order], poses[chain.order] = chain.path, chain.poses
    return align(evidence, Alignment(piece, poses))


def _used(found: Fit) -> int:
    return int(found.used.sum())


def _regrown(evidence: Evidence, best: Fit) -> Fit:
    """The solution whose pieces, as the edges hold them, no longer grow into any that more edges agree on."""
    worth = WORTH * len(evidence.graph.edges)
    for _ in range(MOST_GROWTHS):
        ends = best.piece[evidence.graph.edges]
        if (ends[:, 0] != ends[:, 1]).sum() < worth:
            break
        found = fit(evidence, align(evidence, best), ANNEALED, rough=True)
        won = _used(found) - _used(best)
        best = found if won > 0 else best
        if won < worth:
            break
    return best


def _unvouched(probability: Floats, fit: Fit, evidence: Evidence) -> Floats:
    """The probabilities, no larger than the prior for a used edge that is the only connection between two parts which
    edges left out connect otherwise: no cycle of edges that agree confirms it.
    """
    bridge = fit.bridge & ~evidence.in_no_listed_cycle
    return np.where(bridge, np.minimum(probability, UNVOUCHED * evidence.prior), probability)


def _with_prior(agreeing: Floats, prior: Floats) -> Floats:
    clipped = np.clip(agreeing, EXTREME, 1 - EXTREME)
    logit = np.log(clipped / (1 - clipped)) + PRIOR_SHARE * np.log(prior / (1 - prior))
    return np.asarray(1 / (1 + np.exp(-logit)))


ROUNDS, MOVES = 4, 40
"""Solves at most, and sets of views that move before each."""
MOST_PROPOSALS = 1200
"""Edges left out that are compared with each other; of more, evenly spread ones."""
TRIED = 40
"""Groups of them, the weightiest, for each move."""
LEAST_GAIN, AGREES = 3.0, 1.0
"""Nats: odds of 20 to 1 for a move, and the log-evidence of an edge that agrees beside its prior's. Of 96 simulated
graphs 422 wrong edges are kept at a gain of 0.5, 402 at 3 and 384 at 4, from which on fewer bands of views are mended.
"""
UNIT = 1000
"""Of a nat, since flows are whole numbers."""


def mend(evidence: Evidence, start: Fit) -> Fit:
    """The solution after the moves. An edge's log-evidence is AGREES and −log of its probability of being wrong."""
    log_evidence = AGREES - np.log1p(-evidence.prior)
    found = start
    for _ in range(ROUNDS):
        poses = _after_moves(evidence, found, log_evidence)
        if poses is None:
            break
        tried = fit(evidence, Alignment(found.piece, poses), TWICE)
        if log_evidence[tried.used].sum() <= log_evidence[found.used].sum():
            break
        found = tried
    return found


def _after_moves(evidence: Evidence, found: Fit, log_evidence: Floats) -> Floats | None:
    """Poses (V, 4, 4) after all moves that gain LEAST_GAIN; None where none does."""
    poses, moves = found.poses, 0
    while moves < MOVES:
        agreeing = np.maximum(0.0, 1 - chi2_at(evidence, poses, found.piece, found.resistance) / GATE)
        i, j = found.piece[evidence.graph.edges].T
        rows = np.flatnonzero((agreeing == 0) & (i == j) & (evidence.graph.edges[:, 0] != evidence.graph.edges[:, 1]))
        rows = rows[:: max(-(-len(rows) // MOST_PROPOSALS), 1)]
        proposals = Proposals.of(evidence, poses, rows)
        found_now = _good_moves(evidence, poses, found.piece, agreeing, log_evidence, proposals)
        if not found_now:
            break
        poses, moves = poses.copy(), moves + len(found_now)
        for inside, motion in found_now:
            poses[inside] = motion @ poses[inside]
    return poses if moves else None


def _good_moves(
    evidence: Evidence, poses: Floats, piece: Ints, agreeing: Floats, log_evidence: Floats, proposals: Proposals
) -> list[tuple[Bools, Floats]]:
    """The groups that outweigh their cuts, the weightiest first: the views (V,) that move, and how. No group has to do
    with views that move for another.
    """
    weight = proposals.alike @ log_evidence[proposals.edge]
    left = np.diff(proposals.alike.indptr) > 1
    moved, moves = np.zeros(len(poses), bool), []
    for _ in range(TRIED):
        left &= ~(moved[proposals.mover] | moved[proposals.stayer])
        if not left.any():
            break
        row = proposals.next(left, weight)
        group, alike = proposals.group(row)
        share = alike * log_evidence[proposals.edge[group]]
        inside = _cut(evidence, agreeing * log_evidence, proposals, group, share)
        if inside is None:
            continue
        whole = piece == piece[proposals.mover[row]]
        inside, motion = inside & whole, proposals.mean_motion(group, share, poses)
        if 2 * inside.sum() > whole.sum():  # the smaller part moves, so that others can at the same time
            inside, motion = whole & ~inside, se3.inverse(motion)
        if not (inside & moved).any():
            moves.append((inside, motion))
            moved |= inside
    return moves


def _cut(evidence: Evidence, held: Floats, proposals: Proposals, group: Ints, share: Floats) -> Bools | None:
    """The views (V,) on the movers' side of the lightest cut; None where it is not lighter than the group.

    An edge of the group whose ends are not parted counts as lost, as does each used edge that is.
    """
    count = evidence.graph.vertex_count
    source, sink = count, count + 1
    used = np.flatnonzero(held > 0)
    i, j = evidence.graph.edges[used].T
    mover, stayer = proposals.mover[group], proposals.stayer[group]
    tail = np.concatenate([i, j, np.full(len(group), source), mover])
    head = np.concatenate([j, i, stayer, np.full(len(group), sink)])
    weight = np.concatenate([held[used], held[used], share, share])
    capacity = csr_matrix((np.ceil(UNIT * weight).astype(np.int32), (tail, head)), shape=(count + 2, count + 2))
    left = capacity - maximum_flow(capacity, source, sink).flow
    left.eliminate_zeros()
    inside = np.ones(count + 2, bool)
    inside[breadth_first_order(left, source, return_predecessors=False)] = False
    won = share[inside[mover] & ~inside[stayer]].sum()
    lost = held[used][inside[i] != inside[j]].sum()
    return inside[:count] if won - lost > LEAST_GAIN else None

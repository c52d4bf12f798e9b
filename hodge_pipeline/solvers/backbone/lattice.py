"""Lattices and rooms, judged with a backbone and without: which of the two solutions explains more."""

from __future__ import annotations

import numpy as np

from hodge_pipeline.solvers.backbone.chain import make_chain
from hodge_pipeline.solvers.backbone.sequence import sequential_edges
from hodge_pipeline.solvers.backbone.step_tests import LONGEST_CYCLE, is_tested, pairs_across
from hodge_pipeline.solvers.backbone.trust import FEW_BREAKS, Backbone, find_backbone
from hodge_pipeline.types import Bools, Ints, ViewGraph

UNCONTRADICTED = 0.2
"""Share of the steps left out that no near loop contradicts, from which on groups of wrong loops are suspected: a step
that was measured wrong is contradicted by loops beside it. In simulated lattices of 200 to 1000 poses, 2 to 20 % of
whose edges are wrong, with and without triangles, it is up to .13; with groups of wrong loops .33 to 1.
"""
PLACES_PER_WRONG_STEP = 4.0
"""Number of mistaken places as likely as one wrong step that short cycles test and do not refute. In 28 simulated
graphs of a right odometry and 100 to 800 right edges over two to four steps, with 40 loops of mistaken places, these
are up to 2.3 times as many, but for four of the graphs. In a lattice none is tested so.
"""
SHARE_OF_PLACES = 0.25
"""Places that the backbone's loops join, as a share of those that the kept edges join, from which on it explains
enough: .2 to 1.2 in 28 simulated graphs whose loops, more than half as many as steps, are a third to two thirds
mistaken in one way; there the backbone was nearer to the truth in 24. In lattices with wrong steps 1 in 8 and less.
"""


def steps_are_wrong(graph: ViewGraph, kept: Bools, loops: Ints) -> bool:
    """Whether the edges `kept (E,)` without a backbone explain more than it, so that its breaks need not be sought.

    They have all `loops (K,)` that confirm it, and leave out `FEW_BREAKS` or more steps, which near loops contradict.
    """
    left_out, uncontradicted = left_out_steps(graph, kept)
    return bool(kept[loops].all()) and left_out >= FEW_BREAKS and not _is_rival(left_out, uncontradicted)


def left_out_steps(graph: ViewGraph, kept: Bools) -> tuple[int, int]:
    """How many of the consecutive edges are not `kept (E,)`, and how many of these no near loop contradicts.

    A step that was measured wrong is contradicted by a kept loop over few steps, or by a pair of kept loops across it.
    """
    chain = make_chain(graph, sequential_edges(graph))
    ends = np.unique(chain.ends[kept[chain.loop_edge]], axis=0)  # of 20,000 copies of a loop all are pairs
    short = ends[np.diff(ends, axis=1)[:, 0] <= LONGEST_CYCLE]
    left_out = chain.lacks(kept)
    across = pairs_across(ends, left_out | ~chain.inner)[1]
    uncontradicted = left_out & (chain.over(np.concatenate([short, across])) == 0)
    return int(left_out.sum()), int(uncontradicted.sum())


def _is_rival(left_out: int, uncontradicted: int) -> bool:
    return uncontradicted >= max(UNCONTRADICTED * left_out, 1)


def lattice_backbone(graph: ViewGraph, kept: Bools, doubted: Backbone | None = None) -> Backbone | None:
    """The backbone of a lattice or a room if it explains more than the edges `kept (E,)` without one, else None: it
    confirms loops of more places, or few places speak against it.

    It is a rival where the kept edges leave out steps that no near loop contradicts. A backbone that is `doubted` by
    its own loops is also one where it explains enough.
    """
    if doubted is not None and _explains_enough(doubted, kept):
        return doubted
    left_out, uncontradicted = left_out_steps(graph, kept)
    backbone = (doubted or find_backbone(graph, in_lattice=True)) if _is_rival(left_out, uncontradicted) else None
    if backbone is None:
        return None
    for_it, against = backbone.places(backbone.used & ~kept), backbone.places_against(kept)
    unlikely = left_out if doubted or not backbone.found.confirmed else uncontradicted
    weight = PLACES_PER_WRONG_STEP if is_tested(backbone.chain) else 1.0
    confirmed = backbone.found.confirmed and weight * for_it > against
    return backbone if confirmed or against < PLACES_PER_WRONG_STEP * unlikely else None


def _explains_enough(backbone: Backbone, kept: Bools) -> bool:
    """Whether a backbone with few breaks confirms loops that are not `kept (E,)`, and of `SHARE_OF_PLACES` as many
    places as those that are.
    """
    broken, own = backbone.steps & ~backbone.used, backbone.used & ~backbone.steps
    if not backbone.found.confirmed or broken.sum() >= FEW_BREAKS or not (own & ~kept).any():
        return False
    return backbone.places(own) >= SHARE_OF_PLACES * backbone.places(kept & ~backbone.steps)

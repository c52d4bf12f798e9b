"""The backbone of a lattice or a room, whose edges test each other, where it explains more than what these keep."""

from __future__ import annotations

from hodge_pipeline.solvers.backbone.step_tests import contradicted_from_afar, is_tested
from hodge_pipeline.solvers.backbone.trust import FEW_BREAKS, Backbone, find_backbone
from hodge_pipeline.types import Bools, ViewGraph

FROM_AFAR = 0.2
"""Of the steps that are left out. A step that was measured wrong is contradicted by loops beside it; one is left out
somewhere between the places of a mistake. In simulated lattices 2 to 20 % of whose edges are wrong, of 200 to 1000
poses with and without triangles, up to .13 are contradicted from afar; with groups of wrong loops .33 to 1.
"""
MOST_WRONG = 0.25
"""Of the steps. In these lattices up to .2 are left out; where hundreds of wrong loops join places near each other and
hide from afar which step is contradicted, .3 to .6.
"""
OF_BACKBONE = 4.0
"""Mistaken places that are as likely as one wrong edge of a backbone that short cycles test, where none refutes that
edge. In 28 simulated graphs of a right odometry and 100 to 800 right edges over two to four steps, with 40 loops
of mistaken places, these are up to 2.3 times as many, but for four of the graphs. In a lattice none is tested so.
"""


SHARE_OF_PLACES = 0.25
"""Of the places that the edges kept join, so many must the backbone's loops: .2 to 1.2 in 28 simulated graphs whose
loops, more than half as many as steps, are a third to two thirds mistaken in one way; there the backbone was nearer to
the truth in 24. In lattices with wrong steps 1 in 8 and less.
"""


def backbone_anyway(graph: ViewGraph, kept: Bools, doubted: Backbone | None = None) -> tuple[Backbone | None, bool]:
    """The backbone of a lattice or a room of which edges `kept (E,)` leave out steps that nothing near these
    contradicts, None elsewhere; and whether it confirms loops of more places than they keep in its stead, or none. One
    that is `doubted` also where it explains enough, or they leave out too many steps for a backbone that is wrong.
    """
    if doubted is not None and _explains_enough(doubted, kept):
        return doubted, True
    from_afar, out, steps = contradicted_from_afar(graph, kept)
    hidden = doubted is not None and out > MOST_WRONG * steps
    if from_afar < max(FROM_AFAR * out, 1) and not hidden:
        return None, False
    backbone = doubted or find_backbone(graph, anyway=True)
    if backbone is None:
        return None, False
    for_it, against = backbone.places(backbone.used & ~kept), backbone.places(kept & ~backbone.used)
    if (doubted or not backbone.found.confirmed) and against < OF_BACKBONE * out:
        return backbone, True
    worth = OF_BACKBONE if is_tested(backbone.chain) else 1.0
    return backbone, backbone.found.confirmed and worth * for_it > against


def _explains_enough(backbone: Backbone, kept: Bools) -> bool:
    """Whether a backbone with few breaks confirms loops of a fair share of the places that edges `kept (E,)` join, and
    others than these.
    """
    broken, own = backbone.steps & ~backbone.used, backbone.used & ~backbone.steps
    if not backbone.found.confirmed or broken.sum() >= FEW_BREAKS or not (own & ~kept).any():
        return False
    return backbone.places(own) >= SHARE_OF_PLACES * backbone.places(kept & ~backbone.steps)

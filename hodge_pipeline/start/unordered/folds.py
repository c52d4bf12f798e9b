"""Undo perceptual aliasing: look-alike places that were merged are told apart by free space in depth images.

The wrong edges may fit and agree with each other; but frames that no edge joins are brought together as well, and one
camera then sees through the surface that another saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.components import apart_along_x, connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.registration.assessment import MOST_VIOLATION
from hodge_pipeline.registration.odometry import REACHES_APART
from hodge_pipeline.start.unordered.hypotheses import ViewOf, violations
from hodge_pipeline.types import Bools, CloudSet, Floats, Ints, ViewGraph
from hodge_pipeline.types.arrays import evenly

MOST_PAIRS = 5000
"""Pairs of frames looked at: about a second."""
FOLDED_SHARE = 0.005
"""Share of pairs in free-space conflict above which a scene is folded; noise and moved objects stay below a tenth."""
CERTAIN = 2.0
"""Times `MOST_VIOLATION`: a violation that no noise explains."""
MOST_CUTS = 6
"""Each costs a diagnosis and a second of looking; pairs that then still contradict each other are reported."""
SURE = np.inf


@dataclass(frozen=True)
class Pieces:
    """The trusted edges, the component `piece (N,)` of each frame, its pose (N, 4, 4) in that component, and notes."""

    graph: ViewGraph
    piece: Ints
    poses: Floats
    notes: tuple[str, ...] = ()

    @classmethod
    def kept(cls, graph: ViewGraph, diagnosis: Diagnosis) -> Pieces:
        """The components and poses of the edges that the diagnosis keeps."""
        return cls(graph.select(diagnosis.kept), diagnosis.piece, diagnosis.world_from_cam)


@dataclass(frozen=True)
class Contradictions:
    """Pairs (C, 2) of one component in free-space conflict, and of how many pairs they are."""

    pairs: Ints
    looked_at: int

    @property
    def folded(self) -> bool:
        """Whether they are too many for noise."""
        return len(self.pairs) > max(1.0, FOLDED_SHARE * self.looked_at)


def contradictions(
    clouds: CloudSet, pieces: Pieces, held: Ints, view_of: ViewOf, room_m: float = 1.0
) -> Contradictions:
    """Free-space conflicts between frames of one component, whether an edge joins them or not.

    Pairs within a component `held (N,)` of odometry are left out: their conflicts are drift, not aliasing. `room_m`
    multiplies margins that are for rooms.
    """
    rows = np.flatnonzero(clouds.sizes > 0)
    i, j = np.triu_indices(len(rows), 1)
    every = np.stack([rows[i], rows[j]], axis=1)
    first, second = every.T
    chosen = (pieces.piece[first] == pieces.piece[second]) & (held[first] != held[second])
    pairs = every[np.flatnonzero(chosen)[evenly(int(chosen.sum()), MOST_PAIRS)]]
    motions = se3.inverse(pieces.poses[pairs[:, 0]]) @ pieces.poses[pairs[:, 1]]
    seen_through = violations(clouds, pairs, motions, view_of, room_m)
    certain = seen_through > CERTAIN * MOST_VIOLATION  # false for NaN
    return Contradictions(pairs[certain], int(np.isfinite(seen_through).sum()))


def unfolded(
    clouds: CloudSet,
    pieces: Pieces,
    given: int,
    view_of: ViewOf,
    options: DiagnosisOptions,
    room_m: float = 1.0,
) -> Pieces:
    """The components, cut until frames in conflict are apart; the first `given` edges are cut last."""
    held = connected_components(pieces.graph.edges[:given], len(pieces.piece))
    found = contradictions(clouds, pieces, held, view_of, room_m)
    if not found.folded:
        return pieces
    first, before = found, len(pieces.graph.edges)
    strength = pieces.graph.correspondences.astype(float)
    strength[:given] = SURE
    forbidden = found.pairs
    for _ in range(MOST_CUTS):
        kept = within_parts(pieces.graph.edges, strength, forbidden, len(pieces.piece))
        strength = strength[kept]
        graph = pieces.graph.select(kept)
        judged = diagnose(graph, options)
        strength = strength[judged.kept]
        pieces = Pieces.kept(graph, judged)
        found = contradictions(clouds, pieces, held, view_of, room_m)
        if not found.folded:
            break
        forbidden = np.unique(np.concatenate([forbidden, found.pairs]), axis=0)
    left = f", {len(found.pairs)} pairs still contradict each other" if len(found.pairs) else ""
    note = (
        f"places that look alike lay on each other: of {first.looked_at} pairs of frames that see the same space "
        f"{len(first.pairs)} contradict each other (one camera saw through the other's surface); "
        f"{before - len(pieces.graph.edges)} of {before} edges were cut{left}. Other edges of such places may be wrong "
        "too where nothing around them differs: check the pieces"
    )
    return Pieces(pieces.graph, pieces.piece, pieces.poses, (note,))


def within_parts(edges: Ints, strength: Floats, forbidden: Ints, count: int) -> Bools:
    """Which edges (E, 2) stay: added strongest first, unless they would connect a `forbidden` pair of vertices."""
    part = np.arange(count)
    enemies: list[set[int]] = [set() for _ in range(count)]
    for i, j in forbidden.tolist():
        enemies[i].add(j)
        enemies[j].add(i)
    for row in np.argsort(-strength, kind="stable").tolist():
        a, b = (int(part[vertex]) for vertex in edges[row])
        if a == b or b in enemies[a]:
            continue
        part[part == b] = a
        enemies[a] |= enemies[b]
        for other in enemies[b]:
            enemies[other].discard(b)
            enemies[other].add(a)
    return np.asarray(part[edges[:, 0]] == part[edges[:, 1]])


def laid_apart(piece: Ints, piece_from: Floats, clouds: CloudSet) -> Floats:
    """Poses (N, 4, 4) in one world: the first piece begins with the identity at its first frame, each other one
    without a turn, beside the one before it.

    `piece (N,)`, `piece_from (N, 4, 4)`: the piece of each frame and its pose in it. Pieces lie so far apart that
    no cloud reaches another's.
    """
    return apart_along_x(laid_at_first(piece, piece_from), piece, REACHES_APART * clouds.reach_m)


def laid_at_first(piece: Ints, piece_from: Floats) -> Floats:
    """Poses (N, 4, 4) in one world where each piece begins with the identity at its first frame."""
    first = np.unique(piece, return_index=True)[1]
    return np.asarray(se3.inverse(piece_from[first])[piece] @ piece_from)

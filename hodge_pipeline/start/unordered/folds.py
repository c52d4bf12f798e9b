"""Unfold scenes in which look-alike places were merged: free space in depth images shows that they are distinct.

Each edge of a fold may be flawless, and all of them agree; but frames that no edge joins are brought together too, and
one camera then sees through what the other saw.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.result import Diagnosis
from hodge_pipeline.start.unordered.hypotheses import MOST_VIOLATION, ViewOf, violations
from hodge_pipeline.types import Bools, CloudSet, Floats, Ints, ViewGraph
from hodge_pipeline.types.arrays import evenly

MOST_PAIRS = 5000
"""Pairs of frames looked at: about a second."""
FOLDED_SHARE = 0.005
"""Of the pairs that see each other's space; noisy cameras and objects that were moved stay below a tenth of it."""
CERTAIN = 2.0
"""Times the violation at which a hypothesis is refused: no noise explains it."""
MOST_CUTS = 6
SURE = np.inf


@dataclass(frozen=True)
class Pieces:
    """The edges that are trusted, the piece (N,) of each frame, its pose in it (N, 4, 4), and what was found."""

    graph: ViewGraph
    piece: Ints
    poses: Floats
    notes: tuple[str, ...] = ()

    @classmethod
    def kept(cls, graph: ViewGraph, diagnosis: Diagnosis) -> Pieces:
        """What is left of a graph when the diagnosis has spoken."""
        return cls(graph.select(diagnosis.kept), diagnosis.piece, diagnosis.world_from_cam)


@dataclass(frozen=True)
class Contradictions:
    """Pairs (C, 2) of one piece of which one camera saw through what the other saw, and of how many they are."""

    pairs: Ints
    looked_at: int

    @property
    def folded(self) -> bool:
        """Whether they are too many for noise."""
        return len(self.pairs) > max(1.0, FOLDED_SHARE * self.looked_at)


def contradictions(
    clouds: CloudSet, pieces: Pieces, held: Ints, view_of: ViewOf, room_m: float = 1.0
) -> Contradictions:
    """What free space says of frames that the poses bring together, whether an edge joins them or not; `room_m` is what
    a metre of a room is in this scene.

    Frames of one part `held (N,)` by odometry are left out: what contradicts there has drifted, and looks like nothing.
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
    """The pieces, cut where they hold frames that contradict each other; the first `given` edges are cut last."""
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
    left = f", {len(found.pairs)} still do" if len(found.pairs) else ""
    note = (
        f"places that look alike lay on each other: of {first.looked_at} pairs of frames that see the same space "
        f"{len(first.pairs)} contradict each other (one camera saw through the other's surface); "
        f"{before - len(pieces.graph.edges)} of {before} edges were cut{left}. Other edges of such places may be wrong "
        "too where nothing around them differs: check the pieces"
    )
    return Pieces(pieces.graph, pieces.piece, pieces.poses, (note,))


def within_parts(edges: Ints, strength: Floats, forbidden: Ints, count: int) -> Bools:
    """Which edges (E, 2) stay: they join `count` vertices, the strongest first, to parts without a forbidden pair."""
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

"""Loops that no cell fills: 2g generators of the surface's homology, and how far motions around them are off
(paper, Section 5, "we compute a set of the basis loops of the first homology group").
"""

from __future__ import annotations

import numpy as np

from hodge_paper.embedding import Embedding
from hodge_pipeline.complex.cycles import Loops, fundamental_loops, spanning_forest
from hodge_pipeline.types import Floats


def homology_generators(embedding: Embedding) -> Loops:
    """The 2g loops (of all components) that generate the homology of the surface, by a tree and a cotree.

    A spanning forest of the graph and one of the dual graph of cells, which crosses none of the first's edges, leave
    2g edges; each closes a loop through the first forest, from its own first vertex.
    """
    forest = spanning_forest(embedding.edges, embedding.vertex_count)
    cells_beside = embedding.cell_of_dart.reshape(-1, 2)[forest.chords]
    cotree = spanning_forest(cells_beside, len(embedding.cells))
    return fundamental_loops(forest, forest.chords[cotree.chords])


def motion_deviation(motions: Floats) -> tuple[Floats, Floats]:
    """‖t‖ (L,) in metres and ‖R − I₃‖_F (L,) of the motions around loops, as the paper adds them up (Section 5).

    Before a solve: of the products of measured edges; after it: of those of `adjusted_edges`.
    """
    translation = np.linalg.norm(motions[:, :3, 3], axis=1)
    rotation = np.linalg.norm(motions[:, :3, :3] - np.eye(3), axis=(1, 2))
    return np.asarray(translation), np.asarray(rotation)

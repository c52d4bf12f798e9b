"""Loops that a robust optimiser may switch off, as Vertigo writes them to g2o files: read as plain edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hodge_adapters.pose_graphs.text import Records
from hodge_pipeline.types.text import counted

SPATIAL, PLANAR, MIXTURE = "EDGE_SE3_SWITCHABLE", "EDGE_SE2_SWITCHABLE", "EDGE_SE2_MAXMIX"
PLAIN = {SPATIAL: "EDGE_SE3:QUAT", PLANAR: "EDGE_SE2", MIXTURE: "EDGE_SE2"}
KEYS = {SPATIAL: 3, PLANAR: 3, MIXTURE: 2}
COLUMNS = {SPATIAL: (28,), PLANAR: (9,), MIXTURE: (10,)}
"""The third id of a switchable edge is its switch; the weight of a mixture stands before the motion."""
SWITCH_TAGS = frozenset(("VERTEX_SWITCH", "EDGE_SWITCH_PRIOR"))
"""The switches themselves, and what they were before they were optimised."""


def as_edges(records: dict[str, Records]) -> tuple[dict[str, Records], list[str]]:
    """The records with such loops behind the plain edges of their dimension, and a note for each kind.

    Information is unknown to all edges of a dimension some of which state none.
    """
    out, notes = dict(records), []
    for tag, plain in PLAIN.items():
        loops, edges = records[tag], out[plain]
        if not len(loops):
            continue
        values = loops.values[:, 1:] if tag == MIXTURE else loops.values
        columns = min(values.shape[1], edges.values.shape[1]) if len(edges) else values.shape[1]
        out[plain] = replace(
            edges,
            line_numbers=np.concatenate([edges.line_numbers, loops.line_numbers]),
            keys=np.concatenate([edges.keys, loops.keys[:, :2]]),
            values=np.concatenate([edges.values[:, :columns], values[:, :columns]]),
        )
        notes.append(f"{counted(len(loops), 'edge')} of kind {tag} read as {plain}, whatever the switch or weight")
    return out, notes

"""The connected components of a graph, ordered by size and described in words."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components as csgraph_components

from hodge_pipeline.complex.coboundary import check_edges
from hodge_pipeline.types import Bools, Floats, Ints
from hodge_pipeline.types.text import counted

MOST_PIECES_LISTED, MAX_RUNS_LISTED = 8, 12
"""In a note; of more their number."""


def connected_components(edges: Ints, vertex_count: int) -> Ints:
    """The component (V,) of each vertex: 0 the largest; of equal ones, that with the first vertex comes first."""
    edges = np.asarray(edges, np.int64).reshape(-1, 2)
    check_edges(edges, vertex_count)
    ones = np.ones(len(edges), np.int32)  # parallel edges are summed: 256 of them would be none in 8 bits
    adjacency = csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(vertex_count, vertex_count))
    return by_size(csgraph_components(adjacency, directed=False)[1])


def by_size(label: Ints) -> Ints:
    """Labels (V,) of components, renumbered: 0 the largest; of equal ones, that with the first vertex comes first."""
    _, first, row, size = np.unique(label, return_index=True, return_inverse=True, return_counts=True)
    rank = np.empty(len(size), np.int64)
    rank[np.lexsort((first, -size))] = np.arange(len(size))
    return np.asarray(rank[row.reshape(-1)], np.int64)


def first_of_component(component: Ints) -> Bools:
    """Where (V,) a vertex is the first of its component: its gauge vertex."""
    first = np.zeros(len(component), bool)
    first[np.unique(component, return_index=True)[1]] = True
    return first


def apart_along_x(world_from_cam: Floats, component: Ints, space_m: float) -> Floats:
    """The poses (V, 4, 4), the components moved along x so that each begins `space_m` beside the one before it."""
    out, count = np.array(world_from_cam, float), int(component.max(initial=-1)) + 1
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, component, out[:, 0, 3])
    np.maximum.at(high, component, out[:, 0, 3])
    begin = low[:1] + np.concatenate([np.zeros(1), np.cumsum(high - low + space_m)])[:count]
    out[:, 0, 3] += (begin - low)[component]
    return out


def describe_components(component: Ints, vertex_ids: NDArray[np.generic]) -> tuple[str, ...]:
    """One warning that lists the pieces of a graph that is not connected, else nothing."""
    sizes = np.bincount(component)
    if len(sizes) <= 1:
        return ()
    several = np.flatnonzero(sizes > 1)
    named = [(int(piece), vertex_ids[component == piece]) for piece in several[:MOST_PIECES_LISTED]]
    pieces = [
        f"piece {piece}: {counted(len(names), 'vertex|vertices')} ({names[0]} … {names[-1]})" for piece, names in named
    ]
    if len(several) > MOST_PIECES_LISTED:
        pieces.append(f"{len(several) - MOST_PIECES_LISTED} smaller pieces")
    single = vertex_ids[np.isin(component, np.flatnonzero(sizes == 1))]
    if len(single):
        shown = ", ".join(str(name) for name in single[:MOST_PIECES_LISTED])
        rest = ", …" if len(single) > MOST_PIECES_LISTED else ""
        pieces.append(f"{len(single)} without any edge ({shown}{rest})")
    text = "; ".join(pieces)
    return (f"graph falls into {len(sizes)} pieces, each with its own gauge: {text}",)


def in_runs(rows: Ints, vertex_ids: Ints | np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> str:
    """Ascending rows in words, `0–120, 124, 130–131`, as the source names their frames."""
    if not len(rows):
        return "none"
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    words = [f"{vertex_ids[run[0]]}" + (f"–{vertex_ids[run[-1]]}" if len(run) > 1 else "") for run in runs]
    more = f", and {len(runs) - MAX_RUNS_LISTED} more" if len(runs) > MAX_RUNS_LISTED else ""
    return ", ".join(words[:MAX_RUNS_LISTED]) + more

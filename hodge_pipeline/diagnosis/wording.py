"""The verdict of each edge in a line that a person can check."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.series import series_classes
from hodge_pipeline.diagnosis.cycles import Cycles
from hodge_pipeline.diagnosis.result import CONSISTENT, UNTESTABLE, WRONG
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

LONGEST_NAMED = 12
"""Most vertices of a cycle that are all named."""
MOST_NAMED = 4
"""Most edges sharing the blame that are all named; else their number is."""
TOO_LONG = "every loop through it is too long to be listed: nothing tests it"


def name_cycle(graph: ViewGraph, cycles: Cycles, row: int) -> str:
    """The vertices along a cycle, `3-7-12`, the middle of a long one left out."""
    loops = cycles.loops
    entry = slice(loops.offsets[row], loops.offsets[row + 1])
    tails = graph.edges[loops.edge[entry], np.where(loops.sign[entry] > 0, 0, 1)]
    names = list(map(str, graph.vertex_ids[tails].tolist()))
    if len(names) > LONGEST_NAMED:
        names = [*names[:6], f"({len(names) - 9} more)", *names[-3:]]
    return "-".join(names)


def reasons(
    graph: ViewGraph,
    cycles: Cycles,
    verdict: NDArray[np.str_],
    witnesses: tuple[Ints, Ints],
    undecided: Ints,
    bridge: Bools,
    residual: tuple[Floats, Floats],
) -> tuple[str, ...]:
    """One line for each edge: which cycles close, and how far it is from the poses.

    `bridge (E,)`: used edges that are the only connection between two parts which edges left out would join too.
    """
    count = graph.edge_count
    passing = np.bincount(cycles.loops.edge, minlength=count)
    closed = cycles.loops.sums_at_edges(cycles.closes, count).astype(np.int64)
    sound = _sound(cycles, (verdict == CONSISTENT) | (verdict == UNTESTABLE))
    in_loop = _in_loop(graph, (passing == 0) & (verdict == UNTESTABLE))
    lines = []
    for edge in range(count):
        if undecided[edge] >= 0:
            why = "edges as far apart as this one often are" if verdict[edge] == WRONG else "no other cycle says which"
            lines.append(f"{_undecided(graph, cycles, int(undecided[edge]), undecided >= 0)}, and {why}")
        elif verdict[edge] == UNTESTABLE:
            lines.append(TOO_LONG if in_loop[edge] else "no cycle passes it: nothing in the graph can test it")
        else:
            good = verdict[edge] == CONSISTENT
            witness = int(witnesses[0 if good else 1][edge, 0])
            text = f"{closed[edge]} of {passing[edge]} cycles close"
            away = distance(residual[0][edge], residual[1][edge])
            if witness >= 0:
                text += f"; {name_cycle(graph, cycles, witness)} {cycle_error(cycles, witness)}"
            elif not good:
                text += _over_what(int(closed[edge]), int(sound[edge]))
                away = _against(bool(bridge[edge]), away)
            lines.append(f"{text}; {away}")
    return tuple(lines)


def _in_loop(graph: ViewGraph, wanted: Bools) -> Bools:
    """Which of the wanted edges (E,) some cycle passes, listed or not."""
    if not wanted.any():
        return wanted
    proper = graph.edges[:, 0] != graph.edges[:, 1]
    return np.asarray(wanted & proper & (series_classes(graph.edges, graph.vertex_count) >= 0))


def _sound(cycles: Cycles, kept: Bools) -> Ints:
    """How many cycles (E,) close over each edge and have only kept edges beside it."""
    loops = cycles.loops
    others = loops.sums(~kept)[loops.rows] - ~kept[loops.edge]
    return np.bincount(loops.edge, cycles.closes[loops.rows] & (others == 0), len(kept)).astype(np.int64)


def _over_what(closed: int, sound: int) -> str:
    if not closed:
        return ""
    return f", {sound} of them over kept edges alone" if sound else ", each over another edge that is left out"


def _against(is_bridge: bool, away: str) -> str:
    """Evidence against an edge none of whose cycles fails."""
    if is_bridge:
        return "it alone holds two parts together, which edges that were left out would join otherwise"
    return f"all kept edges together place its ends elsewhere: {away}"


def _undecided(graph: ViewGraph, cycles: Cycles, row: int, doubted: Bools) -> str:
    entry = slice(cycles.loops.offsets[row], cycles.loops.offsets[row + 1])
    edges = cycles.loops.edge[entry]
    mates = np.sort(edges[doubted[edges]])
    if len(mates) == len(edges):
        which = f"one of its {len(edges)} edges"
    elif len(mates) > MOST_NAMED:
        which = f"one of {len(mates)} of its {len(edges)} edges"
    else:
        which = "one of " + ", ".join(f"{i}-{j}" for i, j in graph.vertex_ids[graph.edges[mates]].tolist())
    loop = f"the loop {name_cycle(graph, cycles, row)} {cycle_error(cycles, row)}"
    return f"{loop}: {which} is wrong"


def cycle_error(cycles: Cycles, row: int) -> str:
    """Whether a cycle closes, and by how much it does not, in words."""
    verb = "closes to" if cycles.closes[row] else "fails by"
    return f"{verb} {_amount(cycles.displacement_m[row], np.degrees(cycles.angle_rad[row]))}"


def distance(metres: float, degrees: float) -> str:
    """How far an edge is from the poses, in words; not finite between pieces."""
    if not np.isfinite(metres):
        return "its ends lie in different pieces"
    return f"{_amount(metres, degrees)} from the poses"


def _amount(metres: float, degrees: float) -> str:
    return f"{round(metres, 9):.3g} m, {round(degrees, 9):.3g}°"  # rounding errors are 0

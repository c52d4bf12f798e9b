"""Whether a graph has a backbone that can be trusted, and the loops judged on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from hodge_pipeline import se3
from hodge_pipeline.complex.chi2 import chi2_by_information, has_unit_information, tail_gate, tail_weight
from hodge_pipeline.errors import GraphError
from hodge_pipeline.solvers.backbone.bridged import MOST_BREAKS, infer_bridged
from hodge_pipeline.solvers.backbone.chain import Chain, make_chain
from hodge_pipeline.solvers.backbone.credible import credible_steps
from hodge_pipeline.solvers.backbone.evidence import BY_CHANCE
from hodge_pipeline.solvers.backbone.inference import Inferred
from hodge_pipeline.solvers.backbone.linear import Linear, inverse
from hodge_pipeline.solvers.backbone.loop_places import one_of_each_place
from hodge_pipeline.solvers.backbone.mistakes import shared_shift
from hodge_pipeline.solvers.backbone.parallel import Fused, fused, loops_once
from hodge_pipeline.solvers.backbone.polish import LOCAL
from hodge_pipeline.solvers.backbone.sequence import (
    COVERED,
    consecutive_edges,
    linear_forest,
    numbered_along_path,
    sequential_edges,
    vertex_ranks,
)
from hodge_pipeline.solvers.backbone.step_lengths import misstated_lengths
from hodge_pipeline.solvers.backbone.step_tests import LOOPS_AT_A_STEP, agreeing_loops, is_tested
from hodge_pipeline.solvers.backbone.window import windowed
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.weights import moves_in_plane
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph
from hodge_pipeline.types.text import counted

AUTO, SEQUENTIAL, NONE = "auto", "sequential", "none"
FEWEST_STEPS, MOST_PATHS = 10, 10
"""Of a backbone that `auto` looks for: its paths have on average at least this many steps times the number of paths, up
to this many, since loops must join them: one path 10 steps, ten paths or more 100 each.
"""
AGREEING_REFUSED = 0.05
"""Loops per step that the backbone refuses though they agree with each other, beyond which the backbone is in doubt,
where loops are many: see `lattice_backbone`.
"""
FEW_BREAKS = 3
"""Breaks of a backbone with many loops at which the search for more ends and the backbone is in doubt."""


@dataclass(frozen=True)
class Backbone:
    """The trusted edges of a graph, and its other edges, the loops, judged on them.

    - `steps (E,)`: edges of the backbone; `used (E,)`: steps that are not broken, and loops that count.
    - `right (E,)`: the probability of each loop, NaN for steps; `chi2 (E,)`: of each loop at poses solved without it.
    - `loop_width (M,)`: factors on the standard deviations of the chain's loops for the last solve.
    - `merged (E,)`: steps that measure one or several other steps again; `contradicted (E,)`: steps and loops that do
      not count, since edges over the same steps contradict them.
    - `world_from_cam (V, 4, 4)`: each path begins at the identity where no loop ties it.
    - `doubted`: whether many loops agree with each other and not with the backbone, or it is broken at several steps,
      so that the backbone itself may be wrong.
    - `named`: what notes call its edges; `vertex_ids (V,)`.
    """

    chain: Chain
    found: Inferred
    steps: Bools
    used: Bools
    right: Floats
    chi2: Floats
    loop_width: Floats
    merged: Bools
    contradicted: Bools
    world_from_cam: Floats
    doubted: bool
    vertex_ids: NDArray[Any]
    named: str = "consecutive edges"

    def weighted(self, graph: ViewGraph) -> ViewGraph:
        """The graph of the used edges, with information scaled to the errors that were learned, and without bias."""
        step, loop = self.found.scales.units(self.chain)
        width = np.ones((graph.edge_count, len(self.chain.axes)))
        width[self.steps] = step * LOCAL
        unit = has_unit_information(graph)
        if unit:  # n measurements of a step, or one over g steps, weigh as much less each
            spans = self.chain.spans(graph.edges[self.steps])
            times = np.median(self.chain.over(spans)[self.chain.step_edge >= 0])
            width[self.steps] *= np.sqrt(times * np.diff(spans, axis=1))
        graph, _ = credible_steps(self.unbiased(graph), self.steps)
        width[self.chain.loop_edge] = loop * self.loop_width[:, None]
        whole = np.ones((graph.edge_count, 6))
        whole[:, self.chain.axes] = width
        information = graph.information / (whole[:, :, None] * whole[:, None, :])
        if unit:
            rows = np.arange(graph.edge_count)[:, None, None]
            axes = rows, self.chain.axes[:, None], self.chain.axes
            information[axes] = inverse(self.chain.of_both_ends(graph.i_from_j, inverse(information[axes])))
        return replace(graph, information=information).select(np.flatnonzero(self.used))

    def unbiased(self, graph: ViewGraph) -> ViewGraph:
        """The graph with the motions of steps without the bias that the chain lacks."""
        if not self.chain.bias.any():
            return graph
        raw, edges = self.chain.turned(self.chain.bias).poses, np.argsort(self.chain.order)[graph.edges[self.steps]]
        before, after = (se3.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] for poses in (raw, self.chain.poses))
        motions = graph.i_from_j.copy()
        motions[self.steps] = motions[self.steps] @ se3.inverse(before) @ after
        return replace(graph, i_from_j=motions)

    def places(self, edges: Bools) -> int:
        """How many pairs of places these edges (E,) join; see `Chain.places`."""
        chain = self.found.scales.applied(self.chain)
        at = np.flatnonzero(chain.step_edge >= 0)
        ends = np.concatenate([chain.ends, np.stack([at - 1, at], axis=1)])
        chosen = edges[np.concatenate([chain.loop_edge, chain.step_edge[at]])]
        return len(one_of_each_place(replace(chain, ends=ends).places[chosen]))

    def places_against(self, edges: Bools) -> int:
        """How many pairs of places those of the edges (E,) join that it leaves out, a shared shift counting as one."""
        against, shifts = edges & ~self.used, 0
        for each in self.found.mistakes():
            rows = self.chain.loop_edge[each.rows]
            if each.nats > BY_CHANCE and each.is_shift and against[rows].any():
                against[rows] = False
                shifts += 1
        return self.places(against) + shifts

    @property
    def loops_used(self) -> Bools:
        """Which loops (M,) count."""
        return self.used[self.chain.loop_edge]

    @property
    def notes(self) -> tuple[str, ...]:
        """Which edges are trusted, and how many loops they confirm; and `findings`."""
        return self._trusted, *self.findings

    @cached_property
    def findings(self) -> tuple[str, ...]:
        """What is wrong with many edges at once: the bias of steps, a wrong length that they share, and a shift that
        unused loops share.
        """
        turn_deg = np.degrees(np.linalg.norm(self.chain.bias))
        biased = f"{self.named} turn {turn_deg:.2g}° too far each, which is taken out" if turn_deg else ""
        return tuple(each for each in (biased, *self._wrong_lengths, self._shared_mistake) if each)

    @property
    def _wrong_lengths(self) -> tuple[str, ...]:
        """Which steps are too long or too short against the loops, and by how many times."""
        found, told = self.found, []
        if not found.confirmed:
            return ()
        for each in misstated_lengths(found.start.chain, found.linear.poses, np.flatnonzero(found.used)):
            at = np.flatnonzero(each.of)
            first, last = self.vertex_ids[found.start.chain.order[[at[0] - 1, at[-1]]]]
            which = "" if each.of_all else f" of vertices {first} to {last}"
            times, how = (each.factor, "long") if each.factor > 1 else (1 / each.factor, "short")
            what = f"{self.named}{which} are {times:.2f} times too {how} against the loops"
            told.append(f"{what}, which is left so: check their scale")
        return tuple(told)

    @property
    def _trusted(self) -> str:
        loops, used, more = len(self.chain.loop_edge), int(self.loops_used.sum()), int(self.merged.sum())
        repeated = f" and {more} that state the same steps again" if more else ""
        trusted = f"{int(self.steps.sum()) - more} {self.named}{repeated} are trusted as a backbone"
        if not self.found.confirmed:
            return f"{trusted}, {counted(loops, 'loop')} that nothing confirms: the poses are the backbone's"
        broken = int((self.steps & ~self.used).sum())
        called_wrong = f", {broken} of them called wrong by the others or the loops" if broken else ""
        scales = self.found.scales
        if not self.chain.stated:
            errors = "; errors as loops show them, since the information lacks some"
        elif scales.steps_surprise:
            errors = f"; these edges then err {scales.of_steps:.2g} times what they state, or the loops are wrong alike"
        else:
            errors = ""
        return f"{trusted}{called_wrong}, {used} of {loops} loops confirmed{errors}"

    @property
    def _shared_mistake(self) -> str:
        """Where most unused loops agree on one shift in the world's axes: how many, and how far; else empty."""
        found, first = self.found, next(self.found.mistakes(), None)
        if first is None or first.nats < BY_CHANCE:
            return ""
        shift, alike = shared_shift(found.linear.chain, found.linear.poses, first.rows)
        if 2 * alike < (~found.used).sum():
            return ""
        return f"{alike} loops left out agree on a shift of {np.linalg.norm(shift):.3g} m: places that look alike"


def find_backbone(
    graph: ViewGraph,
    trust: str = AUTO,
    *,
    in_lattice: bool = False,
    most_breaks: int = MOST_BREAKS,
    is_lattice: Callable[[Ints], bool] = lambda loops: False,
) -> Backbone | None:
    """The backbone of a graph; None where it has none that should be trusted.

    - `trust`: `auto` learns from the graph whether its consecutive edges are a backbone, which those of a lattice or a
      room are not; `sequential` trusts them, `none` no edge; any other word the edges of that `source`.
    - `in_lattice`: the backbone, without breaks, of a lattice or a room, and None elsewhere.
    - `most_breaks`: steps that loops may call wrong.
    - `is_lattice`: asked where loops are many and the backbone without breaks is in doubt, with the loops (K,) that it
      uses; if so, no breaks are sought.

    Raises `GraphError` where there are no such edges.
    """
    if trust == NONE or not graph.edge_count:
        return None
    ids, graph = graph.vertex_ids, replace(graph, dimension=2 if moves_in_plane(graph) else 3)
    graph = numbered_along_path(graph) if trust in (AUTO, SEQUENTIAL) else graph
    chosen = consecutive_edges(graph) if trust in (AUTO, SEQUENTIAL) else _of_source(graph, trust)
    repeats = chosen.copy()
    if trust not in (AUTO, SEQUENTIAL):  # repeats of edges outside its paths are loops, as these edges are
        pair = np.sort(graph.edges, axis=1) @ [graph.vertex_count, 1]
        repeats &= np.isin(pair, pair[_in_order(graph, repeats)])
    single = loops_once(fused(graph, repeats), ~chosen) if chosen.any() else fused(graph, repeats)
    single = windowed(single) if trust in (AUTO, SEQUENTIAL) else single
    backbone = _of_single_steps(
        single.graph, trust, in_lattice, most_breaks, lambda loops: is_lattice(single.rows[loops])
    )
    if backbone is None:
        return None
    named = backbone.named if trust in (AUTO, SEQUENTIAL) else f"edges of {trust}"
    return _of_all_edges(graph, replace(backbone, named=named, vertex_ids=ids), single)


def _of_single_steps(
    graph: ViewGraph, trust: str, in_lattice: bool, most_breaks: int, is_lattice: Callable[[Ints], bool]
) -> Backbone | None:
    """The backbone of a graph with one edge for each step: see `find_backbone`."""
    chosen = sequential_edges(graph) if trust in (AUTO, SEQUENTIAL) else _of_source(graph, trust)
    if trust == AUTO and chosen.sum() < max(FEWEST_STEPS, COVERED * graph.vertex_count):
        return None
    if not chosen.any():
        raise GraphError("no edge joins consecutive vertices, so that there is no sequence to trust: use --trust none")
    steps = chosen if trust in (AUTO, SEQUENTIAL) else _in_order(graph, chosen)
    chain = make_chain(graph, steps)
    if not len(chain.loop_edge):
        return None
    paths = len(np.unique(chain.path[chain.step_edge >= 0]))
    if trust == AUTO and steps.sum() < FEWEST_STEPS * min(paths, MOST_PATHS) * paths:
        return None
    many_loops = trust == AUTO and len(chain.loop_edge) > LOOPS_AT_A_STEP * steps.sum()
    if in_lattice and not many_loops or not in_lattice and many_loops and is_tested(chain):
        return None
    trusted = chosen[chain.loop_edge]  # edges of a trusted source that are in no path
    most = 0 if in_lattice else min(most_breaks, FEW_BREAKS if many_loops else MOST_BREAKS)

    def is_doubted(found: Inferred) -> bool:
        chain = found.start.chain
        agree = agreeing_loops(chain, ~found.used)
        return bool(chain.broken.sum() >= FEW_BREAKS or agree > AGREEING_REFUSED * steps.sum())

    inferred = infer_bridged(
        chain,
        trusted,
        may_thin=in_lattice or not many_loops,
        most=most,
        is_sought=lambda unbroken: (
            not (many_loops and is_doubted(unbroken) and is_lattice(chain.loop_edge[unbroken.used]))
        ),
    )
    if inferred is None:
        return None
    chain, found = inferred
    doubted = many_loops and is_doubted(found)
    if in_lattice or len(found.reduced.active) >= found.used.sum():
        return _backbone(graph, chain, found, found.polished, steps, doubted)
    never_wrong = steps.copy()
    never_wrong[chain.loop_edge] = trusted
    as_judged = found.linear, np.ones(len(found.used))
    return of_every_loop(graph, _backbone(graph, chain, found, as_judged, steps, doubted), never_wrong)


def _of_source(graph: ViewGraph, source: str) -> Bools:
    chosen = np.array([source in word.split("+") for word in graph.source.tolist()], bool)
    if not chosen.any():
        known = ", ".join(sorted(set(graph.source.tolist())))
        raise GraphError(f"--trust {source}: no edge comes from it; the edges come from {known}")
    return chosen


def _in_order(graph: ViewGraph, chosen: Bools) -> Bools:
    """Edges (E,) among the chosen ones that make paths, those between neighbours in the order of ids first."""
    return linear_forest(vertex_ranks(graph)[graph.edges], graph.vertex_count, chosen)


def _backbone(
    graph: ViewGraph, chain: Chain, found: Inferred, solved: tuple[Linear, Floats], steps: Bools, doubted: bool
) -> Backbone:
    used, right, chi2 = steps.copy(), np.full(graph.edge_count, np.nan), np.full(graph.edge_count, np.nan)
    used[chain.loop_edge] = found.used
    used[chain.step_edge[chain.broken]] = False
    probability = expit(found.judged.log_odds)
    right[chain.loop_edge] = np.where(found.used, probability, np.minimum(probability, UNUSED))
    chi2[chain.loop_edge] = found.judged.chi2
    poses = np.empty((graph.vertex_count, 4, 4))
    poses[chain.order] = solved[0].poses
    none = np.zeros_like(used)
    return Backbone(chain, found, steps, used, right, chi2, solved[1], none, none, poses, doubted, graph.vertex_ids)


def _of_all_edges(graph: ViewGraph, backbone: Backbone, one: Fused) -> Backbone:
    """The backbone of the fused graph `one`, in rows of `graph`; a merged edge is used where none of its steps is
    broken, a copy where what it is fused into is.
    """
    chain, rows = backbone.chain, np.append(one.rows, -1)
    chain = replace(chain, step_edge=rows[chain.step_edge], loop_edge=one.rows[chain.loop_edge])
    chain, again, one = _with_copies(chain, one)
    steps, used, merged, contradicted = np.zeros((4, graph.edge_count), bool)
    right, chi2 = np.full((2, graph.edge_count), np.nan)
    steps[one.rows], used[one.rows] = backbone.steps, backbone.used
    right[one.rows], chi2[one.rows] = backbone.right, backbone.chi2
    for value in (used, right, chi2):
        value[one.copies] = value[one.copied]
    merged[one.merged] = steps[one.merged] = contradicted[one.contradicted] = True
    used &= ~(steps & contradicted)
    contradicted &= ~used
    low, high = chain.spans(graph.edges[one.merged]).T
    broken = np.cumsum(chain.broken)
    repeats = (high - low == 1) & contradicted[chain.step_edge[high]]
    used[one.merged], contradicted[one.merged] = (broken[low] == broken[high]) & ~repeats, repeats
    return replace(
        backbone,
        chain=chain,
        steps=steps,
        used=used,
        right=right,
        chi2=chi2,
        loop_width=backbone.loop_width[again] * np.sqrt(np.bincount(again)[again]),
        merged=merged,
        contradicted=contradicted,
    )


def _with_copies(chain: Chain, one: Fused) -> tuple[Chain, Ints, Fused]:
    """The chain with copies as loops of their own, which of its loops each is (M',), and the fused graph whose copies
    are of loops alone: those of loops that a window took are merged or contradicted as these are.
    """
    place = dict(zip(chain.loop_edge.tolist(), range(len(chain.loop_edge)), strict=True))
    is_loop = np.isin(one.copied, chain.loop_edge)
    again = np.array([*place.values(), *(place[row] for row in one.copied[is_loop].tolist())], np.int64)
    merged, contradicted = (
        np.concatenate([rows, one.copies[np.isin(one.copied, rows)]]) for rows in (one.merged, one.contradicted)
    )
    copies, copied = one.copies[is_loop], one.copied[is_loop]
    one = replace(one, merged=merged, contradicted=contradicted, copies=copies, copied=copied)
    return replace(chain.with_loops(again, chain.ends[again]), loop_edge=np.append(chain.loop_edge, copies)), again, one


def of_every_loop(graph: ViewGraph, backbone: Backbone, trusted: Bools) -> Backbone:
    """The backbone at the poses of all used loops, solved with Student's t, where only some were active in judging
    them.

    A loop whose χ² exceeds that of one right loop among as many is dropped, unless it is `trusted (E,)`.
    """
    size, rows, weighted = len(backbone.chain.axes), np.flatnonzero(backbone.used), backbone.weighted(graph)
    rare = 1 / backbone.loops_used.sum()
    gate = tail_gate(size, rare)
    poses, weight, off = backbone.world_from_cam, np.ones(len(rows)), np.zeros(len(rows), bool)
    for _ in range(MOST_SOLVED):
        heavy_tailed = replace(weighted, information=weighted.information * weight[:, None, None])
        poses = solve(heavy_tailed, start=poses, initial="given", relative_tolerance=TOLERANCE).world_from_cam
        chi2 = np.where(trusted[rows], 0.0, chi2_by_information(weighted, poses))
        before, off = off, chi2 > gate
        if (off == before).all():
            break
        weight = np.minimum(tail_weight(chi2, size), 1.0)
    used, right = backbone.used.copy(), backbone.right.copy()
    used[rows[off]], right[rows[off]] = False, rare
    return replace(backbone, used=used, right=right, world_from_cam=poses)


MOST_SOLVED, TOLERANCE = 5, 1e-4
"""Reweighted solves, each in seconds for 100,000 edges; and the relative tolerance of χ²."""
UNUSED = 0.49
"""Largest probability that is reported of an unused loop."""

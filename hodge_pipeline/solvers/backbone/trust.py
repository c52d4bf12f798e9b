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
from hodge_pipeline.solvers.backbone.levels import FEWEST, NEARLY_ALL, TOLERANCE
from hodge_pipeline.solvers.backbone.linear import Linear, inverse
from hodge_pipeline.solvers.backbone.loop_places import one_of_each_place
from hodge_pipeline.solvers.backbone.mistakes import shared_shift
from hodge_pipeline.solvers.backbone.parallel import Fused, fused, loops_once
from hodge_pipeline.solvers.backbone.polish import LOCAL, ROUNDS
from hodge_pipeline.solvers.backbone.sequence import (
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
MOST_PATHS = 10
"""Paths of a backbone that `auto` looks for have on average at least `FEWEST` steps times their number, up to this
many, since loops must join them: one path 10 steps, ten paths or more 100 each.
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

    def weighted(self, graph: ViewGraph, *, correlated: bool = True) -> ViewGraph:
        """The graph of the used edges, with information scaled to the errors that were learned, and without bias;
        `correlated`: as the last solve takes them, else as independent.
        """
        step, loop = self.found.scales.units(self.chain)
        width = np.ones((graph.edge_count, len(self.chain.axes)))
        width[self.steps] = step * (LOCAL if correlated else 1.0)
        unit = has_unit_information(graph)
        if unit:  # n measurements of a step, or one over g steps, weigh as much less each
            spans = self.chain.spans(graph.edges[self.steps])
            times = np.median(self.chain.over(spans)[self.chain.step_edge >= 0])
            width[self.steps] *= np.sqrt(times * np.diff(spans, axis=1))
        graph, _ = credible_steps(self.unbiased(graph), self.steps)
        width[self.chain.loop_edge] = loop * (self.loop_width[:, None] if correlated else 1.0)
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
        """How many pairs of places those of the edges (E,) join that it leaves out, a shared shift counting as one; of
        those alone that pass over a step which the edges lack, if it confirms others.
        """
        against, shifts, chain = edges & ~self.used, 0, self.chain
        if self.found.confirmed:
            torn = np.cumsum(chain.lacks(edges))
            against[chain.loop_edge] &= np.not_equal(*torn[chain.ends].T) | chain.apart
        for each in self.found.mistakes():
            rows = chain.loop_edge[each.rows]
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
    by_order = trust in (AUTO, SEQUENTIAL)
    graph = numbered_along_path(graph) if by_order else graph
    if trust == AUTO and sequential_edges(graph).sum() < max(FEWEST, NEARLY_ALL * graph.vertex_count):
        return None
    chosen = consecutive_edges(graph) if by_order else _of_source(graph, trust)
    if not chosen.any():
        raise GraphError("no edge joins consecutive vertices, so that there is no sequence to trust: use --trust none")
    repeats = chosen.copy()
    if not by_order:  # repeats of edges outside its paths are loops, as these edges are
        pair = np.sort(graph.edges, axis=1) @ [graph.vertex_count, 1]
        repeats &= np.isin(pair, pair[_in_order(graph, repeats)])
    single = loops_once(fused(graph, repeats), ~chosen)
    single = windowed(single) if by_order else single
    backbone = _of_single_steps(graph, single, trust, in_lattice, most_breaks, is_lattice)
    if backbone is None:
        return None
    return replace(backbone, named=backbone.named if by_order else f"edges of {trust}", vertex_ids=ids)


def _of_single_steps(
    whole: ViewGraph, single: Fused, trust: str, in_lattice: bool, most_breaks: int, is_lattice: Callable[[Ints], bool]
) -> Backbone | None:
    """The backbone of a graph, judged on its fused graph with one edge for each step: see `find_backbone`."""
    graph = single.graph
    by_order = trust in (AUTO, SEQUENTIAL)
    chosen = sequential_edges(graph) if by_order else _of_source(graph, trust)
    steps = chosen if by_order else _in_order(graph, chosen)
    chain = make_chain(graph, steps)
    if not len(chain.loop_edge):
        return None
    paths = len(np.unique(chain.path[chain.step_edge >= 0]))
    if trust == AUTO and steps.sum() < FEWEST * min(paths, MOST_PATHS) * paths:
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

    def is_sought(unbroken: Inferred) -> bool:
        loops = single.rows[chain.loop_edge[unbroken.used]]
        return not (many_loops and is_doubted(unbroken) and is_lattice(loops))

    inferred = infer_bridged(chain, trusted, may_thin=in_lattice or not many_loops, most=most, is_sought=is_sought)
    if inferred is None:
        return None
    chain, found = inferred
    doubted = many_loops and is_doubted(found)
    if in_lattice or len(found.reduced.active) >= found.used.sum():
        return _backbone(whole, single, chain, found, found.polished, doubted)
    as_judged = found.linear, np.ones(len(found.used))
    backbone = _backbone(whole, single, chain, found, as_judged, doubted)
    never_wrong = backbone.steps.copy()
    never_wrong[single.rows[chain.loop_edge]] = trusted
    return of_every_loop(whole, backbone, never_wrong)


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
    graph: ViewGraph, single: Fused, chain: Chain, found: Inferred, solved: tuple[Linear, Floats], doubted: bool
) -> Backbone:
    """The backbone in rows of `graph`, as found on the fused graph `single`. A merged edge is used where none of its
    steps is broken; a copy of a loop where that is, or merged or contradicted as one that a window took.
    """
    loop_of = np.full(graph.edge_count, -1)
    loop_of[single.rows[chain.loop_edge]] = np.arange(len(chain.loop_edge))
    copied = loop_of[single.copied]
    loops = np.append(single.rows[chain.loop_edge], single.copies[copied >= 0])
    again = np.append(np.arange(len(chain.loop_edge)), copied[copied >= 0])
    merged, contradicted = (
        np.append(rows, single.copies[np.isin(single.copied, rows)]) for rows in (single.merged, single.contradicted)
    )
    is_merged, is_contradicted, used = np.zeros((3, graph.edge_count), bool)
    right, chi2 = np.full((2, graph.edge_count), np.nan)
    is_merged[merged] = is_contradicted[contradicted] = True
    chain = replace(
        chain.with_loops(again, chain.ends[again]),
        loop_edge=loops,
        step_edge=np.append(single.rows, -1)[chain.step_edge],
    )
    steps = is_merged.copy()
    steps[chain.step_edge[chain.step_edge >= 0]] = True
    used[chain.step_edge[chain.measured]] = True
    used &= ~is_contradicted
    low, high = chain.spans(graph.edges[merged]).T
    broken = np.cumsum(chain.broken)
    repeats = (high - low == 1) & is_contradicted[chain.step_edge[high]]
    used[merged], is_contradicted[merged] = (broken[low] == broken[high]) & ~repeats, repeats
    probability = expit(found.judged.log_odds)
    probability = np.where(found.used, probability, np.minimum(probability, UNUSED))
    used[loops], right[loops], chi2[loops] = found.used[again], probability[again], found.judged.chi2[again]
    poses = np.empty((graph.vertex_count, 4, 4))
    poses[chain.order] = solved[0].poses
    return Backbone(
        chain,
        found,
        steps,
        used,
        right,
        chi2,
        loop_width=solved[1][again] * np.sqrt(np.bincount(again)[again]),
        merged=is_merged,
        contradicted=is_contradicted,
        world_from_cam=poses,
        doubted=doubted,
        vertex_ids=graph.vertex_ids,
    )


def of_every_loop(graph: ViewGraph, backbone: Backbone, trusted: Bools) -> Backbone:
    """The backbone at the poses of all used loops, solved with Student's t, where only some were active in judging
    them.

    A loop whose χ² exceeds that of one right loop among as many is dropped, unless it is `trusted (E,)`.
    """
    size, rows, weighted = len(backbone.chain.axes), np.flatnonzero(backbone.used), backbone.weighted(graph)
    rare = 1 / backbone.loops_used.sum()
    gate = tail_gate(size, rare)
    poses, weight, off = backbone.world_from_cam, np.ones(len(rows)), np.zeros(len(rows), bool)
    for _ in range(ROUNDS):
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


UNUSED = 0.49
"""Largest probability that is reported of an unused loop."""

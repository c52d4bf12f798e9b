"""Which edge is wrong: the diagnosis of a viewing graph on one screen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.checks import check_graph
from hodge_pipeline.complex.chi2 import has_unit_information, in_vertex_order
from hodge_pipeline.complex.closing import cycle_errors
from hodge_pipeline.complex.free_directions import free_direction_notes
from hodge_pipeline.complex.short_cycles import with_cycles_of
from hodge_pipeline.diagnosis.consensus import agreeing, find_consensus
from hodge_pipeline.diagnosis.cycles import Cycles, close_by_chance, is_folded, judge_cycles, witnesses
from hodge_pipeline.diagnosis.evidence import Evidence, every_pair_tried, gather
from hodge_pipeline.diagnosis.noise import Noise
from hodge_pipeline.diagnosis.on_backbone import judged_on_backbone
from hodge_pipeline.diagnosis.options import CONSISTENT_FROM, WRONG_BELOW, DiagnosisOptions
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG, Diagnosis
from hodge_pipeline.diagnosis.robust_poses import Solved, meets_no_loops
from hodge_pipeline.diagnosis.robust_priors import priors_told
from hodge_pipeline.diagnosis.shared_blame import share_blame
from hodge_pipeline.diagnosis.wording import reasons
from hodge_pipeline.one_blas_thread import one_blas_thread
from hodge_pipeline.solvers.backbone.chain import make_chain
from hodge_pipeline.solvers.backbone.lattice import lattice_backbone, steps_are_wrong
from hodge_pipeline.solvers.backbone.sequence import sequential_edges, vertex_ranks
from hodge_pipeline.solvers.backbone.step_tests import is_tested
from hodge_pipeline.solvers.backbone.trust import AUTO, Backbone, find_backbone
from hodge_pipeline.solvers.explained import is_each_explained, is_each_usual, is_explained
from hodge_pipeline.solvers.maximum_likelihood import solve
from hodge_pipeline.solvers.weights import OUT_OF_PLANE, dimension_of
from hodge_pipeline.types import Bools, Floats, Ints, Solution, ViewGraph

DEFAULTS = DiagnosisOptions()


@one_blas_thread
def diagnose(graph: ViewGraph, options: DiagnosisOptions = DEFAULTS) -> Diagnosis:
    """Every edge judged by the cycles it lies in and by the scene that most edges agree on; see `Diagnosis`.

    No edge is trusted for its source unless the options say so, or the graph shows that its consecutive edges are a
    backbone; then see `find_backbone`. Deterministic. Raises `GraphError` for numbers that are not finite and edges
    that name no vertex.
    """
    check_graph(graph)
    found = backbone_or_diagnosis(graph, options)
    judged = found if isinstance(found, Diagnosis) else judged_on_backbone(graph, found)
    judged = replace(judged, world_from_cam=_poses(graph, found, judged))
    if graph.priors is None:
        return judged
    notes, findings = priors_told(graph, kept_graph(graph, found))
    return replace(judged, notes=(*judged.notes, *notes), findings=(*judged.findings, *findings))


def informed(graph: ViewGraph, found: Backbone | Diagnosis) -> ViewGraph:
    """The graph without a bias of its steps, or with learned information in the place of the unknown one."""
    if isinstance(found, Backbone):
        return found.unbiased(graph)
    return replace(graph, information=found.information) if has_unit_information(graph) else graph


def kept_graph(graph: ViewGraph, found: Backbone | Diagnosis) -> ViewGraph:
    """The graph of the edges that count, as they are solved beside priors."""
    if isinstance(found, Diagnosis):
        return informed(graph, found).select(found.kept)
    return informed(graph, found).select(found.used) if found.chain.stated else found.weighted(graph)


def _poses(graph: ViewGraph, found: Backbone | Diagnosis, judged: Diagnosis) -> Floats:
    """The maximum-likelihood poses (V, 4, 4) of the kept edges where these err as they state (`errs_as_stated`), else
    those of the judgement, by learned errors. Of 432 simulated walks positions are 7 % nearer the truth so.
    """
    is_stated = found.chain.stated if isinstance(found, Backbone) else not has_unit_information(graph)
    if not (is_stated and judged.kept.any()):
        return judged.world_from_cam
    kept = kept_graph(graph, found)
    solution = solve(kept, start=judged.world_from_cam, initial="given")
    return solution.world_from_cam if errs_as_stated(graph, found, kept, solution) else judged.world_from_cam


def errs_as_stated(graph: ViewGraph, found: Backbone | Diagnosis, kept: ViewGraph, solution: Solution) -> bool:
    """Whether the information of the kept edges explains what their maximum-likelihood solution leaves over, of all
    together and of each, and either the errors that were learned explain each, or none is far off for the usual one:
    among stated errors far too large wrong edges are not seen, which then bend the poses.
    """
    poses = solution.world_from_cam
    if not (is_explained(kept, solution) and is_each_explained(kept, poses)):
        return False
    if isinstance(found, Backbone):
        learned, steps = found.weighted(graph, correlated=False), found.steps[found.used]
    else:
        learned = replace(graph, information=found.information).select(found.kept)
        steps = np.zeros(kept.edge_count, bool)
    return is_each_explained(learned, poses) or is_each_usual(kept, poses, steps)


def backbone_or_diagnosis(graph: ViewGraph, options: DiagnosisOptions) -> Backbone | Diagnosis:
    """The backbone of a graph where one is trusted, else the diagnosis without one."""
    graph = replace(graph, dimension=dimension_of(graph))
    if options.trust == AUTO and _is_room(graph):
        return _ByCycles.of(graph, options).found
    by_cycles = cache(partial(_ByCycles.of, graph, options))  # slow, and not every graph needs it

    def is_lattice(loops: Ints) -> bool:
        judged = by_cycles()
        return not judged.explains_nothing and steps_are_wrong(graph, judged.found.kept, loops)

    backbone = find_backbone(graph, options.trust, most_breaks=options.most_breaks, is_lattice=is_lattice)
    if backbone is not None and not backbone.doubted:
        return backbone
    judged = by_cycles()
    if options.trust != AUTO or not graph.edge_count:
        return judged.found
    if judged.explains_nothing:
        return backbone or find_backbone(graph, in_lattice=True) or judged.found
    return lattice_backbone(graph, judged.found.kept, backbone) or judged.found


def _is_room(graph: ViewGraph) -> bool:
    """Whether registration seems to have been tried on all pairs, and short cycles test most consecutive edges: many
    wrong loops of a short sequence join as many pairs.
    """
    if not every_pair_tried(vertex_ranks(graph)[graph.edges], graph.vertex_count):
        return False
    steps = sequential_edges(graph)
    return not steps.any() or is_tested(make_chain(graph, steps))


@dataclass(frozen=True)
class _ByCycles:
    """The diagnosis without a backbone, of vertices in the order of their ids, along which poses drift.

    - `stated`: the graph as given; `rank (V,)`: of its vertices in that order; `turned (E,)`: edges that were inverted
      to run from the lower to the higher rank.
    - `there (4, 4)`: the frame at the working point in that of each camera; `evidence` and `cycles` are of such frames.
    """

    stated: ViewGraph
    turned: Bools
    evidence: Evidence
    cycles: Cycles
    there: Floats
    rank: Ints

    @classmethod
    def of(cls, stated: ViewGraph, options: DiagnosisOptions) -> _ByCycles:
        """The evidence and the cycles of a graph."""
        rank = vertex_ranks(stated)
        graph, turned = in_vertex_order(replace(stated, edges=rank[stated.edges]))
        evidence, cycles, point = gather(graph, options)
        there = se3.from_parts(np.eye(3), point)
        return cls(stated, turned, evidence, cycles, there, rank)

    @cached_property
    def explains_nothing(self) -> bool:
        """Whether cycles close no better than by chance, the sequence is folded, or it meets none of its loops, which
        the drift of a long path hides: `close_by_chance`, `is_folded`, `meets_no_loops`.
        """
        known = self.evidence
        if close_by_chance(self.cycles, known.graph.i_from_j, known.noise, known.reach_m):
            return True
        if meets_no_loops(known, self.fit):
            return True
        return is_folded(self.stated, self.found.kept, self.found.world_from_cam)

    @cached_property
    def fit(self) -> Solved:
        """The solution that most edges agree with: see `find_consensus`."""
        return find_consensus(self.evidence)

    @cached_property
    def found(self) -> Diagnosis:
        """The diagnosis of that solution."""
        stated, evidence, there, fit = self.stated, self.evidence, self.there, self.fit
        agrees = agreeing(evidence, fit)
        cycles = _with_witnesses(self.cycles, fit.used, evidence)
        blame = share_blame(cycles, fit, evidence)
        untestable = evidence.in_no_listed_cycle | blame.untestable
        probability = np.where(untestable, np.nan, np.maximum(agrees, blame.probability))
        right = (probability >= CONSISTENT_FROM) & fit.used
        wrong = probability < WRONG_BELOW
        verdict = np.select([untestable, right, wrong], [UNTESTABLE, CONSISTENT, WRONG], SUSPECT)
        kept = (verdict == CONSISTENT) | (verdict == UNTESTABLE)
        world_from_cam = fit.poses[self.rank] @ se3.inverse(there)
        cycles = replace(cycles, loops=cycles.loops.reversed_edges(self.turned))
        named_cycles = witnesses(cycles, probability, True), witnesses(cycles, probability, False)
        found = Diagnosis.of(
            replace(stated, information=_information(evidence.noise, there, stated.dimension == 2)),
            verdict=verdict,
            probability=probability,
            reasons=partial(reasons, stated, cycles, verdict, named_cycles, blame.cycle, fit.bridge),
            kept=kept,
            cycles=cycles,
            witnesses=named_cycles,
            world_from_cam=world_from_cam,
            tested=(f"cycles: {int(cycles.closes.sum())} of {len(cycles.loops)} close",),
        )
        return replace(found, notes=(*found.notes, *evidence.noise.doubts, *free_direction_notes(stated)))


def _with_witnesses(cycles: Cycles, used: Bools, evidence: Evidence) -> Cycles:
    """The cycles, and cycles of used edges alone over each used edge that no listed cycle closes over."""
    wanted = used & (cycles.loops.sums_at_edges(cycles.closes, len(used)) == 0) & ~evidence.in_no_listed_cycle
    if not wanted.any():
        return cycles
    loops = with_cycles_of(used, cycles.loops, evidence.graph.edges, evidence.graph.vertex_count, wanted)
    return judge_cycles(loops, *cycle_errors(loops, evidence.graph.i_from_j), evidence.noise, evidence.reach_m)


def _information(noise: Noise, there: Floats, planar: bool) -> Floats:
    """The information (E, 6, 6) of noise at the working point, carried to the cameras' own frames."""
    carried = se3.adjoint(se3.inverse(there))
    information = carried.T @ noise.information @ carried
    if planar:
        information[:, OUT_OF_PLANE] = information[:, :, OUT_OF_PLANE] = 0
    return np.asarray(information)

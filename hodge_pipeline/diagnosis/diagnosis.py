"""Which edge is wrong: the diagnosis of a viewing graph on one screen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline import se3
from hodge_pipeline.complex.checks import check_graph
from hodge_pipeline.complex.components import connected_components, describe_components
from hodge_pipeline.complex.free_directions import free_direction_notes
from hodge_pipeline.complex.judging import in_vertex_order
from hodge_pipeline.diagnosis.consensus import find_consensus
from hodge_pipeline.diagnosis.evidence import Evidence
from hodge_pipeline.diagnosis.noise import Noise, edge_noise
from hodge_pipeline.diagnosis.on_backbone import judged_on_backbone
from hodge_pipeline.diagnosis.options import DiagnosisOptions
from hodge_pipeline.diagnosis.order import every_pair_tried, order_prior, prior_by_cycles, right_by_gap
from hodge_pipeline.diagnosis.result import CONSISTENT, SUSPECT, UNTESTABLE, WRONG, Cycles, Diagnosis
from hodge_pipeline.diagnosis.robust_poses import Fit
from hodge_pipeline.diagnosis.shared_blame import share_blame
from hodge_pipeline.diagnosis.short_cycles import cycle_errors, short_cycles, with_cycles_of
from hodge_pipeline.diagnosis.testing_cycles import (
    closing_support,
    in_no_cycle,
    judge_cycles,
    unattributable,
    usual_share,
    witnesses,
)
from hodge_pipeline.diagnosis.wording import reasons
from hodge_pipeline.diagnosis.working_point import recentred, working_point
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.solvers.backbone.trust import AUTO, Backbone, find_backbone
from hodge_pipeline.solvers.weights import OUT_OF_PLANE, is_planar
from hodge_pipeline.types import Bools, Floats, Ints, ViewGraph

DEFAULTS = DiagnosisOptions()
LIKELIER_RIGHT = 0.5


def diagnose(graph: ViewGraph, options: DiagnosisOptions = DEFAULTS) -> Diagnosis:
    """Every edge judged by the cycles it lies in and by the scene that most edges agree on; see `Diagnosis`.

    No edge is trusted for its source unless the options say so, or the graph shows that its consecutive edges are a
    backbone; then see `find_backbone`. Deterministic for a seed. Raises `GraphError` for numbers that are not finite
    and edges that name no vertex.
    """
    check_graph(graph)
    graph = replace(graph, dimension=2) if is_planar(graph) else graph
    if (backbone := find_backbone(graph, options.trust)) is not None:
        return judged_on_backbone(graph, backbone, options)
    found = _by_cycles(graph, options)
    backbone = lattice_backbone(graph, found, options)
    return found if backbone is None else judged_on_backbone(graph, backbone, options)


def lattice_backbone(graph: ViewGraph, found: Diagnosis, options: DiagnosisOptions) -> Backbone | None:
    """The backbone of a large lattice where more edges agree with it than `found` keeps: of two scenes that edges may
    agree on, that of most. None elsewhere, and where no edge is left out.
    """
    if options.trust != AUTO or found.kept.all():
        return None
    backbone = find_backbone(graph, lattice=True)
    if backbone is None or not backbone.found.confirmed or backbone.used.sum() <= found.kept.sum():
        return None
    return backbone


def _by_cycles(graph: ViewGraph, options: DiagnosisOptions) -> Diagnosis:
    """The diagnosis that trusts no edge."""
    stated, (graph, turned) = graph, in_vertex_order(graph)
    prior = np.full(graph.edge_count, 0.5)
    if options.order_prior:
        prior = order_prior(graph.edges, graph.vertex_count)
    point, reach_m = working_point(graph.i_from_j, prior)
    motions = recentred(graph.i_from_j, point)
    loops = short_cycles(graph.edges, graph.vertex_count, options.max_cycles_per_edge)
    angle, displacement_m = cycle_errors(loops, motions)
    noise = edge_noise(graph, loops, angle, displacement_m, prior, reach_m)
    cycles = judge_cycles(loops, angle, displacement_m, noise, reach_m)
    exhaustive = every_pair_tried(graph.edges, graph.vertex_count)
    if exhaustive and options.order_prior and np.ptp(prior) == 0:
        prior = prior_by_cycles(graph.edges, graph.vertex_count, cycles)
        noise = edge_noise(graph, loops, angle, displacement_m, prior, reach_m)
        cycles = judge_cycles(loops, angle, displacement_m, noise, reach_m)
    if not exhaustive:
        # then the order cannot tell how many of the pairs that were tried are wrong: the cycles can
        usual = usual_share(cycles)
        prior = np.minimum(prior, usual)
        if options.order_prior:
            prior = right_by_gap(graph.edges, graph.vertex_count, cycles, usual)
    evidence = Evidence(
        edges=graph.edges,
        vertex_count=graph.vertex_count,
        i_from_j=motions,
        prior=prior,
        noise=noise,
        support=closing_support(cycles, prior),
        in_no_listed_cycle=in_no_cycle(graph.edges, graph.vertex_count, cycles),
        exhaustive=exhaustive,
        reach_m=reach_m,
    )
    consensus = find_consensus(evidence, _with_noise(graph, motions, noise), options)
    cycles = _with_witnesses(graph, cycles, consensus.fit.used, evidence)
    undecided = unattributable(graph.edges, graph.vertex_count, cycles)
    blame = share_blame(cycles, consensus.fit, evidence)
    unvouched = blame.unvouched & (consensus.probability >= LIKELIER_RIGHT)
    untestable = evidence.in_no_listed_cycle | (undecided >= 0) | unvouched
    probability = np.where(untestable, np.nan, np.maximum(consensus.probability, blame.probability))
    undecided = np.where(undecided >= 0, undecided, np.where(unvouched | (blame.probability > 0), blame.cycle, -1))
    verdict = _verdicts(probability, untestable, consensus.fit.used, options)
    kept = (verdict == CONSISTENT) | (verdict == UNTESTABLE)
    world_from_cam = consensus.fit.poses @ se3.inverse(se3.from_parts(np.eye(3), point))
    cycles = replace(cycles, loops=cycles.loops.reversed_edges(turned))
    found = _report(stated, cycles, probability, verdict, kept, undecided, consensus.fit, world_from_cam)
    information = _of_noise(noise, point, graph.dimension == 2)
    return replace(found, information=information, notes=(*found.notes, *noise.doubts, *free_direction_notes(stated)))


def _with_witnesses(graph: ViewGraph, cycles: Cycles, used: Bools, evidence: Evidence) -> Cycles:
    """The cycles, and more where none that closes passes an edge in use, though others in use close one over it."""
    told = np.zeros(graph.edge_count, bool)
    told[cycles.loops.select(np.flatnonzero(cycles.closes)).edge] = True
    wanted = used & ~told & ~evidence.in_no_listed_cycle
    if not wanted.any():
        return cycles
    loops = with_cycles_of(used, cycles.loops, graph.edges, graph.vertex_count, wanted)
    return judge_cycles(loops, *cycle_errors(loops, evidence.i_from_j), evidence.noise, evidence.reach_m)


def _with_noise(graph: ViewGraph, motions: Floats, noise: Noise) -> ViewGraph:
    return replace(graph, i_from_j=motions, information=noise.information)


def _of_noise(noise: Noise, point: Floats, planar: bool) -> Floats:
    """The information (E, 6, 6) of noise at the working point, in the axes and at the origin of the frames."""
    there = se3.adjoint(se3.from_parts(np.eye(3), -point))
    information = there.T @ noise.information @ there
    if planar:
        information[:, OUT_OF_PLANE] = information[:, :, OUT_OF_PLANE] = 0
    return np.asarray(information)


def _verdicts(probability: Floats, untestable: Bools, used: Bools, options: DiagnosisOptions) -> NDArray[np.str_]:
    right = (probability >= options.consistent_from) & used
    wrong = probability < options.wrong_below
    return np.select([untestable, right, wrong], [UNTESTABLE, CONSISTENT, WRONG], SUSPECT)


def _report(
    graph: ViewGraph,
    cycles: Cycles,
    probability: Floats,
    verdict: NDArray[np.str_],
    kept: Bools,
    undecided: Ints,
    fit: Fit,
    world_from_cam: Floats,
) -> Diagnosis:
    piece = connected_components(graph.edges[kept], graph.vertex_count)
    same = piece[graph.edges[:, 0]] == piece[graph.edges[:, 1]]
    displacement_m, angle = edge_residuals(graph, world_from_cam)
    residual = np.where(same, displacement_m, np.nan), np.where(same, np.degrees(angle), np.nan)
    telling = witnesses(cycles, probability, True), witnesses(cycles, probability, False)
    share = 1 - 1 / (1 + fit.resistance)
    counts = ", ".join(f"{int((verdict == name).sum())} {name}" for name in (CONSISTENT, SUSPECT, WRONG, UNTESTABLE))
    tested = f"cycles: {int(cycles.closes.sum())} of {len(cycles.loops)} close"
    return Diagnosis(
        verdict=verdict,
        probability=probability,
        reason=reasons(graph, cycles, verdict, residual, telling, undecided, fit.bridge),
        kept=kept,
        residual_m=residual[0],
        residual_deg=residual[1],
        leverage=np.where(kept, share, 0.0),
        information=graph.information,
        cycles=cycles,
        witnesses_for=telling[0],
        witnesses_against=telling[1],
        piece=piece,
        world_from_cam=world_from_cam,
        notes=(f"edges: {counts}", tested, *describe_components(piece, graph.vertex_ids)),
    )

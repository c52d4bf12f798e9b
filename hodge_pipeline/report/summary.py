"""The rows of a report from the data that flows between stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.components import in_runs
from hodge_pipeline.diagnosis.result import UNTESTABLE, VERDICTS, WRONG
from hodge_pipeline.evaluation.trajectory import absolute_error, relative_error
from hodge_pipeline.registration.sliding import unheld_steps
from hodge_pipeline.report.contents import ComponentRow, EdgeRow, GraphSummary, TrajectoryRow, WrongEdges
from hodge_pipeline.scene import Round
from hodge_pipeline.stages import ConsistencySolver, Step
from hodge_pipeline.types import Edges, Floats, Ints
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted

CENTIMETRES_PER_DEGREE = 1.0
"""Weight of a residual's angle in ranking edges: 1° moves a scene that is 0.6 m away by a centimetre."""

MOST_FRAMES = 3
"""Frames that a note names, at most."""
UNHELD = 0.02
"""Share of steps unconstrained in some direction and tested by no other edge, above which the path is in doubt: none of
fr1, red kitchen, ICL-NUIM, fr3's cabinet; 6 % of a walk where steps slid by 20 cm; all before a bare wall.
"""


def trajectory_rows(
    pose_sets: Mapping[str, Floats],
    truth: Floats,
    component: Ints | None = None,
    sequence: Sequence[str] | None = None,
    *,
    names: Sequence[object] = (),
    delta_frames: int = 1,
) -> tuple[TrajectoryRow, ...]:
    """The errors of each named set of poses (N, 4, 4) against the truth (N, 4, 4), NaN where a frame has none; frames
    may have `names (N,)`.

    Each component (N,) is aligned apart; a frame that is one by itself is left out, since it would fit its truth
    exactly. Relative motions, over `delta_frames`, also stop at the end of a sequence.
    """
    parts = _distinct(component, sequence, len(truth))
    if component is not None:
        alone = np.bincount(component)[component] == 1
        truth = np.where(alone[:, None, None], np.nan, truth)
    rows = []
    for name, poses in pose_sets.items():
        absolute = absolute_error(poses, truth, component)
        relative = relative_error(poses, truth, delta_frames, component=parts)
        row = TrajectoryRow(
            name=name,
            frames=absolute.frames,
            left_out=absolute.left_out,
            ate_rmse_m=absolute.rmse_m,
            ate_median_m=absolute.median_m,
            ate_max_m=absolute.max_m,
            rpe_translation_m=relative.translation_rmse_m,
            rpe_rotation_deg=relative.rotation_rmse_deg,
            rpe_delta_frames=relative.delta_frames,
            worst=str(names[int(np.nanargmax(absolute.per_frame_m))]) if absolute.frames and len(names) else "",
            degenerate=any(alignment.degenerate for alignment in absolute.alignments),
        )
        rows.append(row)
    return tuple(rows)


def _distinct(component: Ints | None, sequence: Sequence[str] | None, count: int) -> Ints:
    """One label (N,) for each combination of component and sequence."""
    labels = np.zeros(count, np.int64) if component is None else np.asarray(component, np.int64)
    if sequence is None:
        return labels
    names = np.unique(np.asarray(sequence, str), return_inverse=True)[1]
    return np.asarray(labels * (names.max(initial=0) + 1) + names, np.int64)


def graph_summary(edges: Edges, vertex_ids: NDArray[np.generic], component: Ints) -> GraphSummary:
    """The viewing graph in numbers; `component (V,)` as the solution has it."""
    graph = edges.select(edges.in_graph)
    sources, counts = np.unique(graph.proposed_by, return_counts=True)
    labels, sizes = np.unique(component, return_counts=True)
    largest_first = labels[np.argsort(-sizes, kind="stable")]
    rows = [np.flatnonzero(component == label) for label in largest_first]
    return GraphSummary(
        vertices=len(vertex_ids),
        edges=len(graph),
        edges_by_source=dict(zip(sources.tolist(), counts.tolist(), strict=True)),
        components=tuple(ComponentRow(len(row), in_runs(row, vertex_ids)) for row in rows),
        edges_ignored=int((graph.weight <= 0).sum()),
        rejected=edges.rejected_counts,
        verdicts=_verdicts(graph),
        verdicts_in_use=_verdicts(graph.select(graph.weight > 0)),
    )


def unheld(edges: Edges, vertex_ids: NDArray[np.generic], min_spread: float) -> tuple[Note, ...]:
    """A note where many steps of the path may slide and no other edge tests them."""
    graph = edges.select(edges.in_graph)
    steps = np.abs(np.diff(graph.pairs, axis=1)[:, 0]) == 1
    free = unheld_steps(graph, min_spread) & (graph.verdict == UNTESTABLE)
    if free.sum() <= UNHELD * steps.sum():
        return ()
    frames = in_runs(np.unique(graph.pairs[free].max(axis=1)), vertex_ids)
    return (Note("unheld", int(free.sum()), f"{counted(int(steps.sum()), 'step')} (to {frames})"),)


def _verdicts(graph: Edges) -> dict[str, int]:
    """How many edges were judged how; nothing where none was judged."""
    if not (graph.verdict != "").any():
        return {}
    return {name: int((graph.verdict == name).sum()) for name in VERDICTS}


def worst_edges(edges: Edges, vertex_ids: NDArray[np.generic], count: int = 10) -> tuple[EdgeRow, ...]:
    """The edges furthest from the poses, worst first: a centimetre counts like a degree."""
    graph = edges.select(edges.in_graph)
    size_cm = graph.residual_m * 100 + np.rad2deg(graph.residual_rad) * CENTIMETRES_PER_DEGREE
    worst = graph.select(np.argsort(-np.nan_to_num(size_cm, nan=-1.0), kind="stable")[:count])
    return tuple(
        EdgeRow(
            i=str(i),
            j=str(j),
            source=str(worst.proposed_by[row]),
            fitness=float(worst.fitness[row]),
            weight=float(worst.weight[row]),
            residual_m=float(worst.residual_m[row]),
            residual_deg=float(np.rad2deg(worst.residual_rad[row])),
            verdict=str(worst.verdict[row]),
            why=str(worst.why[row]),
        )
        for row, (i, j) in enumerate(vertex_ids[worst.pairs].tolist())
    )


def weigh_wrong(last: Round, solver: ConsistencySolver, *, step: Step) -> WrongEdges:
    """Step: the effect of the edges judged wrong that the solver used, by a solve without them."""
    assert last.solution is not None
    wrong = (last.graph_edges.verdict == WRONG) & (last.solution.weights > 0)
    if not wrong.any():
        return WrongEdges(0)
    frames = _shared_frames(last.graph_edges.pairs[wrong], last.vertex_ids)
    solved = solver.solve(last.graph.select(~wrong & (last.solution.weights > 0)), last.world_from_cam)
    moved_m = absolute_error(last.world_from_cam, solved.world_from_cam, solved.component).max_m
    more = len(np.unique(solved.component)) - len(np.unique(last.solution.component))
    return WrongEdges(int(wrong.sum()), frames, float(np.nan_to_num(moved_m)), max(more, 0))


def _shared_frames(pairs: Ints, vertex_ids: NDArray[np.generic]) -> str:
    """`5 of them at frame 12, 3 at 80`; where no frame has several the edges by name."""
    frames, counts = np.unique(pairs, return_counts=True)
    order = np.argsort(-counts, kind="stable")[:MOST_FRAMES]
    shared = [f"{counts[row]} at frame {vertex_ids[frames[row]]}" for row in order if counts[row] > 1]
    if shared:
        return ", ".join(shared)
    return ", ".join(f"{i}–{j}" for i, j in vertex_ids[pairs[:MOST_FRAMES]].tolist())

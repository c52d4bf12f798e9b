"""The report of a run: what its rounds, scores and refinement come to."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence

import numpy as np

from hodge_pipeline import registry, se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.evaluation.residuals import edge_residuals
from hodge_pipeline.evaluation.scores import ScoreTable
from hodge_pipeline.evaluation.trajectory import absolute_error
from hodge_pipeline.recipe import binding
from hodge_pipeline.recipe.schema import Recipe
from hodge_pipeline.refine.given_poses import Refined
from hodge_pipeline.report.contents import (
    EdgeRow,
    LoopRow,
    Pictures,
    Report,
    Residuals,
    SourceSummary,
    StageRow,
    TrajectoryRow,
    paths_of,
)
from hodge_pipeline.report.refined import summary
from hodge_pipeline.report.scene_pictures import changed_most, four_sides, worst_pairs
from hodge_pipeline.report.summary import graph_summary, trajectory_rows, unheld, weigh_wrong, worst_edges
from hodge_pipeline.report.truth import truth_doubts
from hodge_pipeline.rounds.settling import last_shift_m
from hodge_pipeline.scene import (
    START,
    GivenFile,
    KeyFrames,
    Round,
    Scene,
    given_poses,
    has_given,
    has_real_stamps,
    has_truth,
    pose_sets,
    sequences_of,
    true_poses,
)
from hodge_pipeline.store import yaml_file
from hodge_pipeline.store.store import Store, versions
from hodge_pipeline.types import Floats, Ints, Solution
from hodge_pipeline.types.axes import is_scanner

KEY_OF_CACHE = r"-[0-9a-f]{12}$"
"""The hash at the end of a cached folder's name, which is left out of titles."""


def make_report(
    recipe: Recipe,
    store: Store,
    scene: Scene,
    rounds: Sequence[Round],
    world_from_cam: Floats,
    scores: ScoreTable | None,
    refined: Refined | None,
) -> Report:
    """Everything that the run measured, `world_from_cam (N, 4, 4)` being the poses that it ends with."""
    last, source = rounds[-1], scene.source
    kept = refined is not None and refined.decision.keeps_input
    sets = _shown(rounds, scene, world_from_cam, is_refined=refined is not None and not kept)
    assert last.solution is not None
    component = last.solution.component
    worst = worst_edges(last.edges, last.vertex_ids)
    summary_of_source = _source_summary(recipe, scene)
    scans = summary_of_source.kind == "scans"  # where these slide, `start.sweeps` says it
    return Report(
        title=re.sub(KEY_OF_CACHE, "", source.name),
        before=next(iter(sets)),
        source=summary_of_source,
        scores=scores,
        trajectories=_trajectories(recipe, scene, sets, world_from_cam, component, kept=kept),
        loops=_loop_rows(last.solution),
        energies={f"round {n}": one.energies for n, one in enumerate(rounds) if one.energies is not None},
        graph=graph_summary(last.edges, last.vertex_ids, component),
        worst_edges=worst,
        stages=tuple(StageRow(c["title"], c["wall_s"], c["cpu_s"], c["peak_mb"]) for c in store.costs()),
        notes=(
            *store.notes,
            *(() if scans else unheld(last.edges, last.vertex_ids, recipe.acceptance.min_spread)),
            *truth_doubts(scene.whole, scene.key_frames, last, world_from_cam, se3.ARM_M * float(recipe.scale)),
        ),
        versions=versions(),
        recipe=yaml_file.dump(binding.unbind(recipe)),
        last_shift_m=last_shift_m(rounds, component),
        wrong_edges=store.step(weigh_wrong, last, recipe.solver, title="edges judged wrong"),
        unmeasured=_unmeasured(recipe, scores, last),
        position_fit=last.position_fit,
        pictures=_pictures(scene, rounds, sets, component, worst),
        refinement=None if refined is None else summary(refined.decision),
        shows_rejected=kept,
    )


def _shown(rounds: Sequence[Round], scene: Scene, world_from_cam: Floats, *, is_refined: bool) -> dict[str, Floats]:
    """The poses of the key frames by name; the result of a refinement is what it writes, not its last round's: a
    correction of fewer knots, or the given poses less their noise.
    """
    sets = pose_sets(rounds, scene.source)
    return {**sets, "result": world_from_cam[scene.key_frames.rows]} if is_refined else sets


def _source_summary(recipe: Recipe, scene: Scene) -> SourceSummary:
    """What the source holds, key frames and all."""
    whole, source = scene.whole, scene.source
    return SourceSummary(
        name=source.name,
        path=str(source.path),
        frames=len(whole.frames),
        frames_with_truth=sum(frame.true_world_from_cam is not None for frame in whole.frames),
        key_frames=None if scene.key_frames.are_all else len(source.frames),
        sequences=tuple(name for name in sequences_of(source) if name),
        notes=source.notes,
        format="" if recipe.source.reader is None else registry.name_of(recipe.source.reader),
        kind="scans" if all(frame.read_depth is None for frame in source.frames) else "frames",
        unordered=not scene.in_order,
        is_scanner=is_scanner(scene.clouds),
    )


def _unmeasured(recipe: Recipe, scores: ScoreTable | None, last: Round) -> str:
    """Why there are no scores, where there are none."""
    if scores is not None:
        return ""
    if not recipe.evaluation.tables:
        return "the recipe asks for no scores (evaluation.tables is false), and there are no true poses."
    return "scores are not measured after an edit, and there are no true poses." if last.edited else ""


def _trajectories(
    recipe: Recipe, scene: Scene, sets: Mapping[str, Floats], final: Floats, component: Ints, *, kept: bool
) -> tuple[TrajectoryRow, ...]:
    """The errors of each set of poses, over all frames, those that are not key frames included; of a file of given
    poses over all of its own. The result is what the run ends with: the input where it is kept.
    """
    if not has_truth(scene.whole):
        return ()
    if scene.given is not None:
        return _of_file(scene.given, scene.key_frames, sets, recipe.evaluation.rpe_delta_frames, kept=kept)
    every = {name: scene.key_frames.expand(poses) for name, poses in sets.items()} | {"result": final}
    if has_given(scene.source):
        every[START] = given_poses(scene.whole)
    sequences = [frame.sequence for frame in scene.whole.frames]
    delta_frames = recipe.evaluation.rpe_delta_frames
    component = scene.key_frames.of_frames(component)
    names = [frame.frame_id for frame in scene.whole.frames]
    truth = true_poses(scene.whole)
    return trajectory_rows(every, truth, component, sequences, names=names, delta_frames=delta_frames)


def _of_file(
    given: GivenFile, key_frames: KeyFrames, sets: Mapping[str, Floats], delta_frames: int, *, kept: bool
) -> tuple[TrajectoryRow, ...]:
    """The errors of the poses of a file, as `evo_ape -a` and `evo_rpe` have them: one alignment, poses without a truth
    left out first.
    """
    known = se3.has_pose(given.true_world_from_cam)
    if not known.any():
        return ()
    every = {name: given.expand(key_frames, poses)[known] for name, poses in sets.items()}
    every[START] = given.trajectory.world_from_cam[known]
    if kept:
        every["result"] = every[START]
    rows = trajectory_rows(every, given.true_world_from_cam[known], delta_frames=delta_frames)
    what = f"poses of {given.path.name}"
    return tuple(dataclasses.replace(row, left_out=int((~known).sum()), of=what) for row in rows)


def _loop_rows(solution: Solution) -> tuple[LoopRow, ...]:
    """How far loops are from closing, as measured and after each Poisson step; none of other solvers."""
    loops = int(solution.metrics.get("loops", 0))
    measured = solution.metrics.get("measured_loop_deviation_sum")
    rows = [] if measured is None else [LoopRow("measured edges", loops, measured)]
    for number, step in enumerate(solution.history, start=1):
        if "loop_deviation_sum" in step.metrics:
            rows.append(LoopRow(f"adjusted edges, inner iteration {number}", loops, step.metrics["loop_deviation_sum"]))
    return tuple(rows)


def _held_by_both(component: Ints, first: Round, *, is_start: bool) -> Ints:
    """Labels (N,) of the frames that both the result (its `component`) and the edges of the start hold together; given
    poses have no edges, and are one whole.
    """
    if not is_start or not len(first.graph_edges):
        return component
    of_start = connected_components(first.graph_edges.pairs, len(component))
    return np.unique(np.stack([component, of_start]), axis=1, return_inverse=True)[1].reshape(-1)


def _pictures(
    scene: Scene, rounds: Sequence[Round], sets: Mapping[str, Floats], component: Ints, worst: Sequence[EdgeRow]
) -> Pictures:
    """What is drawn; paths are aligned to the truth, or the first one to the result where there is none: piece by piece
    as both have them, since how the start lays its pieces apart is no measure of anything.
    """
    last, source, clouds = rounds[-1], scene.source, scene.clouds
    first = next(iter(sets))
    before, after = sets[first], sets["result"]
    shown = {first: before, "result": after}
    held = component
    if has_truth(source):
        truth = true_poses(source)
        aligned = {name: absolute_error(poses, truth, component).aligned for name, poses in shown.items()}
        shown = {"truth": truth, **aligned}
    else:
        held = _held_by_both(component, rounds[0], is_start=before is rounds[0].world_from_cam)
        shown[first] = absolute_error(before, after, held).aligned
    is_clocked = has_real_stamps(source.frames)
    finite = next(name for name, poses in sets.items() if np.isfinite(poses).all())
    return Pictures(
        paths=paths_of(shown),
        component=held,
        residuals=tuple(Residuals(name, *edge_residuals(last.graph, sets[name])) for name in (finite, "result")),
        graph=last.graph,
        convergence={
            f"round {number}": tuple(step.objective for step in one.solution.history)
            for number, one in enumerate(rounds)
            if one.solution is not None
        },
        names=tuple(str(frame.frame_id) for frame in source.frames),
        stamps_s=np.array([frame.stamp_s for frame in source.frames if is_clocked]),
        changed_most=changed_most(clouds, before, after, last.graph.edges, last.vertex_ids.tolist(), held),
        sides=four_sides(clouds, before, after, component),
        worst_pairs=tuple(worst_pairs(source, worst)),
    )

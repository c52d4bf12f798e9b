"""The first poses of a run: from consecutive frames (odometry), from nothing, or odometry's pieces joined."""

from __future__ import annotations

import shutil

import numpy as np

from hodge_pipeline import steps
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.pairs.candidates import merge
from hodge_pipeline.registration.gaps import has_gap
from hodge_pipeline.rounds import Round, sequences_of
from hodge_pipeline.stages import Workers
from hodge_pipeline.start import given, key_frames
from hodge_pipeline.start.unordered.start import Scene, Start, find_start
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.types import Edges, Source

START = "start"


def first_poses(job: Job, source: Source, workers: Workers) -> Round:
    """Round 0: given poses, or what the recipe's `start` and `relocalise` ask for."""
    if job.given is not None:
        return given.first_poses(job, job.given, source)
    if job.recipe.start == "global":
        return _global_start(job, source, None, ("clouds", "source"), workers)
    if job.tracked is not None:
        first = key_frames.first_poses(job, job.tracked, source)
    else:
        first = steps.odometry(job, source, workers)
    if not (job.recipe.relocalise and (job.recipe.relocalise is True or _apart(first))):
        return first
    return _global_start(job, source, first, ("odometry", "source"), workers)


def _apart(first: Round) -> bool:
    """Whether odometry left several parts of more than one frame."""
    component = connected_components(first.graph.edges, first.graph.vertex_count)
    return int((np.bincount(component) > 1).sum()) > 1


def _stays(source: Source, known: Round, found: Start) -> bool:
    """Whether no two parts were joined, and none lies behind a hole, over which no motion can be guessed."""
    parts = connected_components(known.graph.edges, known.graph.vertex_count)
    stamps_s = np.array([frame.stamp_s for frame in source.frames])
    holes = has_gap(list(sequences_of(source).values()), stamps_s)
    return not holes and len(np.unique(found.piece)) >= len(np.unique(parts))


def _global_start(job: Job, source: Source, known: Round | None, inputs: tuple[str, ...], workers: Workers) -> Round:
    options, total = job.recipe.global_start, 2 * len(source.frames)
    with job.stage(START, "start without a guess", total, options, inputs) as (folder, advance):
        if not folder.finished:
            graph, drifted = (None, None) if known is None else (known.graph, known.world_from_cam)
            scene = Scene(source.frames, job.path("clouds"), steps.vertex_ids(source), graph, drifted)
            scratch = folder.path / "scratch"
            found = find_start(scene, options, scratch, workers, advance)
            shutil.rmtree(scratch, ignore_errors=True)
            for note in found.notes:
                job.note(note)
            first_graph, poses = found.graph, found.world_from_cam
            if known is not None and _stays(source, known, found):
                first_graph, poses = known.graph, known.world_from_cam
                job.note("nothing joins what tracking left apart: it starts where the guessed motion puts it")
            artifacts.save(folder.path / "edges.npz", Edges.measured(first_graph))
            artifacts.save_arrays(folder.path / "poses.npz", {"world_from_cam": poses})
    edges = artifacts.load(job.path(START) / "edges.npz", Edges)
    poses = artifacts.load_arrays(job.path(START) / "poses.npz")["world_from_cam"]
    return Round(edges, steps.vertex_ids(source), poses, name=START)


def with_start_edges(candidates: Edges, first: Round) -> Edges:
    """The candidates, and those edges of the start that join what the candidates leave apart.

    Consecutive frames join nothing here: across a gap they have nothing in common.
    """
    if first.name != START:
        return candidates
    proven = candidates.pairs[~np.isin(candidates.proposed_by, ("sequential", "nearest"))]
    component = connected_components(proven, first.graph.vertex_count)
    joining = component[first.graph.edges[:, 0]] != component[first.graph.edges[:, 1]]
    if not joining.any():
        return candidates
    pairs = np.unique(np.sort(first.graph.edges[joining], axis=1), axis=0)
    return merge([candidates, Edges.proposed(pairs, START)])[0]

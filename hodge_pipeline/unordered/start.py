"""Poses from nothing, on one screen: describe, propose, match, weigh, and let the diagnosis say what to trust."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.components import describe_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.registration.global_evidence import DepthView
from hodge_pipeline.registration.global_pairs import describe_clouds, load_description, match_pairs
from hodge_pipeline.stages import Advance, GlobalRegistrar, Workers
from hodge_pipeline.types import CloudSet, Floats, Frame, Ints, ViewGraph
from hodge_pipeline.unordered.graphs import joined_graph, without_wrong
from hodge_pipeline.unordered.hypotheses import Hypotheses, ViewOf, no_views, weigh
from hodge_pipeline.unordered.image_matches import SiftWithDepth, describe_frames, has_images
from hodge_pipeline.unordered.options import GlobalStart
from hodge_pipeline.unordered.pieces import laid_apart
from hodge_pipeline.unordered.scan_checks import check_scans
from hodge_pipeline.unordered.similarity import LocalDescriptors, all_pairs, similar_pairs

DESCRIBED = "described"
FEATURE_VOXEL_M = 0.05


@dataclass(frozen=True)
class Start:
    """The first poses (N, 4, 4), pieces laid apart; the edges that they rest on; the piece (N,) of each frame."""

    world_from_cam: Floats
    graph: ViewGraph
    piece: Ints
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Scene:
    """What is to be joined: frames, their clouds (a folder), and edges that are known already (odometry), or none."""

    frames: Sequence[Frame]
    clouds: Path
    vertex_ids: NDArray[np.generic]
    given: ViewGraph | None = None


def find_start(scene: Scene, options: GlobalStart, scratch: Path, workers: Workers, advance: Advance) -> Start:
    """Poses of all frames that the evidence joins; `advance` counts frames, once described and once placed.

    `scratch` is a folder for the descriptions. Frames that nothing joins are pieces of their own, and said.
    """
    clouds = CloudSet.open(scene.clouds)
    rows = np.flatnonzero(clouds.sizes > 0)
    by_image = uses_images(scene.frames, options)
    described = scratch / DESCRIBED
    registrar: Any = SiftWithDepth() if by_image else options.registrar
    notes: list[str] = []
    if by_image:
        reach_m = float(max((c.points_in_cam[:, 2].max() for c in clouds if len(c)), default=0.0))
        notes += describe_frames(scene.frames, options.max_features, reach_m, described, workers, advance)
    else:
        describe_clouds(scene.clouds, options.registrar, rows, described, workers, advance)
        notes += check_scans(clouds, scene.vertex_ids)
    pairs = propose(clouds, rows, described, options)
    hypotheses = judge_pairs(scene, options, registrar, described, pairs, by_image, workers)
    notes.append(_tried(len(rows), pairs, hypotheses))
    measured = hypotheses.as_graph(scene.vertex_ids, "sift" if by_image else "features")
    graph = measured if scene.given is None else joined_graph(scene.given, measured)
    found = diagnose(graph, options.diagnosis)
    kept, piece, poses = without_wrong(graph, found)
    notes += [f"{int((~found.kept).sum())} of {graph.edge_count} edges are distrusted", *_apart(piece, scene)]
    advance(len(scene.frames))
    return Start(laid_apart(piece, poses, clouds), kept, piece, tuple(notes))


def uses_images(frames: Sequence[Frame], options: GlobalStart) -> bool:
    """Whether pairs are matched by their images."""
    if options.use != "auto":
        return options.use == "images"
    return sum(has_images(frame) for frame in frames) * 2 >= len(frames)


def propose(clouds: CloudSet, rows: Ints, described: Path, options: GlobalStart) -> Ints:
    """The pairs (P, 2) to match: all of a few frames, else each with the most similar ones."""
    if len(rows) <= options.all_pairs_up_to:
        return all_pairs(rows)
    local = LocalDescriptors(described, clouds, FEATURE_VOXEL_M)
    return similar_pairs(local, rows, options.words, options.similar_per_frame, options.seed)


def judge_pairs(
    scene: Scene,
    options: GlobalStart,
    registrar: GlobalRegistrar,
    described: Path,
    pairs: Ints,
    by_image: bool,
    workers: Workers,
) -> Hypotheses:
    """The pairs matched, refined and weighed."""
    matches = match_pairs(described, registrar, pairs, workers)
    view_of = _views(described) if by_image else no_views
    return weigh(scene.clouds, matches, view_of, options.refine, options.limits, not by_image, workers)


def _views(described: Path) -> ViewOf:
    kept: dict[int, DepthView | None] = {}

    def view_of(row: int) -> DepthView | None:
        if row not in kept:
            kept[row] = load_description(described, row).view
        return kept[row]

    return view_of


def _tried(count: int, pairs: Ints, hypotheses: Hypotheses) -> str:
    every = count * (count - 1) // 2
    refused = ", ".join(f"{number} {reason}" for reason, number in hypotheses.counts.items())
    text = f"{len(pairs)} of {every} pairs were matched, {int(hypotheses.accepted.sum())} may be edges"
    return f"{text} ({refused})" if refused else text


def _apart(piece: Ints, scene: Scene) -> tuple[str, ...]:
    return describe_components(piece, scene.vertex_ids)

"""Global registration of all frames: describe, propose pairs, match, verify, and keep what the diagnosis trusts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.components import describe_components
from hodge_pipeline.diagnosis.diagnosis import diagnose
from hodge_pipeline.pairs.vlad import global_descriptors, most_similar, vocabulary
from hodge_pipeline.registration.acceptance import CONTRADICTS
from hodge_pipeline.registration.global_features import DescribedCloud, describe
from hodge_pipeline.registration.global_landmarks import DescribedImage
from hodge_pipeline.registration.global_pairs import describe_clouds, load_description, match_pairs
from hodge_pipeline.registration.odometry_path import contradicts_odometry
from hodge_pipeline.scene import Drift
from hodge_pipeline.solvers.backbone.trust import SEQUENTIAL
from hodge_pipeline.stages import Advance, GlobalRegistrar, Workers, no_progress
from hodge_pipeline.start.unordered.folds import Pieces, laid_apart, laid_at_first, unfolded
from hodge_pipeline.start.unordered.hypotheses import AMBIGUOUS, ViewOf, weigh
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.start.unordered.scan_checks import (
    check_scans,
    count_from_one_zero,
    mirrored_scans,
    within_their_frame,
)
from hodge_pipeline.start.unordered.views import Views
from hodge_pipeline.types import CloudSet, Edges, Floats, Floats32, Frame, Ints, ViewGraph
from hodge_pipeline.types.edges import REJECTED
from hodge_pipeline.types.notes import Note, notes_of

SIMILARITY_VOXEL_M = 0.05
"""Metres in a room: the scale of the features by which scans are compared where the registrar has none, as that of
`FpfhConsensus`."""


@dataclass(frozen=True)
class Start:
    """The first poses (N, 4, 4), components laid out apart; the edges kept; the component `piece (N,)` of a frame."""

    world_from_cam: Floats
    edges: Edges
    piece: Ints
    notes: tuple[Note, ...]


@dataclass(frozen=True)
class Frames:
    """The frames to join, the folder of their clouds, and the edges and drift of odometry, if there was one."""

    frames: Sequence[Frame]
    clouds: Path
    vertex_ids: NDArray[np.generic]
    given: Edges | None = None
    drift: Drift | None = None


def find_start(scene: Frames, options: GlobalStart, scratch: Path, workers: Workers, advance: Advance) -> Start:
    """Poses of all frames by global registration; `advance` counts frames twice, when described and when placed.

    Unconnected frames become components of their own and are reported. `scratch` is a folder for the descriptions.
    """
    clouds = CloudSet.open(scene.clouds)
    by_image = uses_images(clouds, options)
    notes = [] if by_image or scene.given is not None else [*check_scans(clouds, scene.vertex_ids)]
    hypotheses, views = weighed_matches(scene, np.flatnonzero(clouds.sizes > 0), options, scratch, workers, advance)
    notes.append(tried(int((clouds.sizes > 0).sum()), hypotheses))
    mirrored = np.zeros(0, np.int64)
    if _are_scans(scene, by_image):
        alike = partial(_matched_alone, options=options, workers=workers)
        mirrored = mirrored_scans(clouds, hypotheses, alike, scratch)
        of_mirrored = np.flatnonzero(hypotheses.counts & np.isin(hypotheses.pairs, mirrored).any(axis=1))
        hypotheses = hypotheses.put(of_mirrored, status=REJECTED, why="one of the two seems mirrored")
    measured = hypotheses.as_graph(scene.vertex_ids, hypotheses.counts)
    graph = measured
    if scene.given is not None:
        graph = ViewGraph.joined([scene.given.as_graph(scene.vertex_ids), measured])
    found = diagnose(graph, options.diagnosis)
    notes += [f"{int((~found.kept).sum())} of {graph.edge_count} edges are distrusted"]
    given = int(found.kept[: graph.edge_count - measured.edge_count].sum())
    pieces = Pieces.kept(graph, found)
    pieces = unfolded(clouds, pieces, given, views, options.diagnosis, options.limits.room_m)
    notes += [*pieces.notes, *describe_components(pieces.piece, scene.vertex_ids)]
    advance(len(scene.frames))
    in_one_frame = views is _no_view
    lay = laid_at_first if in_one_frame else partial(laid_apart, clouds=clouds)
    poses = lay(pieces.piece, pieces.poses)
    told = (
        *((Note("one frame"),) if in_one_frame else ()),
        *(Note("mirrored", detail=str(scene.vertex_ids[row])) for row in mirrored),
        *_ambiguous_pairs(hypotheses, pieces.piece),
        *_none_joined(scene, hypotheses, pieces.piece),
    )
    return Start(poses, Edges.measured(pieces.graph), pieces.piece, (*told, *notes_of("start", notes)))


def _are_scans(scene: Frames, by_image: bool) -> bool:
    """Whether the frames are scans alone, in no order."""
    is_ordered = scene.given is not None or scene.drift is not None
    return not (by_image or is_ordered) and all(frame.camera is None for frame in scene.frames)


def _matched_alone(clouds: CloudSet, folder: Path, options: GlobalStart, workers: Workers) -> Edges:
    """All pairs of these clouds, without images, matched and weighed."""
    frames = [Frame(row, float(row)) for row in range(len(clouds))]
    every = replace(options, all_pairs_up_to=len(clouds))
    scene = Frames(frames, folder, np.arange(len(clouds)))
    return weighed_matches(scene, np.arange(len(clouds)), every, folder, workers, no_progress)[0]


def _ambiguous_pairs(hypotheses: Edges, piece: Ints) -> tuple[Note, ...]:
    """A note where ambiguous pairs would have joined components."""
    first, second = hypotheses.pairs[hypotheses.why == AMBIGUOUS].T
    count = int((piece[first] != piece[second]).sum())
    return (Note("ambiguous", count, str(len(hypotheses))),) if count else ()


def _none_joined(scene: Frames, hypotheses: Edges, piece: Ints) -> tuple[Note, ...]:
    """A note with what to do where no two frames are joined."""
    if scene.given is not None or len(np.unique(piece)) < max(len(scene.frames), 2):
        return ()
    if all(frame.world_from_cam is not None for frame in scene.frames):
        return (Note("none joined", detail="--set start=given begins from the poses that they bring"),)
    if not len(hypotheses):
        return (Note("none joined", detail="no pair was tried"),)
    count, why = max(((count, why) for why, count in hypotheses.rejected_counts.items()), default=(0, "none was tried"))
    return (Note("none joined", detail=f"{count} of {len(hypotheses)} pairs: {why}; take more between them"),)


def weighed_matches(
    scene: Frames, rows: Ints, options: GlobalStart, scratch: Path, workers: Workers, advance: Advance
) -> tuple[Edges, ViewOf]:
    """The matched pairs of these rows, with status used where they may be edges, and the depth views of the frames;
    none of scans that no scanner saw from their zero.

    `advance` counts frames as they are described into the folder `scratch`.
    """
    clouds = CloudSet.open(scene.clouds)
    by_image = uses_images(clouds, options)
    registrar: GlobalRegistrar = options.images if by_image else options.registrar
    described = scratch / "described"
    if options.similar_per_frame:
        describe_clouds(scene.clouds, registrar, rows, described, workers, advance)
    pairs = propose(scene, clouds, rows, described, options)
    if not options.similar_per_frame:  # only what the loops pair needs a description
        describe_clouds(scene.clouds, registrar, np.unique(pairs), described, workers, advance)
    matches = match_pairs(described, registrar, pairs, workers)
    views: ViewOf = Views.make(scene.frames, clouds, rows, scratch / "views", workers)
    hypotheses = weigh(scene.clouds, matches, views, options.refine, options.limits, workers)
    if _are_scans(scene, by_image) and count_from_one_zero(hypotheses, options.limits.room_m):
        views = _no_view
        hypotheses = weigh(scene.clouds, matches, views, options.refine, options.limits, workers)
        hypotheses = within_their_frame(hypotheses, options.limits.room_m)
    if scene.drift is not None and options.diagnosis.trust != SEQUENTIAL:  # a backbone judges loops and its own steps
        counted = np.flatnonzero(hypotheses.counts)
        far = counted[contradicts_odometry(hypotheses.select(counted), scene.drift)]
        hypotheses = hypotheses.put(far, status=REJECTED, why=CONTRADICTS)
    return hypotheses.put(slice(None), proposed_by="landmarks" if by_image else "features"), views


def _no_view(row: int) -> None:
    """In the place of views where free space is unknown."""


def uses_images(clouds: CloudSet, options: GlobalStart) -> bool:
    """Whether pairs are matched by their images."""
    if options.use != "auto":
        return options.use == "images"
    return int((np.diff(clouds.marks) >= options.limits.min_inliers).sum()) * 2 >= int((clouds.sizes > 0).sum())


def propose(scene: Frames, clouds: CloudSet, rows: Ints, described: Path, options: GlobalStart) -> Ints:
    """The pairs (P, 2) to match: all of a few frames, else each with the most similar ones, and loops."""
    if len(rows) <= options.all_pairs_up_to:
        return all_pairs(rows)
    pairs = np.zeros((0, 2), np.int64)
    if options.similar_per_frame:
        local = LocalDescriptors(described, clouds, SIMILARITY_VOXEL_M * options.limits.room_m)
        pairs = similar_pairs(local, rows, options, scene.given is not None)
    if scene.drift is None:
        return pairs
    found = [loops.propose(scene.frames, clouds, scene.drift.world_from_cam).pairs for loops in options.loops]
    return np.unique(np.concatenate([pairs, *found]), axis=0)


def tried(count: int, hypotheses: Edges) -> str:
    """In words, how many pairs of `count` frames were matched, and what became of them."""
    every = count * (count - 1) // 2
    refused = ", ".join(f"{number} {reason}" for reason, number in hypotheses.rejected_counts.items())
    text = f"{len(hypotheses)} of {every} pairs were matched, {int(hypotheses.counts.sum())} may be edges"
    return f"{text} ({refused})" if refused else text


class LocalDescriptors:
    """Unit local descriptors of each row: RootSIFT of images, or the square roots of FPFH histograms of clouds."""

    def __init__(self, described: Path, clouds: CloudSet, voxel_m: float) -> None:
        self._described, self._clouds, self._voxel_m = described, clouds, voxel_m

    def descriptors(self, row: int) -> Floats32:
        """Descriptors (n, D) of one frame."""
        found = load_description(self._described, row)
        if isinstance(found, DescribedImage):
            return found.descriptors
        if not isinstance(found, DescribedCloud):  # another registrar's own: geometry is compared by FPFH all the same
            found = describe(self._clouds[row], self._voxel_m)
        features = max((found, *found.coarser), key=len).features
        positive = np.maximum(features, 0)
        return np.asarray(np.sqrt(positive / np.maximum(positive.sum(axis=1, keepdims=True), 1e-12)))


def all_pairs(rows: Ints) -> Ints:
    """Every pair (P, 2) of these rows, i < j."""
    i, j = np.triu_indices(len(rows), 1)
    return np.stack([rows[i], rows[j]], axis=1).astype(np.int64)


def similar_pairs(local: LocalDescriptors, rows: Ints, options: GlobalStart, ordered: bool) -> Ints:
    """Pairs (P, 2), i < j, of each row and the most similar others, by VLAD (Jégou et al. 2010).

    The vocabulary is learnt from the rows themselves, so indoor and outdoor, near and far need nothing else.
    `ordered`: whether rows that follow each other are joined already; see `GlobalStart.reach`.
    """
    centres = vocabulary(local, rows, options.words, options.seed)
    vectors = global_descriptors(local, rows, centres)
    reach = options.reach if ordered else 0
    return np.asarray(np.sort(rows[most_similar(vectors, options.similar_per_frame, reach)], axis=1))

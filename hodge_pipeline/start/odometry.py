"""Initial poses by frame-to-frame odometry, its parts joined by global registration where asked for."""

from __future__ import annotations

from dataclasses import fields
from typing import Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.pairs.revisits import Revisits, find_revisits
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.odometry import Odometry, OdometryOptions, odometry
from hodge_pipeline.registration.odometry_path import drift_of
from hodge_pipeline.registration.tracking.shutter import velocities
from hodge_pipeline.scene import START, Closed, KeyFrames, Round, Scene, key_source, sequences_of, stamps_of, vertex_ids
from hodge_pipeline.solvers.poisson import PoissonSolver
from hodge_pipeline.stages import OPTIONS, Step, Steps, Workers
from hodge_pipeline.start.at_stamps import with_landmarks_at_stamps
from hodge_pipeline.start.clouds import make_clouds, with_landmarks
from hodge_pipeline.start.unordered.join import join_parts
from hodge_pipeline.start.unordered.loops import find_loops, is_long
from hodge_pipeline.start.unordered.options import GlobalStart
from hodge_pipeline.start.unordered.start import uses_images
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, Source
from hodge_pipeline.types.notes import Note, notes_of


@dataclass(frozen=True, config=OPTIONS)
class OdometryStart(OdometryOptions):
    """Registers each frame to the one before it; what this leaves apart may be joined without a guess."""

    relocalise: bool | Literal["auto"] = Field(
        default=False,
        description="join what odometry leaves apart, by `unordered`: after lost tracking, or several sequences; "
        "auto: only where it left something apart, true: always. auto also matches frames that look alike along a path "
        "longer than `revisits.longest_way_m`; true matches more of them",
    )
    unordered: GlobalStart = Field(default=GlobalStart(), description="how parts are joined without a guess")
    revisits: Revisits | None = Field(
        default=Revisits(),
        description="how loops are closed along the path, so that the first pairs are proposed and registered from "
        "poses that have not drifted apart; null: they are not",
    )

    @property
    def odometry(self) -> OdometryOptions:
        """The options of the odometry alone: others do not change what it finds."""
        return OdometryOptions(**{field.name: getattr(self, field.name) for field in fields(OdometryOptions)})

    def begin(self, source: Source, clouds: CloudOptions, steps: Steps, workers: Workers) -> Scene:
        """Every frame of the source with its cloud and its pose by odometry."""
        sequences = tuple(sequences_of(source).values())
        stamps = np.array([frame.stamp_s for frame in source.frames])
        made = make_clouds(source, clouds, steps, workers)
        found = steps.step(
            chain, made, sequences, stamps, clouds.unit_m, self.odometry,
            title="odometry", total=len(stamps), workers=workers,
        )  # fmt: skip
        poses, pairs = found.world_from_cam, found.steps.pairs
        twists = velocities(poses, stamps_of(source), connected_components(pairs, len(made)), np.ones(len(made), bool))
        pairs = pairs[found.steps.by_landmarks]
        made = with_landmarks_at_stamps(source, made, poses, twists, pairs, clouds.unit_m, steps)
        key_frames = KeyFrames.all_of(source, found.world_from_cam)
        return self.joined(source, made, clouds, found, key_frames, steps, workers)

    def joined(
        self,
        source: Source,
        clouds: CloudSet,
        options: CloudOptions,
        found: Odometry,
        key_frames: KeyFrames,
        steps: Steps,
        workers: Workers,
    ) -> Scene:
        """The scene of the key frames: components joined as `relocalise` says, loops closed by `revisits`.

        `clouds` are those of the key frames, made by `options`; `found` is odometry on them.
        """
        keys = key_source(source, key_frames.rows)
        steps.remember(keys, steps.key([source, key_frames.rows]))
        drift = drift_of(found.world_from_cam, found.steps, self.tail)
        first = Round(found.steps, vertex_ids(keys), found.world_from_cam)
        several = int((np.bincount(drift.part) > 1).sum()) > 1
        if self.relocalise is True or (self.relocalise == "auto" and several):
            clouds = with_landmarks(keys, clouds, options, self.unordered, steps, workers)
            first = join_parts(keys, clouds, first, drift, self.unordered, steps, workers)
        closed = None
        if self.revisits is not None and first.name != START:
            known, count = None, len(found.world_from_cam)
            if self.relocalise == "auto" and is_long(clouds, found.steps, drift, self.revisits):
                clouds = with_landmarks(keys, clouds, options, self.unordered, steps, workers)
                if uses_images(clouds, self.unordered):  # surfaces alone look alike too often
                    known = steps.step(
                        find_loops, keys, clouds, found.steps, drift, self.revisits, self.unordered,
                        title="loops by what frames look like", total=count, workers=workers,
                    )  # fmt: skip
            closed = steps.step(
                close_loops, clouds, first, drift.part, self.revisits, known, title="loops along the path", total=count
            )
        return Scene(source, keys, key_frames, clouds, first, None if self.tail is None else drift, closed=closed)


def close_loops(
    clouds: CloudSet, first: Round, part: Ints, options: Revisits, known: Edges | None = None, *, step: Step
) -> Closed:
    """Step: the first poses, loops closed by revisits within each component `part (K,)`; some may be `known`."""
    found = find_revisits(clouds, first.world_from_cam, part, options, step.advance, known)
    if not len(found):
        return Closed(first.world_from_cam, found.pairs)
    graph = Edges.joined([first.edges, found]).as_graph(np.arange(len(clouds)))
    poses = PoissonSolver().solve(graph, first.world_from_cam).world_from_cam
    moved = se3.inverse(first.world_from_cam) @ poses
    largest_m = float(np.linalg.norm(moved[:, :3, 3], axis=1).max())
    step.note(Note("revisits", len(found), f"{largest_m:.2g} m"))
    return Closed(poses, found.pairs)


def chain(
    clouds: CloudSet,
    sequences: tuple[Ints, ...],
    stamps_s: Floats,
    scale: float,
    options: OdometryOptions,
    *,
    workers: Workers,
    step: Step,
) -> Odometry:
    """Step: poses of all frames by `registration.odometry`, without the steps that free space refutes; `scale`
    multiplies lengths that are for rooms.
    """
    found = odometry(clouds.folder, sequences, stamps_s, options, workers, step.advance, scale)
    step.note(*notes_of("start", found.notes))
    return found

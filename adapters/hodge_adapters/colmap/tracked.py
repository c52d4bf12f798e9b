"""A COLMAP model to be refined: bodies that move, points that follow them, bundle adjustment, and writing it again.

pycolmap holds the model, so that rigs, cameras, names and colours come out as they went in. A body is one of COLMAP's
frames: all cameras of a rig at one moment, or a single image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from hodge_adapters.colmap.beside import DepthOptions, EdgeOptions, PriorOptions
from hodge_adapters.colmap.bodies import Bodies, bodies_of, body_graph
from hodge_adapters.colmap.bundle import Refine, adjust
from hodge_adapters.colmap.calibration_changes import calibration_changes
from hodge_adapters.colmap.content import content_of, read_reconstruction, refreshed
from hodge_adapters.colmap.database import database_pairs
from hodge_adapters.colmap.edges import covisible_pairs, measured_graph
from hodge_adapters.colmap.points import (
    parallaxes,
    points_of_rays,
    reprojection_errors,
    thinned_points,
    update_errors,
    with_points,
)
from hodge_adapters.colmap.priors import body_priors, placing
from hodge_adapters.colmap.pycolmap_import import pycolmap
from hodge_adapters.colmap.records import Model
from hodge_adapters.colmap.resection import resected
from hodge_adapters.colmap.scale import seen_depths
from hodge_adapters.colmap.ties import apart_matches, merge_matched_points
from hodge_adapters.colmap.uncertainty import information
from hodge_pipeline import se3
from hodge_pipeline.types import (
    Bools,
    CloudSet,
    Floats,
    Frame,
    Ints,
    ModelQuality,
    PointCloud,
    PositionPriors,
    ViewGraph,
)
from hodge_pipeline.types.text import counted
from hodge_pipeline.types.tracked_model import Adjusted, PoseInformation

LEAST_LEFT = 3
"""Entries of a track: two would meet in a point wherever the images are."""

FEW_BEHIND = 0.01
"""Of the observations: where more are behind their cameras, these are wrong and not the points."""


@dataclass(frozen=True)
class ColmapModel:
    """See `types.tracked_model.TrackedModel`. The reconstruction is never changed in place."""

    name: str
    reconstruction: pycolmap.Reconstruction
    all_frames: dict[str, Frame]
    depth: DepthOptions
    edges: EdgeOptions
    text: bool = False
    files: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()
    refine: Refine = "none"
    robust: bool = False
    roughly: bool = False
    known: PriorOptions = field(default_factory=PriorOptions)
    has_converged: bool = True
    """False of an adjusted model whose adjustment COLMAP's limit of steps ended."""
    placing: str = ""
    """What gave the model its place in the world, empty where nothing did."""
    tracks: Model | None = None
    """The content of a model with the same tracks, from which this one differs by poses and positions alone."""
    content: Model | None = None
    """The content of this very model, where that is known: pycolmap gives it point by point."""

    @property
    def native(self) -> pycolmap.Reconstruction:
        """The reconstruction itself."""
        return self.reconstruction

    @property
    def measurements(self) -> tuple[Path, ...]:
        """The database, known positions and the depth images."""
        files = (self.edges.database, self.known.file, *self.depth.files.values())
        return tuple(dict.fromkeys(file for file in files if file is not None))

    @cached_property
    def records(self) -> Model:
        """The model as plain arrays, images in natural order of their names."""
        if self.content is not None:
            return self.content
        return content_of(self.reconstruction) if self.tracks is None else refreshed(self.tracks, self.reconstruction)

    @cached_property
    def bodies(self) -> Bodies:
        """The bodies, and which of them carries each image."""
        images = (self.tracks or self.records).images
        return bodies_of(self.reconstruction, [image.image_id for image in images])

    @cached_property
    def frames(self) -> Sequence[Frame]:
        """The posed images, with depth and colour where they are to be read."""
        return tuple(
            replace(self.all_frames[image.name], world_from_cam=image.world_from_cam) for image in self.records.images
        )

    @property
    def body_names(self) -> tuple[str, ...]:
        """Each body by the name of its first image."""
        return self.bodies.names

    @property
    def world_from_body(self) -> Floats:
        """Poses (B, 4, 4)."""
        return self.bodies.world_from_body

    @property
    def body_of_frame(self) -> Ints:
        """The body (N,) of each image."""
        return self.bodies.body_of_image

    @property
    def body_from_cam(self) -> Floats:
        """Where (N, 4, 4) a body carries its image."""
        return self.bodies.body_from_cam

    @cached_property
    def quality(self) -> ModelQuality:
        """Errors are computed anew: what a file says of them may be older than its poses."""
        records = self.records
        owners = records.points.owners
        return ModelQuality(
            images=self.reconstruction.num_reg_images(),
            points=self.reconstruction.num_points3D(),
            mean_track_length=float(self.reconstruction.compute_mean_track_length()),
            image_names=tuple(image.name for image in records.images),
            keypoints=records.keypoints,
            errors_px=reprojection_errors(records),
            parallaxes_deg=parallaxes(records)[owners],
            track_lengths=records.track_lengths,
            point_rows=owners,
        )

    def seen_depths(self) -> Sequence[Floats]:
        """Depths by sensor and model at the observations of each image with depth, of a few hundred evenly."""
        depth = self.depth
        files = {
            row: depth.files[image.name] for row, image in enumerate(self.records.images) if image.name in depth.files
        }
        return seen_depths(self.records, files, depth.units_per_metre, depth.no_depth, depth.camera)

    def seen_points(self) -> CloudSet:
        """The tracked points that each body's images see, in its axes; a point counts once for each body."""
        points, known = self.records.points, self.reconstruction.points3D
        colours = np.array([known[key].color for key in points.ids.tolist()], np.uint8).reshape(-1, 3)
        body = self.bodies.body_of_image[self.records.image_rows]
        seen = np.unique(np.stack([body, points.owners], axis=1), axis=0)
        clouds = []
        for row, pose in enumerate(se3.inverse(self.world_from_body)):
            own = seen[seen[:, 0] == row, 1]
            clouds.append(PointCloud(se3.transform(pose, points.xyz[own]).astype(np.float32), colours=colours[own]))
        return CloudSet.from_clouds(clouds)

    def measured(self) -> tuple[ViewGraph, tuple[str, ...]]:
        """Edges of the database where there is one, else of covisible images."""
        notes: list[str] = []
        options, records = self.edges, self.records
        if options.database is None:
            pairs = covisible_pairs(records, options.min_shared, options.max_edges_per_image)
        else:
            pairs = database_pairs(options.database, records, options.min_shared, notes)
        graph = measured_graph(records, pairs, options.min_shared // 2, options.seed, notes)
        return body_graph(graph, self.bodies), tuple(notes)

    @cached_property
    def held_apart(self) -> int:
        """Pairs of images that the database matches well and that share hardly a point."""
        database = self.edges.database
        return 0 if database is None else sum(1 for _ in apart_matches(self.records, database, self.edges.min_shared))

    def resected(self, bodies: Bools | None = None) -> Floats:
        """Poses (B, 4, 4): those of these bodies (B,), all by default, by the points; see `resection`."""
        return resected(self.records, self.bodies, bodies)

    @property
    def known_positions(self) -> PositionPriors | None:
        """Where bodies should be, of a model that was placed by known positions."""
        names = [image.name for image in self.records.images]
        return body_priors(names, self.bodies, self.known.images, self.known.sigma_m) if self.placing else None

    def placed(self) -> ColmapModel:
        """The model in the world of what is known of its images; as it is, with a note, where that does not tell."""
        if not self.known.images:
            return self
        names, poses = [image.name for image in self.records.images], self.records.world_from_cam
        found = placing(names, poses, self.known.images, self.known.sigma_m)
        if isinstance(found, str):
            return replace(self, notes=(*self.notes, found))
        copy = self._copy()
        copy.transform(found.world_from_model)
        return self._of(copy, self.records, placing=found.told)

    def scaled(self, factor: float, motion: Floats | None = None) -> ColmapModel:
        """Positions times the factor, then the whole moved by `motion` (4, 4)."""
        before, copy, moved = self.records, self._copy(), np.eye(4) if motion is None else motion
        copy.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(moved[:3, :3]), moved[:3, 3]))
        return self._of_content(copy, refreshed(before, copy, se3.transform(moved, factor * before.points.xyz)))

    def scaled_parts(self, part: Ints, factors: Floats, motions: Floats) -> ColmapModel:
        """Positions of each part times its factor, then moved; points of several parts where their rays meet."""
        points, row = self.records.points, part[self.bodies.body_of_image[self.records.image_rows]]
        poses = self.world_from_body.copy()
        poses[:, :3, 3] *= factors[part, None]
        poses = motions[part] @ poses
        of_point = np.zeros(len(points.ids), np.int64)
        np.maximum.at(of_point, points.owners, row)
        several = np.bincount(points.owners, row != of_point[points.owners], len(of_point)) > 0
        xyz = se3.transform(motions[of_point], factors[of_point, None, None] * points.xyz[:, None])[:, 0]
        xyz[several] = self._where_rays_meet(poses)[several]
        return self._at(poses, xyz)

    def moved(self, world_from_body: Floats) -> ColmapModel:
        """Bodies at these poses, points where their rays meet; what the database matched is merged where it fits."""
        return self._at(world_from_body, self._where_rays_meet(world_from_body))

    def _where_rays_meet(self, world_from_body: Floats) -> Floats:
        """Where points (P, 3) are with the bodies at these poses."""
        return points_of_rays(self.records, world_from_body[self.bodies.body_of_image] @ self.bodies.body_from_cam)

    def _at(self, world_from_body: Floats, xyz: Floats) -> ColmapModel:
        """Bodies at these poses, points at these positions (P, 3)."""
        before, copy = self.records, self._copy()
        for frame_id, pose in zip(self.bodies.frame_ids, world_from_body, strict=True):
            copy.frames[frame_id].rig_from_world = pycolmap.Rigid3d(np.ascontiguousarray(se3.inverse(pose)[:3]))
        points = copy.points3D
        for point_id, place in zip(before.points.ids.tolist(), xyz, strict=True):
            points[point_id].xyz = place
        update_errors(copy)
        return self._of_content(copy, refreshed(before, copy, xyz))

    def thinned(self, most_seen: int) -> ColmapModel:
        """A random part of the tracks, of which each image sees so many, or all of its own; this very model where no
        image sees more. They are the same for models of the same tracks.
        """
        records = self.records
        kept = thinned_points(records, most_seen)
        if kept.all():
            return self
        copy = self._copy()
        for point_id in records.points.ids[~kept].tolist():
            copy.delete_point3D(point_id)
        return self._of_content(copy, with_points(records, kept))

    def merged(self) -> ColmapModel:
        """What the database matched is one point where one position fits; this very model where nothing is merged."""
        if not self.held_apart:
            return self
        assert self.edges.database is not None
        copy = self._copy()
        count = merge_matched_points(copy, self.records, self.edges.database, self.edges.min_shared)
        if not count:
            return self
        update_errors(copy)
        notes = (*self.notes, f"{counted(count, 'pair')} of points that a match calls one were merged")
        return self._of(copy, None, notes=notes)

    def adjusted(
        self, priors: PositionPriors | None = None, *, move_bodies: bool = True, near_optimum: bool = False
    ) -> ColmapModel:
        """Bundle adjustment with rigs held, and intrinsics unless they are to be refined; see `bundle.adjust`.

        Where it leaves a few points behind their cameras, those are placed anew and all is adjusted once more.
        """
        first = self._adjusted(priors, move_bodies, near_optimum)
        behind = len(first._behind())
        if not 0 < behind <= FEW_BEHIND * len(first.quality.errors_px):
            return first
        placed = first.moved(first.world_from_body)
        return placed._adjusted(priors, move_bodies) if len(placed._behind()) < behind else first

    def _adjusted(self, priors: PositionPriors | None, move_bodies: bool, near_optimum: bool = False) -> ColmapModel:
        copy = self._copy()
        refine: Refine = self.refine if move_bodies else "none"
        loose, converged = adjust(
            copy,
            self._behind(),
            self.bodies,
            priors,
            move_bodies=move_bodies,
            refine=refine,
            robust=self.robust,
            roughly=self.roughly,
            near_optimum=near_optimum,
        )
        if loose:
            after = refreshed(self.records, copy)
            found = points_of_rays(after, after.world_from_cam)
            for point_id, xyz in zip(after.points.ids.tolist(), found, strict=True):
                if point_id in loose:
                    copy.points3D[point_id].xyz = xyz
        update_errors(copy)
        return self._of(copy, self.records, has_converged=converged)

    def with_robust_loss(self) -> ColmapModel:
        """The same model, whose adjustments let an observation that is far off pull little."""
        return replace(self, robust=True)

    def with_free(self, refine: Literal["rig", "focal", "all"]) -> ColmapModel:
        """The same model, whose adjustments refine rigs, focal lengths, or all intrinsics, roughly."""
        return replace(self, refine=refine, roughly=True)

    @property
    def moves_calibration(self) -> bool:
        """Whether bundle adjustment changes more than poses and points."""
        return self.refine != "none"

    def _behind(self) -> list[tuple[int, int]]:
        """Image and keypoint of each observation whose point lies behind the camera."""
        keypoints = self.quality.keypoints[np.isinf(self.quality.errors_px)]
        return [(self.records.images[row].image_id, int(column)) for row, column in keypoints]

    @cached_property
    def information(self) -> PoseInformation:
        """What the tracks tell of the bodies' poses; see `uncertainty.information`."""
        return information(self.records, self.bodies, robust=self.robust)

    def held_out_errors(self, entries: Bools, adjusts: Adjusted) -> Floats:
        """Errors (H,) of these entries of tracks (T,) after an adjustment without them of nothing, the points or all.

        An entry whose point too few others would place is left in, and out of the answer.
        """
        copy, records = self._copy(), self.records
        left, held = np.diff(records.points.offsets), []
        for at in np.flatnonzero(entries):
            owner = records.points.owners[at]
            if left[owner] > LEAST_LEFT:
                left[owner] -= 1
                held.append(at)
                image = records.images[records.image_rows[at]]
                copy.delete_observation(image.image_id, int(records.points.columns[at]))
        if adjusts != "nothing":
            everything = adjusts == "all"  # an adjusted model is near its optimum without a part of the entries
            adjust(copy, [], self.bodies, None, move_bodies=everything, robust=self.robust, near_optimum=everything)
        return reprojection_errors(refreshed(records, copy))[held]

    def write(self, folder: Path) -> None:
        """Five files, binary or text as the model was."""
        (self.reconstruction.write_text if self.text else self.reconstruction.write_binary)(folder)

    def read_back(self, folder: Path, notes: tuple[str, ...]) -> ColmapModel:
        """The model of that folder with the frames, depth and database of this one."""
        back = read_reconstruction(folder)
        # merging alone changes tracks, and leaves fewer points
        tracks = self.records if back.num_points3D() == self.reconstruction.num_points3D() else None
        notes = *notes, *calibration_changes(self.reconstruction, back, self.refine)
        return self._of(back, tracks, notes=notes)

    def _of(self, reconstruction: pycolmap.Reconstruction, tracks: Model | None, **changes: Any) -> ColmapModel:
        """The same model of another reconstruction, with the tracks of this content; None: tracks that it has alone."""
        known = {"files": (), "content": None, "has_converged": True, **changes}
        return replace(self, reconstruction=reconstruction, tracks=tracks, **known)

    def _of_content(self, reconstruction: pycolmap.Reconstruction, content: Model) -> ColmapModel:
        """The same model of another reconstruction, which has this content."""
        return self._of(reconstruction, content, content=content)

    def _copy(self) -> pycolmap.Reconstruction:
        return pycolmap.Reconstruction(self.reconstruction)

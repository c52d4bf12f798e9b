"""Long sequences: the key frames that a run works on, and the poses of all frames that follow from theirs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.complex.components import connected_components
from hodge_pipeline.recipe.schema import Recipe, cloud_options
from hodge_pipeline.refine.correction import spread_correction
from hodge_pipeline.registration.bridging import bridge
from hodge_pipeline.registration.odometry import chained
from hodge_pipeline.registration.pairs import Registered
from hodge_pipeline.registration.tracked_blocks import BlockRows, TrackedBlocks
from hodge_pipeline.registration.tracking import FrameBlock, TrackingOptions, frame_blocks, track_block
from hodge_pipeline.report.summary import in_runs
from hodge_pipeline.rounds import Round, sequences_of
from hodge_pipeline.stages import Advance, Workers
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.job import Job
from hodge_pipeline.store.workspace import key_of
from hodge_pipeline.types import Bools, CloudSet, Floats, Frame, Ints, Source

CLOUDS = "clouds"
"""The stage holds the key frames' clouds, as it does where all frames are registered."""
COLUMNS = ("key_rows", "anchors", "key_from_frame", "found", "world_from_key", "piece")
NOTES_SHOWN = 5


@dataclass(frozen=True)
class Tracked:
    """A source of which the key frames (K rows) alone are registered.

    `anchors (N,)` is the key frame, counted among the K, that each frame was registered to, `key_from_frame (N, 4, 4)`
    the motion, `found (N,)` whether it was; `world_from_key (K, 4, 4)` are the poses that tracking led to, and `piece
    (K,)` the part of the sequences that it held together.
    """

    whole: Source
    key_rows: Ints
    anchors: Ints
    key_from_frame: Floats
    found: Bools
    world_from_key: Floats
    piece: Ints
    steps: Registered

    def all_poses(self, world_from_key: Floats) -> Floats:
        """Poses (N, 4, 4) of all frames that follow from those (K, 4, 4) of the key frames.

        Between two key frames the change that these went through is interpolated; a frame that was not registered lies
        between its neighbours in time.
        """
        before = self.world_from_key[self.anchors] @ self.key_from_frame
        after = before.copy()
        for piece in range(int(self.piece.max(initial=-1)) + 1):
            keys = np.flatnonzero(self.piece == piece)
            rows = np.flatnonzero(self.piece[self.anchors] == piece)
            times = self.key_rows[keys].astype(float)
            after[rows] = spread_correction(
                rows.astype(float), before[rows], times, self.world_from_key[keys], world_from_key[keys]
            )
        for rows in sequences_of(self.whole).values():
            after[rows] = _filled(after[rows], self.found[rows], stamps_of(self.whole)[rows])
        return np.asarray(after)


def key_frames(job: Job, source: Source) -> Source:
    """The source with its key frames alone, where it is long enough to have some; what is known of the others is then
    `job.tracked`.
    """
    recipe = job.recipe
    if recipe.start != "odometry" or len(source.frames) <= recipe.key_frames.whole_up_to or job.given is not None:
        return source
    if recipe.key_frames.distance_m == 0 or not any(frame.read_depth or frame.read_points for frame in source.frames):
        return source
    options, count = tracking_options(recipe), len(source.frames)
    with job.stage(CLOUDS, "tracking", count, options, ("source",)) as (folder, advance):
        if not folder.finished:
            with job.workers() as workers:
                tracked, notes = _track(source, options, folder.path, workers, advance)
            columns = {name: getattr(tracked, name) for name in COLUMNS}
            artifacts.save_arrays(folder.path / "tracked.npz", columns)
            artifacts.save(folder.path / "steps.npz", tracked.steps)
            for note in notes:
                job.note(note)
    stored = artifacts.load_arrays(job.path(CLOUDS) / "tracked.npz")
    steps = artifacts.load(job.path(CLOUDS) / "steps.npz", Registered)
    job.tracked = Tracked(whole=source, steps=steps, **stored)
    job.keys["source"] = key_of(job.keys["source"], job.keys[CLOUDS])
    frames = tuple(source.frames[row] for row in job.tracked.key_rows)
    return replace(source, frames=frames)


def tracking_options(recipe: Recipe) -> TrackingOptions:
    """How the recipe's frames are followed: landmarks only where its odometry registers by them, in smaller images."""
    followed = replace(recipe.clouds, landmark_scale=2 * recipe.clouds.landmark_scale)
    return TrackingOptions(
        clouds=cloud_options(recipe, apart=True),
        followed=followed,
        odometry=recipe.odometry,
        distance_m=recipe.key_frames.distance_m,
        angle_rad=float(np.deg2rad(recipe.key_frames.angle_deg)),
    )


def first_poses(job: Job, tracked: Tracked, source: Source) -> Round:
    """Round 0: the poses that tracking led to."""
    with job.stage("odometry", "odometry", 1, None, (CLOUDS,)) as (_, advance):
        advance(1)
    ids = np.array([frame.frame_id for frame in source.frames])
    return Round(tracked.steps.as_graph(ids, np.full(len(tracked.steps.pairs), "sequential")), tracked.world_from_key)


def frames_to_fuse(job: Job, source: Source, last: Round) -> tuple[Sequence[Frame], Floats]:
    """Every frame with a pose of its own, key frame or not, and the poses (N, 4, 4); those of frames that nothing
    placed, such as a scan in other units, are not finite. After an edit a person waits: of a long source the key frames
    alone.
    """
    world_from_cam = last.world_from_cam
    if job.tracked is not None and (job.scoring or last.disabled is None):
        poses = job.tracked.all_poses(world_from_cam)
        return job.tracked.whole.frames, np.asarray(np.where(job.tracked.found[:, None, None], poses, np.nan))
    if job.tracked is not None:
        job.note(
            f"fused after an edit: the {len(source.frames)} key frames alone; hodge run, as before, fuses all frames"
        )
    has_cloud = CloudSet.open(job.path("clouds")).sizes > 0
    return source.frames, np.asarray(np.where(has_cloud[:, None, None], world_from_cam, np.nan))


def _track(
    source: Source, options: TrackingOptions, folder: Path, workers: Workers, advance: Advance
) -> tuple[Tracked, tuple[str, ...]]:
    """The source tracked; `folder` gets the key frames' clouds."""
    stamps, sequences = stamps_of(source), list(sequences_of(source).values())
    cut = [block for rows in sequences for block in frame_blocks(rows, tuple(source.frames), stamps)]
    blocks = TrackedBlocks(folder / "blocks")
    done = blocks.finished()
    missing = [number for number in range(len(cut)) if number not in done]
    advance(sum(len(cut[number].rows) - cut[number].warm_up for number in done))
    for at, block in workers.map(partial(track_block, options), [cut[number] for number in missing]):
        blocks.write(missing[at], block)
        advance(len(block.rows))
    parts = [blocks.rows(number) for number in range(len(cut))]
    fresh = [np.arange(int(block.warm_up), len(part.keys)) for block, part in zip(cut, parts, strict=True)]
    blocks.join_clouds(fresh, folder)
    key_rows = np.concatenate([part.keys[keep] for part, keep in zip(parts, fresh, strict=True)])
    key_of_row = {int(row): key for key, row in enumerate(key_rows)}
    steps = Registered.joined([part.steps for part in parts])
    steps = replace(steps, pairs=_renumbered(steps.pairs, key_of_row))
    key_sequences = [np.flatnonzero(np.isin(key_rows, rows)) for rows in sequences]
    poses = chained(len(key_rows), key_sequences, steps)
    held, poses = bridge(folder, key_sequences, steps, poses, options.odometry, workers)
    tracked = Tracked(
        whole=source,
        key_rows=key_rows,
        world_from_key=poses,
        piece=connected_components(held.pairs, len(key_rows)),
        steps=held,
        **_followers(parts, cut, key_of_row),
    )
    tracked = _without_lonely(tracked)
    blocks.remove()
    return tracked, _notes(tracked, parts)


def _renumbered(rows: Ints, key_of_row: dict[int, int]) -> Ints:
    return np.array([key_of_row[row] for row in rows.ravel().tolist()], np.int64).reshape(rows.shape)


def _followers(parts: list[BlockRows], cut: list[FrameBlock], key_of_row: dict[int, int]) -> dict[str, Any]:
    """What each row of the whole was registered to; a row that two blocks share belongs to the earlier one."""
    fresh = [slice(int(block.warm_up), None) for block in cut]
    rows = np.concatenate([part.rows[keep] for part, keep in zip(parts, fresh, strict=True)])
    anchors = np.concatenate([part.anchors[keep] for part, keep in zip(parts, fresh, strict=True)])
    motions = np.concatenate([part.key_from_row[keep] for part, keep in zip(parts, fresh, strict=True)])
    fitness = np.concatenate([part.fitness[keep] for part, keep in zip(parts, fresh, strict=True)])
    order = np.argsort(rows)
    return {
        "anchors": _renumbered(anchors[order], key_of_row),
        "key_from_frame": motions[order],
        "found": np.isfinite(fitness[order]),
    }


def _without_lonely(tracked: Tracked) -> Tracked:
    """A key frame that no step holds, and its followers, were not found, as frames in the dark are not."""
    lonely = np.bincount(tracked.piece)[tracked.piece] == 1
    return tracked if lonely.all() else replace(tracked, found=tracked.found & ~lonely[tracked.anchors])


def _notes(tracked: Tracked, parts: list[BlockRows]) -> tuple[str, ...]:
    frames, keys = len(tracked.anchors), len(tracked.key_rows)
    notes = [f"{keys} of {frames} frames are key frames: these are registered, the others move as those around them"]
    lost = np.flatnonzero(~tracked.found)
    ids = np.array([frame.frame_id for frame in tracked.whole.frames])
    if len(lost):
        notes.append(
            f"tracking was lost at {len(lost)} frames ({in_runs(lost, ids)}): their poses lie between their neighbours'"
        )
    sizes = np.bincount(tracked.piece)
    pieces = int((sizes > 1).sum())
    if pieces > len(sequences_of(tracked.whole)):
        notes.append(f"tracking was lost for good in {pieces - 1} places: {pieces} pieces of the path begin anew")
    return (*notes, *_few(list(dict.fromkeys(note for part in parts for note in part.notes))))


def _few(notes: list[str]) -> list[str]:
    hidden = len(notes) - NOTES_SHOWN
    return notes if hidden <= 1 else [*notes[:NOTES_SHOWN], f"… and {hidden} more frames such as these"]


def stamps_of(source: Source) -> Floats:
    """Times (N,) of the frames; their numbers in a sequence whose stamps do not ascend: those are no clock."""
    stamps = np.array([frame.stamp_s for frame in source.frames], float)
    for rows in sequences_of(source).values():
        if not (np.diff(stamps[rows]) > 0).all():
            stamps[rows] = np.arange(len(rows))
    return stamps


def _filled(poses: Floats, found: Bools, times: Floats) -> Floats:
    """The poses, those not found taken between the nearest found ones, or from the nearest at an end."""
    known = np.flatnonzero(found)
    if found.all() or not len(known):
        return poses
    missing = np.flatnonzero(~found)
    after = np.clip(np.searchsorted(known, missing), 0, len(known) - 1)
    before = np.clip(np.searchsorted(known, missing) - 1, 0, len(known) - 1)
    a, b = known[before], known[after]
    share = np.clip((times[missing] - times[a]) / np.where(b > a, times[b] - times[a], 1.0), 0.0, 1.0)
    out = poses.copy()
    out[missing] = se3.interpolate(poses[a], poses[b], share)
    return np.asarray(out)

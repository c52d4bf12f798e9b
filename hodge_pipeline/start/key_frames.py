"""Initial poses of long sequences: optical flow tracks every frame, and only key frames enter the pose graph."""

from __future__ import annotations

from dataclasses import dataclass as plain_dataclass
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass
from scipy.special import bdtrc

from hodge_pipeline.complex.components import connected_components, in_runs
from hodge_pipeline.registration.cloud_set import no_clouds
from hodge_pipeline.registration.clouds import CloudOptions
from hodge_pipeline.registration.gaps import told_gaps
from hodge_pipeline.registration.odometry import REACHES_APART, Odometry, chained
from hodge_pipeline.registration.tracking.blocks import BlockRows, TrackedBlocks
from hodge_pipeline.registration.tracking.bridging import bridge
from hodge_pipeline.registration.tracking.focal import estimate_focal
from hodge_pipeline.registration.tracking.frame import find_repeats
from hodge_pipeline.registration.tracking.readout import estimate_readout
from hodge_pipeline.registration.tracking.shutter import velocities
from hodge_pipeline.registration.tracking.sightings import views
from hodge_pipeline.registration.tracking.smoothing import VIDEO_STEP_S
from hodge_pipeline.registration.tracking.tracker import FrameBlock, TrackingOptions, frame_blocks, track_block
from hodge_pipeline.scene import (
    KeyFrames,
    Scene,
    faster_than_cameras,
    has_real_stamps,
    is_clock,
    sequence_numbers,
    sequences_of,
    stamps_of,
    vertex_ids,
)
from hodge_pipeline.stages import OPTIONS, Advance, Step, Steps, Workers
from hodge_pipeline.start.at_stamps import landmarks_at_stamps, other_readout
from hodge_pipeline.start.odometry import OdometryStart
from hodge_pipeline.store.codec import CLOUDS
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints, Source
from hodge_pipeline.types.notes import Note, notes_of
from hodge_pipeline.types.text import counted

NOTES_SHOWN = 5
WHOLE_STILLS = 300
"""Frames up to which `auto` registers every frame of what is no video, whose steps optical flow may not bridge."""
STILL, DOUBTED, BY_CHANCE = 0.07, 0.1, 0.01
"""Share of the frames whose motion may be an object's, from which the whole path is in doubt: of fr1/rpy's every third
frame, where nothing moves but much is blurred, the first are. So many of a few frames may be chance: the last is the
probability of as many where that share is usual, below which they are not.
"""


@plain_dataclass(frozen=True)
class Tracked:
    """The K key frames among the N frames, and the motion of every frame from its key frame.

    `anchors (N,)` is the key frame of each frame, counted among the K, `key_from_frame (N, 4, 4)` the motion,
    `found (N,)` whether it was tracked; `world_from_key (K, 4, 4)` are the poses by `steps`, `piece (K,)` their
    connected components; `sightings` is a folder of `Sightings`; `apart` and `readout_s`: see `KeyFrames`.
    """

    clouds: CloudSet
    key_rows: Ints
    anchors: Ints
    key_from_frame: Floats
    found: Bools
    world_from_key: Floats
    piece: Ints
    steps: Edges
    sightings: Path
    apart: Ints
    readout_s: float | None = None


@dataclass(frozen=True, config=OPTIONS)
class KeyFrameStart(OdometryStart):
    """Tracks a long sequence from key frame to key frame and registers these alone; registers a short one whole."""

    whole_up_to: Annotated[int, Field(ge=1)] | Literal["auto"] = Field(
        default=300,
        description="frames: a source of so many is registered whole; a longer one is tracked from key frame to key "
        "frame, which are chosen by how far the camera moved and by what it still sees. auto: a video, whose frames "
        "are at most 0.2 s apart by a clock or by their numbers, is tracked at any length, all else as 300",
    )
    distance_m: float = Field(
        default=0.1,
        ge=0,
        description="metres from the last key frame at which a frame becomes one; 0: every frame. At 0.1 the pose "
        "between two key frames is known from its own tracking to a few millimetres",
    )
    angle_deg: float = Field(default=8.0, ge=0, description="degrees, likewise")
    repose: bool = Field(
        default=True,
        description="pose every frame between key frames anew, once these are solved, by the corners that it saw of "
        "its key frame; not of a camera whose depth and colour are not calibrated to each other, as that of 7-Scenes: "
        "there tracked steps between key frames stand, where else each is registered anew",
    )

    def begin(self, source: Source, clouds: CloudOptions, steps: Steps, workers: Workers) -> Scene:
        """The key frames of a long source, every frame of a short one, with their clouds and poses by odometry."""
        can_be_tracked = any(frame.read_depth or frame.read_points for frame in source.frames)
        if len(source.frames) <= self._whole_up_to(source) or self.distance_m == 0 or not can_be_tracked:
            if self.distance_m > 0 and self.whole_up_to == "auto" and _is_without_rate(source):
                steps.note(Note("not a video", len(source.frames)))
            return super().begin(source, clouds, steps, workers)
        options = self._tracking(clouds)
        found = steps.step(track, source, options, title="tracking", total=len(source.frames), workers=workers)
        steps.remember(found.clouds, steps.key(found) + "clouds")
        odometry = Odometry(found.world_from_key, found.steps, ())
        scene = self.joined(source, found.clouds, clouds, odometry, followers(source, found), steps, workers)
        steps.remember(found.sightings, steps.key(found) + "sightings")
        # Where colour is not calibrated to depth, surfaces register the pairs, which a Kinect warps: of 40 parts of red
        # kitchen (5 to 30 frames) 21 ended worse than tracked, 10 where its steps stand; its quarter at 4.2 and 3.7 cm.
        return replace(scene, sightings=found.sightings if self.repose else None, steps_stand=not self.repose)

    def _whole_up_to(self, source: Source) -> int:
        if self.whole_up_to != "auto":
            return self.whole_up_to
        return 0 if is_video(source) else WHOLE_STILLS

    def _tracking(self, clouds: CloudOptions) -> TrackingOptions:
        """How frames are followed."""
        return TrackingOptions(
            clouds=clouds,
            odometry=self.odometry,
            distance_m=self.distance_m,
            angle_rad=float(np.deg2rad(self.angle_deg)),
        )


def is_video(source: Source) -> bool:
    """Whether it has depth images, in the median at most `VIDEO_STEP_S` apart by a clock or numbers of known rate."""
    a_second = 1.0 if has_real_stamps(source.frames) else source.numbered_hz
    if len(source.frames) < 2 or not a_second or not any(frame.read_depth for frame in source.frames):
        return False
    return float(np.median(np.diff([frame.stamp_s for frame in source.frames]))) <= VIDEO_STEP_S * a_second


def _is_without_rate(source: Source) -> bool:
    """Whether it has depth images whose stamps are frame numbers of unknown rate."""
    are_numbers = len(source.frames) > 1 and not has_real_stamps(source.frames)
    return are_numbers and not source.numbered_hz and any(frame.read_depth for frame in source.frames)


def followers(source: Source, tracked: Tracked) -> KeyFrames:
    """The `KeyFrames` of a tracked source."""
    return KeyFrames(
        rows=tracked.key_rows,
        first=tracked.world_from_key[tracked.anchors] @ tracked.key_from_frame,
        world_from_key=tracked.world_from_key,
        part=tracked.piece[tracked.anchors],
        times=np.arange(len(source.frames), dtype=float),
        found=tracked.found,
        stamps_s=stamps_of(source),
        sequence=sequence_numbers(source),
        key_of_frame=tracked.anchors,
        apart=tracked.apart,
        readout_s=tracked.readout_s,
    )


def track(source: Source, options: TrackingOptions, *, workers: Workers, step: Step) -> Tracked:
    """Step: the source tracked, block by block, without frames that repeat the one before; a killed run goes on with
    the next block.
    """
    folder, repeats = step.folder, find_repeats(source.frames)
    stamps, sequences = stamps_of(source), [np.setdiff1d(rows, repeats) for rows in sequences_of(source).values()]
    cut = [block for rows in sequences for block in frame_blocks(rows, tuple(source.frames), stamps)]
    blocks = TrackedBlocks(folder / "blocks")
    _track_missing(blocks, cut, options, workers, step.advance)
    parts = [blocks.rows(number) for number in range(len(cut))]
    clouds = blocks.join_clouds(folder / CLOUDS)
    if not clouds.sizes.any():
        reason = next((note for part in parts for note in part.notes), "no frame has depth")
        raise no_clouds(source.frames, reason)
    key_rows = np.concatenate([part.keys for part in parts])
    key_of_row = {int(row): key for key, row in enumerate(key_rows)}
    edges = Edges.joined([part.steps for part in parts])
    edges = replace(edges, pairs=_renumbered(edges.pairs, key_of_row))
    key_sequences = [np.flatnonzero(np.isin(key_rows, rows)) for rows in sequences]
    poses = chained(len(key_rows), key_sequences, edges, REACHES_APART * clouds.reach_m)
    held, poses = bridge(clouds, key_sequences, edges, poses, options.odometry, workers, options.clouds.unit_m)
    sightings = folder / "sightings"
    sightings.mkdir(exist_ok=True)
    blocks.keep_sightings(sightings)
    anchors, key_from_frame, found = _anchored(parts, cut, key_of_row, repeats)
    tracked = Tracked(
        clouds=clouds,
        sightings=sightings,
        key_rows=key_rows,
        anchors=anchors,
        key_from_frame=key_from_frame,
        found=found,
        world_from_key=poses,
        piece=connected_components(held.pairs, len(key_rows)),
        steps=held,
        apart=np.unique(np.concatenate([part.apart for part in parts])),
    )
    tracked = _without_lonely(tracked)
    first = tracked.world_from_key[tracked.anchors] @ tracked.key_from_frame
    twists = velocities(first, stamps, sequence_numbers(source), tracked.found)
    readout_s, camera_notes = _camera_estimates(source, sightings, first, twists, options.clouds.unit_m)
    tracked = replace(tracked, readout_s=readout_s)
    _move_landmarks(source, tracked, twists)
    blocks.remove()
    step.note(*_notes(source, tracked, parts, repeats), *camera_notes)
    return tracked


def _camera_estimates(
    source: Source, sightings: Path, world_from_cam: Floats, twists: Floats, unit_m: float
) -> tuple[float | None, tuple[Note, ...]]:
    """The read-out time in seconds, None without an estimate, and notes on it and on a focal length that does not
    fit.
    """
    notes, readout_s = list[Note](), None
    readout = estimate_readout(views(sightings), source.frames, world_from_cam, twists, unit_m)
    if readout is not None:
        readout_s = readout.best_s
        best, low, high = (f"{1e3 * time_s:.0f}" for time_s in (readout.best_s, readout.low_s, readout.high_s))
        own = {frame.camera.readout_s for frame in source.frames if frame.camera is not None}
        notes.append(other_readout(readout) if any(own) else Note("readout", detail=f"{best} ms ({low} to {high})"))
    focal = estimate_focal(sightings, source.frames, world_from_cam, twists, readout_s, unit_m)
    if focal is not None and focal.is_other:
        detail = f"{focal.best:.0f} pixels ({focal.low:.0f} to {focal.high:.0f}) better than its {focal.own:.0f}"
        notes.append(Note("focal length", detail=detail))
    return readout_s, tuple(notes)


def _track_missing(
    blocks: TrackedBlocks, cut: list[FrameBlock], options: TrackingOptions, workers: Workers, advance: Advance
) -> None:
    """Track the blocks that an earlier, killed run has not left."""
    done = blocks.finished()
    missing = [number for number in range(len(cut)) if number not in done]
    advance(sum(len(cut[number].rows) - cut[number].warm_up for number in done))
    for at, block in workers.map(partial(track_block, options), [cut[number] for number in missing]):
        blocks.write(missing[at], block)
        advance(len(block.rows))


def _renumbered(rows: Ints, key_of_row: dict[int, int]) -> Ints:
    return np.array([key_of_row[row] for row in rows.ravel().tolist()], np.int64).reshape(rows.shape)


def _anchored(
    parts: list[BlockRows], cut: list[FrameBlock], key_of_row: dict[int, int], repeats: Ints
) -> tuple[Ints, Floats, Bools]:
    """`anchors`, `key_from_frame` and `found` of `Tracked`; a row that two blocks share belongs to the earlier one, and
    frames that repeat the images of another, which were not tracked, take its motion.
    """
    fresh = [slice(int(block.warm_up), None) for block in cut]
    rows = np.concatenate([part.rows[keep] for part, keep in zip(parts, fresh, strict=True)])
    anchors = np.concatenate([part.anchors[keep] for part, keep in zip(parts, fresh, strict=True)])
    motions = np.concatenate([part.key_from_row[keep] for part, keep in zip(parts, fresh, strict=True)])
    fitness = np.concatenate([part.fitness[keep] for part, keep in zip(parts, fresh, strict=True)])
    order = np.argsort(rows)
    every = np.arange(len(rows) + len(repeats))
    order = order[np.searchsorted(rows[order], every, side="right") - 1]
    found = np.isfinite(fitness[order]) & ~np.isin(every, repeats)
    return _renumbered(anchors[order], key_of_row), motions[order], np.asarray(found)


def _without_lonely(tracked: Tracked) -> Tracked:
    """Mark a key frame without any odometry edge, and the frames tracked from it, as not found."""
    lonely = np.bincount(tracked.piece)[tracked.piece] == 1
    return tracked if lonely.all() else replace(tracked, found=tracked.found & ~lonely[tracked.anchors])


def _move_landmarks(source: Source, tracked: Tracked, twists: Floats) -> None:
    """Move the landmarks of the key frames, in their file, to where they were at the stamps of their frames."""
    if not len(tracked.clouds.mark_points):
        return
    frames = [source.frames[row] for row in tracked.key_rows]
    points = np.load(tracked.clouds.folder / "mark_points.npy", mmap_mode="r+")
    points[:] = landmarks_at_stamps(frames, tracked.clouds, twists[tracked.key_rows], tracked.readout_s)
    points.flush()


def _puts_in_doubt(doubtful: int, frames: int) -> bool:
    """Whether so many doubtful frames are more than a still scene has."""
    return doubtful > DOUBTED * frames and bool(bdtrc(doubtful - 1, frames, STILL) < BY_CHANCE)


def _notes(source: Source, tracked: Tracked, parts: list[BlockRows], repeats: Ints) -> tuple[Note, ...]:
    ids, sequences = vertex_ids(source), list(sequences_of(source).values())

    def listed(kind: str, rows: Ints) -> list[Note]:
        return [Note(kind, len(rows), in_runs(rows, ids))] if len(rows) else []

    def rows_of(column: str) -> Ints:
        return np.unique(np.concatenate([getattr(part, column) for part in parts]))

    notes = [Note("key frames", len(tracked.key_rows), str(len(tracked.anchors)))]
    own = [np.array([source.frames[row].stamp_s for row in rows]) for rows in sequences]
    back = [row for rows in sequences for row in _where_the_clock_goes_back(source, rows)]
    too_fast = [stamps for stamps in own if faster_than_cameras(stamps)]
    if too_fast:
        usual_s = float(np.median(np.concatenate([abs(np.diff(stamps)) for stamps in too_fast])))
        notes.append(Note("no clock", len(too_fast), f"{1000 * usual_s:.2g}"))
    notes += listed("clock", np.array(back, np.int64))
    notes += told_gaps(sequences, stamps_of(source), ids)
    notes += listed("repeated images", repeats)
    notes += listed("tracking lost", np.setdiff1d(np.flatnonzero(~tracked.found), repeats))
    unread = {int(row): why for part in parts for row, why in zip(part.unread, part.unread_why, strict=True)}
    if unread:
        rows = np.array(sorted(unread))
        first = unread[rows[0]].replace(f"{source.path}/", "")
        notes.append(Note("images unread", len(rows), f"({in_runs(rows, ids)}), such as {first}"))
    notes += listed("blank images", rows_of("blank"))
    notes += listed("moving objects", rows_of("moving"))
    doubtful = rows_of("doubtful")
    if _puts_in_doubt(len(doubtful), len(tracked.anchors)):
        detail = f"{counted(len(tracked.anchors), 'frame')}, {in_runs(doubtful, ids)}"
        notes.append(Note("camera or object", len(doubtful), detail))
    sizes = np.bincount(tracked.piece)
    pieces = int((sizes > 1).sum())
    if pieces > len(sequences):
        notes.append(Note("path broken", pieces - 1, str(pieces)))
    return (*notes, *notes_of("clouds", _few(list(dict.fromkeys(note for part in parts for note in part.notes)))))


def _where_the_clock_goes_back(source: Source, rows: Ints) -> list[int]:
    """The rows of a sequence whose real stamp is no later than the one before."""
    stamps = np.array([source.frames[row].stamp_s for row in rows])
    if not is_clock(stamps) or faster_than_cameras(stamps):
        return []
    return [int(row) for row in rows[1:][np.diff(stamps) <= 0]]


def _few(notes: list[str]) -> list[str]:
    hidden = len(notes) - NOTES_SHOWN
    return notes if hidden <= 1 else [*notes[:NOTES_SHOWN], f"… and {hidden} more frames such as these"]

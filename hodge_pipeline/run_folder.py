"""A run folder as an object: what a run left, read without its source and whatever version made it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline.errors import HodgeError, WorkspaceError
from hodge_pipeline.evaluation.scores import ScoreTable, evaluate
from hodge_pipeline.fusion.fuse import fuse
from hodge_pipeline.recipe.scale import scale_of_scans, scaled_recipe
from hodge_pipeline.recipe.schema import Recipe, recipe_of_run
from hodge_pipeline.refine.given_poses import Refined
from hodge_pipeline.report.contents import Report
from hodge_pipeline.report.notebook import as_html
from hodge_pipeline.rounds.all_frames import pose_frames
from hodge_pipeline.rounds.one_round import solve_edges
from hodge_pipeline.scene import KeyFrames, Round, given_poses, true_poses
from hodge_pipeline.sources.opening import open_with_reader
from hodge_pipeline.stages import FrameReader, Step
from hodge_pipeline.store.store import stored, stored_clouds
from hodge_pipeline.store.workspace import RECIPE_FILE, RUN, is_run_folder
from hodge_pipeline.types import CloudSet, Edges, Floats, Frame, Source
from hodge_pipeline.types.camera import camera_numbers, camera_of
from hodge_pipeline.types.notes import Note


@dataclass(frozen=True)
class FrameTable:
    """The frames of a source in columns: `frame_ids`, `stamps_s`, `sequences (N,)`, `cameras (N, 6)` (width, height,
    fx, fy, cx, cy), poses `world_from_cam (N, 4, 4)` of the source's own and true ones, NaN where it has none.
    """

    name: str
    path: str
    notes: tuple[str, ...]
    frame_ids: np.ndarray
    stamps_s: Floats
    sequences: np.ndarray
    cameras: Floats
    world_from_cam: Floats
    true_world_from_cam: Floats

    @classmethod
    def of(cls, source: Source) -> FrameTable:
        """The table of a source's frames."""
        frames = source.frames
        return cls(
            name=source.name,
            path=str(source.path),
            notes=tuple(source.notes),
            frame_ids=np.array([frame.frame_id for frame in frames]),
            stamps_s=np.array([frame.stamp_s for frame in frames], float),
            sequences=np.array([frame.sequence for frame in frames], np.str_),
            cameras=np.array([camera_numbers(frame.camera) for frame in frames]).reshape(-1, 6),
            world_from_cam=given_poses(source),
            true_world_from_cam=true_poses(source),
        )

    def source(self) -> Source:
        """A source of these frames, without images."""
        rows = zip(
            self.frame_ids.tolist(), self.stamps_s.tolist(), self.sequences.tolist(), self.cameras,
            self.world_from_cam, self.true_world_from_cam, strict=True,
        )  # fmt: skip
        frames = tuple(
            Frame(
                name, stamp, camera_of(camera), world_from_cam=_known(pose), true_world_from_cam=_known(true),
                sequence=sequence,
            )
            for name, stamp, sequence, camera, pose, true in rows
        )  # fmt: skip
        return Source(self.name, Path(self.path), frames, notes=self.notes)


@dataclass(frozen=True)
class Opening:
    """What a run began with: all frames, those that are registered, and the first round."""

    frames: FrameTable
    key_frames: KeyFrames
    first: Round


@dataclass(frozen=True)
class Ending:
    """What a run ended with: poses (N, 4, 4) of all frames, its report, and what became of given poses."""

    world_from_cam: Floats
    report: Report
    refined: Refined | None


@dataclass(frozen=True)
class Run:
    """A run: its folder, what was read, its rounds, and `poses (N, 4, 4)`, world from camera, of all frames.

    `rounds` begins with the first poses; the last one's edges have verdicts. A round knows the key frames alone, which
    `key_frames` spreads over all frames. `ending` is None where the run has not ended.
    """

    folder: Path
    source: Source
    key_frames: KeyFrames
    clouds: CloudSet
    rounds: tuple[Round, ...]
    poses: Floats
    models: Mapping[str, Path]
    scores: ScoreTable | None = None
    ending: Ending | None = None

    @classmethod
    def load(cls, folder: Path | str) -> Run:
        """The run in a folder, as far as it came. Neither its source nor the libraries that made it are needed.

        Raises `WorkspaceError` where the folder is none of a run, or a file in it has changed.
        """
        folder = Path(folder)
        check_layout(folder)
        steps = folder / RUN
        opening = stored(steps, begin)
        clouds = stored_clouds(steps)
        if not opening or not clouds:
            raise WorkspaceError(f"{folder}: the run has not begun to register: run the same command again")
        ended = stored(steps, end)
        rounds = [opening[-1].first, *stored(steps, solve_edges)]
        key_frames = opening[-1].key_frames
        scores, posed = stored(steps, evaluate), stored(steps, pose_frames)
        expanded = posed[-1] if posed else key_frames.expand(rounds[-1].world_from_cam)
        return cls(
            folder=folder,
            source=opening[-1].frames.source(),
            key_frames=key_frames,
            clouds=clouds[-1],
            rounds=tuple(rounds),
            poses=ended[-1].world_from_cam if ended else expanded,
            models={path.stem: path for path in stored(steps, fuse)},
            scores=scores[-1] if scores else None,
            ending=ended[-1] if ended else None,
        )

    @property
    def report(self) -> Report:
        """What the run measured. Raises `WorkspaceError` where it has not ended."""
        if self.ending is None:
            raise WorkspaceError(
                f"{self.folder}: this run is not finished: run the same command again, it goes on where it stopped"
            )
        return self.ending.report

    @property
    def refined(self) -> Refined | None:
        """What became of given poses; None where the run started from none."""
        return None if self.ending is None else self.ending.refined

    @property
    def result(self) -> Round:
        """The last round."""
        return self.rounds[-1]

    @property
    def edges(self) -> Edges:
        """Every pair of the last round, between the key frames."""
        return self.result.edges

    def posed_source(self) -> Source:
        """All frames with their final poses, the key frames with their clouds, the edges between these.

        Frames have their colour images where the source is still what it was; else a note says why not.
        """
        row_of = {int(row): number for number, row in enumerate(self.key_frames.rows)}
        opened, _, complaint = self.reopened()
        own = self.source.frames
        with_images = own if opened is None else opened.frames
        frames = tuple(
            replace(
                frame,
                world_from_cam=_known(pose),
                image=seen.image,
                read_colour=seen.read_colour,
                read_points=partial(self.clouds.__getitem__, row_of[row]) if row in row_of else None,
            )
            for row, (frame, seen, pose) in enumerate(zip(own, with_images, self.poses, strict=True))
        )
        notes = (*self.source.notes, *map(str, complaint))
        return replace(self.source, frames=frames, path=self.folder, graph=self.result.graph, notes=notes)

    @property
    def recipe(self) -> Recipe:
        """The recipe in the folder, without the options of another version (`options_left_out`)."""
        return self._known[0]

    @cached_property
    def _known(self) -> tuple[Recipe, tuple[str, ...]]:
        return recipe_of_run(self.folder / RECIPE_FILE)

    @property
    def scaled_recipe(self) -> Recipe:
        """The recipe with its `scale` on every length, as the run used it; auto: what was measured on its scans."""
        recipe = self.recipe
        scale = (*stored(self.folder / RUN, scale_of_scans), 1.0)[0] if recipe.scale == "auto" else recipe.scale
        return replace(scaled_recipe(recipe, scale), scale=scale)

    @property
    def options_left_out(self) -> tuple[Note, ...]:
        """What is in the folder's recipe and unknown here, a note each: only running it again needs it."""
        return tuple(Note("option unknown", detail=line) for line in self._known[1])

    def key_frames_with_images(self) -> tuple[Sequence[Frame], tuple[Note, ...]]:
        """The key frames as their source has them, none where it has gone or has others by now, and a note why."""
        opened, _, complaint = self.reopened()
        return () if opened is None else tuple(opened.frames[row] for row in self.key_frames.rows), complaint

    def reopened(self) -> tuple[Source | None, FrameReader | None, tuple[Note, ...]]:
        """The source with its images, and its reader; none where it has gone or has other frames by now, and why."""
        path, reader = self.recipe.source.path, self.recipe.source.reader
        if path is None:
            return None, None, ()
        try:
            opened, reader = open_with_reader(path, reader)
        except (HodgeError, OSError) as error:
            return None, None, (Note("without images", detail=str(error)),)
        if [frame.frame_id for frame in opened.frames] != [frame.frame_id for frame in self.source.frames]:
            return None, None, (Note("without images", detail=f"{path}: holds other frames by now"),)
        return opened, reader, ()

    def show(self, width: int = 960, height: int = 540) -> Any:
        """The recording in a Rerun viewer in a notebook's cell, in pixels (extra `notebook`); elsewhere `hodge view`.

        Raises `WorkspaceError` where the run has no recording.
        """
        from hodge_pipeline.recording.notebook import viewer  # Rerun takes half a second

        return viewer(self.folder, width, height)

    def _repr_html_(self) -> str | None:
        """The verdict, a picture and the errors, for a notebook; None of a run that has not ended."""
        return None if self.ending is None else as_html(self.ending.report)

    def __repr__(self) -> str:
        graph = self.result.graph
        state = "" if self.ending is not None else ", unfinished"
        return f"Run({str(self.folder)!r}: {len(self.poses)} frames, {graph.edge_count} edges{state})"


def begin(source: Source, key_frames: KeyFrames, first: Round, *, step: Step) -> Opening:
    """Step: what a run begins with, kept."""
    return Opening(FrameTable.of(source), key_frames, first)


def end(world_from_cam: Floats, report: Report, refined: Refined | None, *, step: Step) -> Ending:
    """Step: what a run ends with, kept."""
    return Ending(world_from_cam, report, refined)


def check_layout(folder: Path) -> None:
    """Raise `WorkspaceError` where a folder is none of a run."""
    if not is_run_folder(folder):
        raise WorkspaceError(f"{folder}: is no run folder: there is no {RECIPE_FILE} with steps in it")


def _known(pose: Floats) -> Floats | None:
    return pose if np.isfinite(pose).all() else None

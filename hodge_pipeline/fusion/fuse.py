"""The fused models of a run, as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hodge_pipeline.scene import KeyFrames, Scene
from hodge_pipeline.stages import Fuser, Step, Steps
from hodge_pipeline.types import Bools, Floats, Source
from hodge_pipeline.types.notes import Note, notes_of
from hodge_pipeline.types.output_files import replacing
from hodge_pipeline.types.ply import model_parts


def fuse_all(
    fusers: Sequence[Fuser], scene: Scene, world_from_cam: Floats, steps: Steps, *, keys_only: bool = False
) -> dict[str, Path]:
    """The PLY file of each model by its name, from the poses (N, 4, 4) of all frames.

    Every frame with a pose of its own is fused, key frame or not; of `keys_only` the key frames alone, which is faster.
    """
    if keys_only and not scene.key_frames.are_all:
        rows = scene.key_frames.rows
        source, poses, placed = scene.source, world_from_cam[rows], scene.clouds.sizes > 0
        steps.note(Note("fused key frames", len(source.frames)))
    else:
        source, poses = scene.whole, world_from_cam
        placed = _placed(scene.key_frames, scene.clouds.sizes > 0)
    poses = np.asarray(np.where(placed[:, None, None], poses, np.nan))
    files = [
        steps.step(fuse, fuser, source, poses, title=f"fusion {row}", total=len(source.frames))
        for row, fuser in enumerate(fusers, start=1)
    ]
    return {file.stem: file for file in files}


def fuse(fuser: Fuser, source: Source, world_from_cam: Floats, *, step: Step) -> Path:
    """Step: the PLY file of the model; frames whose pose is not finite, such as a scan in other units, are left out."""
    model = fuser.fuse(source.frames, world_from_cam, step.advance)
    path = step.folder / f"{model.name}.ply"
    with replacing(path) as file:
        file.writelines(model_parts(model))
    step.note(*notes_of("fuser", model.notes))
    return path


def _placed(key_frames: KeyFrames, has_cloud: Bools) -> Bools:
    """Where (N,) a frame was placed: a key frame by its cloud, where every frame is one; else as the start found it."""
    return has_cloud if key_frames.are_all else key_frames.found

"""The fused models of a run, as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hodge_pipeline.scene import Scene
from hodge_pipeline.stages import Fuser, Step, Steps
from hodge_pipeline.types import Floats, Source
from hodge_pipeline.types.notes import Note, notes_of
from hodge_pipeline.types.output_files import replacing
from hodge_pipeline.types.ply import model_parts


def fuse_all(
    fusers: Sequence[Fuser], scene: Scene, world_from_cam: Floats, steps: Steps, *, keys_only: bool = False
) -> dict[str, Path]:
    """The PLY file of each model by its name, from the poses (N, 4, 4) of all frames.

    Every frame with a pose of its own is fused, key frame or not; of `keys_only` the key frames alone, which is faster.
    """
    keys, has_cloud = scene.key_frames, scene.clouds.sizes > 0
    if keys_only and not keys.are_all:
        source, poses, placed = scene.source, world_from_cam[keys.rows], has_cloud
        steps.note(Note("fused key frames", len(source.frames)))
    else:
        source, poses = scene.whole, world_from_cam
        placed = has_cloud if keys.are_all else keys.found
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

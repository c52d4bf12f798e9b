"""Tracked blocks in memory and on disk, from which a killed run goes on; their clouds are joined file by file."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from hodge_pipeline.registration.tracking.sightings import Sightings
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, PointCloud, Words

STEP, CLOUD, SIGHTING = "step_", "cloud_", "sighting_"


@dataclass(frozen=True)
class BlockRows:
    """How the rows of a block were tracked. Its last row is the first of the next block.

    - `keys`: the key frames, but for a first one that belongs to the block before; `steps`: from each key frame to the
      next, guessed where the fitness is 0.
    - `rows (R,)`, `anchors (R,)`, `key_from_row (R, 4, 4)`, `fitness (R,)`: each row, the row of its key frame, the
      motion, and its fitness, NaN where the motion is guessed.
    - `moving`: rows of frames in which much moves otherwise than the camera; `doubtful`: whose motion may be an
      object's.
    - `blank`: rows of frames with depth and a blank image; `apart`: those of them registered by clouds to a key frame
      that optical flow joins with the next one, so that they do not share the error of that step.
    - `unread`: rows of frames whose images cannot be read; `unread_why`: the errors.
    """

    keys: Ints
    steps: Edges
    rows: Ints
    anchors: Ints
    key_from_row: Floats
    fitness: Floats
    moving: Ints
    doubtful: Ints
    blank: Ints
    apart: Ints
    unread: Ints
    unread_why: Words
    notes: tuple[str, ...]


COLUMNS = tuple(field.name for field in fields(BlockRows) if field.name not in ("steps", "notes"))
"""The arrays of `BlockRows`, each a file's own; steps are stored column by column, notes as words."""


@dataclass(frozen=True)
class TrackedBlock(BlockRows):
    """A block with its key frames' clouds and its sightings."""

    clouds: tuple[PointCloud, ...]
    sightings: Sightings


class TrackedBlocks:
    """The blocks in a folder, by number."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self._folder = folder

    def finished(self) -> set[int]:
        """The numbers of the blocks on disk, without those that an earlier version wrote with fewer columns."""
        return {int(path.stem) for path in self._folder.glob("[0-9]*.npz") if _is_whole(path)}

    def write(self, number: int, block: TrackedBlock) -> None:
        """Keep one block."""
        clouds = CloudSet.from_clouds(block.clouds)
        arrays = {name: getattr(block, name) for name in COLUMNS}
        arrays["notes"] = np.array(block.notes, dtype=np.str_)
        arrays |= {STEP + field.name: getattr(block.steps, field.name) for field in fields(Edges)}
        arrays |= {SIGHTING + field.name: getattr(block.sightings, field.name) for field in fields(Sightings)}
        arrays |= {CLOUD + name: getattr(clouds, name) for name in CloudSet.FILES}
        artifacts.save_arrays(self._path(number), arrays)

    def rows(self, number: int) -> BlockRows:
        """What became of the rows of one block."""
        with np.load(self._path(number)) as stored:
            steps = Edges(*(stored[STEP + field.name] for field in fields(Edges)))
            columns = {name: stored[name] for name in COLUMNS}
            return BlockRows(steps=steps, notes=tuple(stored["notes"].tolist()), **columns)

    def keep_sightings(self, folder: Path) -> None:
        """Write the sightings of all blocks into a folder, a file for each block."""
        for path in sorted(self._folder.glob("[0-9]*.npz")):
            with np.load(path) as stored:
                arrays = {field.name: stored[SIGHTING + field.name] for field in fields(Sightings)}
            artifacts.save_arrays(folder / path.name, arrays)

    def remove(self) -> None:
        """Forget the blocks: what they held is written."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def join_clouds(self, folder: Path) -> CloudSet:
        """The clouds of the key frames of all blocks, written into a folder."""
        return CloudSet.write(folder, map(_clouds, sorted(self._folder.glob("[0-9]*.npz"))))

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:06d}.npz"


def _clouds(path: Path) -> CloudSet:
    with np.load(path) as stored:
        return CloudSet(*(stored[CLOUD + name] for name in CloudSet.FILES))


def _is_whole(path: Path) -> bool:
    with np.load(path) as stored:
        return set(COLUMNS) <= set(stored.files)

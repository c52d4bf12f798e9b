"""Tracked blocks, also on disk: a killed run goes on with the next one; the clouds of all are joined file by file."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from hodge_pipeline.registration.sightings import Sightings
from hodge_pipeline.store import artifacts
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints, PointCloud, Words

STEP, CLOUD, SIGHTING = "step_", "cloud_", "sighting_"
COLUMNS = (
    "keys",
    "rows",
    "anchors",
    "key_from_row",
    "fitness",
    "moving",
    "doubtful",
    "blank",
    "apart",
    "unread",
    "unread_why",
)


@dataclass(frozen=True)
class BlockRows:
    """What became of a block's rows: its key frames but one that the block before has too, the steps from each to the
    next, and for every row the row of the key frame that it was followed from, the motion, and its fitness: NaN where
    the motion is a guess; and the rows `moving` of frames much of which moved otherwise than the camera, `doubtful` of
    those whose motion may be that of an object, `blank` of those that have depth but show nothing, and `apart` of those
    of these whose key frame flow joins with the next one: they do not share the error of that step; and the rows
    `unread` of frames whose images cannot be read, and why.

    A step of fitness 0 is a guess too. The block's last row is the first of the next one.
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


@dataclass(frozen=True)
class TrackedBlock(BlockRows):
    """These, with the key frames' clouds, and what the frames saw of the key frames' corners."""

    clouds: tuple[PointCloud, ...]
    sightings: Sightings


class TrackedBlocks:
    """The blocks in a folder, by number."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self._folder = folder

    def finished(self) -> set[int]:
        """The numbers of the blocks that are there, but for those that an earlier version wrote with fewer columns."""
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
        """Write what the frames of each block saw of their key frames' corners into a folder, a file for each block."""
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

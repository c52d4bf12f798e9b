"""The files of a 7-Scenes folder: sequences, splits, frames by number, and their poses."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np

from hodge_adapters.association import MISSING, unpaired_doubts
from hodge_adapters.text_rows import listed, names_in, read_rows, read_text, to_floats
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bools, Floats
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted

SPLIT_FILES = {"train": "TrainSplit.txt", "test": "TestSplit.txt"}

FRAME_FILE = re.compile(r"frame-(\d{1,18})\.(color|depth|pose)\.(png|jpg|jpeg|txt)$", re.IGNORECASE)
_SEQUENCE = re.compile(r"(?:seq|sequence)-?(\d+)$", re.IGNORECASE)
_PACKED = re.compile(r"(?:seq|sequence)-?(\d+)\.zip$", re.IGNORECASE)


Colours: TypeAlias = dict[tuple[str, int], Path]
"""Colour images by their sequence and number."""


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame: its sequence, its number and rank in it, and the paths that are there."""

    sequence: str
    number: int
    rank: int
    paths: dict[str, Path]


def sequence_folders(path: Path) -> list[tuple[str, Path]]:
    """The folders seq-01, seq-02, … in this one, by number. Raises `SourceError` where it is no folder."""
    try:
        inside = [entry for entry in path.iterdir() if _SEQUENCE.match(entry.name) and entry.is_dir()]
    except OSError as error:
        raise SourceError(
            f"{path}: not a folder that can be read ({error.strerror}): give a 7-Scenes folder"
        ) from error
    return sorted(((entry.name, entry) for entry in inside), key=lambda item: (sequence_number(item[0], ""), item[0]))


def packed_sequences(path: Path) -> dict[int, str]:
    """The archives seq-01.zip, … of a scene, as it is downloaded, by number: those that no folder lies beside."""
    try:
        names = sorted(os.listdir(path))
    except OSError:
        return {}
    folders = {int(match[1]) for name in names if (match := _SEQUENCE.match(name)) and (path / name).is_dir()}
    packed = {int(match[1]): name for name in names if (match := _PACKED.match(name))}
    return {number: name for number, name in packed.items() if number not in folders}


def sequence_number(name: str, where: str) -> int:
    """The number in seq-01 or sequence1; `SourceError` that says where the name was found if there is none."""
    match = _SEQUENCE.match(name)
    if match is None:
        raise SourceError(f"{where}: `{name}` is no sequence: expected a name such as seq-01")
    return int(match[1])


def split_numbers(path: Path, split: str) -> set[int]:
    """The sequence numbers that a split file lists; it writes sequence1 for seq-01."""
    file = path / SPLIT_FILES[split]
    if not file.is_file():
        raise SourceError(f"{file}: not there: set split to all, or name the sequences")
    numbers = {sequence_number(row.fields[0], f"{file}:{row.line}") for row in read_rows(file)}
    if not numbers:
        raise SourceError(f"{file}: lists no sequence: set split to all, or name the sequences")
    return numbers


def with_depth(
    path: Path, chosen: Sequence[tuple[str, Path]], notes: list[str]
) -> tuple[list[FrameFiles], Colours, tuple[Note, ...]]:
    """The frames that have a depth image, ranked within their sequence; the others are noted, and many a doubt. Beside
    them every colour image.
    """
    usable: list[FrameFiles] = []
    colours: Colours = {}
    missing: list[str] = []
    for name, folder in chosen:
        listing = _list_numbers(folder)
        if not listing:
            notes.append(f"{name}: no frames in it")
        complete = [number for number in sorted(listing) if "depth" in listing[number]]
        colours |= {(name, number): files["color"] for number, files in listing.items() if "color" in files}
        missing.extend(f"{name}/{number:06d}" for number in sorted(listing.keys() - complete))
        usable.extend(FrameFiles(name, number, rank, listing[number]) for rank, number in enumerate(complete))
    if not usable and packed_sequences(path):
        packed = list(packed_sequences(path).values())
        raise SourceError(f"{path}: its sequences are packed: unpack {listed(packed)} in it")
    if not usable:
        raise SourceError(
            f"{path}: no frame-000000.depth.png in it: give a sequence folder, or a scene with seq-01 in it"
        )
    if missing:
        notes.append(f"{counted(len(missing), 'frame')} without a depth image left out: {listed(missing)}")
    colourless = [f"{files.sequence}/{files.number:06d}" for files in usable if "color" not in files.paths]
    if colourless:
        notes.append(f"{counted(len(colourless), 'frame has|frames have')} no colour image: {listed(colourless)}")
    total = len(usable) + len(missing)
    lost = (Note("images missing", len(missing), f"{total} depth images"),) * (len(missing) > MISSING * total)
    unpaired = unpaired_doubts(["color" in files.paths for files in usable]) if len(colourless) < len(usable) else ()
    return usable, colours, (*lost, *unpaired)


def colours_of(usable: Sequence[FrameFiles], colours: Colours, late: int) -> list[Path | None]:
    """The colour image of the frame so many frames later than each, by their numbers in its sequence; None without."""
    step = int(np.median(np.diff([files.number for files in usable]))) if late else 0  # 1 of a sequence that is whole
    return [colours.get((files.sequence, files.number + late * step)) for files in usable]


def with_colour_of(usable: Sequence[FrameFiles], colours: Colours, late: int) -> list[FrameFiles]:
    """The frames, each with its colour image of `colours_of`."""
    paired = list[FrameFiles]()
    for files, colour in zip(usable, colours_of(usable, colours, late), strict=True):
        paths = {what: path for what, path in files.paths.items() if what != "color"}
        paired.append(replace(files, paths=paths if colour is None else {**paths, "color": colour}))
    return paired


def _list_numbers(folder: Path) -> dict[int, dict[str, Path]]:
    """The files of each frame number, by what they are; a PNG counts before a JPEG."""
    found: dict[int, dict[str, Path]] = defaultdict(dict)
    for name in names_in(folder):
        match = FRAME_FILE.match(name)
        if match and (match[2].lower() == "pose") == (match[3].lower() == "txt"):
            found[int(match[1])][match[2].lower()] = folder / name
    return found


def read_poses(usable: Sequence[FrameFiles], notes: list[str]) -> Floats:
    """Poses (N, 4, 4) with rotations projected to SO(3), NaN where there is none that can be used."""
    poses = np.array([read_pose(files.paths.get("pose")) for files in usable])
    sequences = np.array([files.sequence for files in usable])
    lost = np.zeros(len(usable), bool)
    for sequence in set(sequences.tolist()):
        lost[sequences == sequence] = placeholders(poses[sequences == sequence])
    poses[lost] = np.nan
    if lost.any():
        rows = np.flatnonzero(lost).tolist()
        notes.append(told_lost([f"{usable[row].sequence}/{usable[row].number:06d}" for row in rows]))
    good = se3.is_motion(poses)
    poses[~good] = np.nan
    poses[good, :3, :3] = se3.project_to_so3(poses[good, :3, :3])
    if not (good | lost).all():
        bad = [f"{usable[row].sequence}/{usable[row].number:06d}" for row in np.flatnonzero(~(good | lost)).tolist()]
        notes.append(
            f"{counted(len(bad), 'frame')} without a usable pose (missing, not finite or not rigid): {listed(bad)}"
        )
    return poses


def placeholders(poses: Floats) -> Bools:
    """The poses (N,) that are the identity to the last digit in a sequence that has it between other poses, or at two
    frames after them: no camera comes back so exactly. At the first frames alone it is where the world begins.
    """
    rows = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    identity = (poses[rows] == np.eye(4)).all(axis=(1, 2))
    others = np.flatnonzero(~identity)
    first, last = (others[0], others[-1]) if len(others) else (len(rows), 0)
    found = np.zeros(len(poses), bool)
    found[rows] = identity & (identity[first:last].any() or identity[first:].sum() > 1)
    return found


def told_lost(frames: Sequence[object]) -> str:
    """A note on the frames that had a placeholder."""
    return (
        f"{counted(len(frames), 'frame')} with the identity amid other poses, which trackers write where they lose "
        f"the camera: taken as no pose: {listed(frames)}"
    )


def read_pose(path: Path | None) -> Floats:
    """The sixteen numbers of a pose file as (4, 4), NaN where they are not."""
    try:
        numbers = to_floats(read_text(path).split()) if path else None
    except SourceError:
        numbers = None
    return np.reshape(numbers if numbers and len(numbers) == 16 else [np.nan] * 16, (4, 4)).astype(np.float64)

"""The paper's sequences on this machine, and another system's poses for them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.paper.tables import SEQUENCES
from hodge_pipeline import registry, se3
from hodge_pipeline.errors import HodgeError, SourceError
from hodge_pipeline.evaluation.trajectory import associate
from hodge_pipeline.types import Floats, Frame

SCENES = ("chess", "fire", "redkitchen", "stairs")
COLLECTIONS = ("", "seven_scenes", "7scenes", "7-scenes", "icl_nuim", "icl-nuim")
POSE_FILE = re.compile(r"frame-(\d+)\.pose\.txt")
MAX_STAMP_DIFFERENCE_S = 0.02
RECIPES = Path(__file__).parent / "recipes"


def recipe_file(kind: str) -> str:
    """The recipe of the paper's method on a kind of graph."""
    return str(RECIPES / f"paper_{kind}.yaml")


@dataclass(frozen=True)
class Found:
    """One of the paper's sequences: its name, its folder, and the reader that takes every n-th frame of it."""

    name: str
    folder: Path
    reader: str
    every: int


def find_sequences(data: Path, most_frames: int) -> tuple[list[Found], dict[str, str]]:
    """The sequences below a folder, thinned to at most so many frames, and why each of the others is missing."""
    if not data.is_dir():
        raise SourceError(f"{data}: no such folder: name the one that holds seven_scenes/ or the sequences (--data)")
    found, missing = [], {}
    for name in SEQUENCES:
        folder = _folder_of(name, data)
        if folder is None:
            missing[name] = "not present"
            continue
        reader = "seven_scenes" if name in SCENES else "icl_nuim"
        try:
            count = len(registry.load("readers", reader)().open(folder).frames)
        except HodgeError as error:
            missing[name] = f"cannot be read: {error}"
            continue
        found.append(Found(name, folder, reader, max(1, math.ceil(count / most_frames))))
    return found, missing


def _folder_of(name: str, data: Path) -> Path | None:
    """A scene's first sequence, or the folder itself where it holds the frames."""
    for collection in COLLECTIONS:
        for alias in _aliases(name):
            folder = data / collection / alias
            if folder.is_dir():
                first = folder / "seq-01"
                return first if first.is_dir() else folder
    return None


def _aliases(name: str) -> list[str]:
    """The folder names that the benchmarks' own archives unpack to."""
    number = name[-1]
    if name.startswith("living"):
        return [name, f"living_room_traj{number}_frei_png", f"living_room_traj{number}n_frei_png", f"lr_kt{number}"]
    if name.startswith("office"):
        return [name, f"traj{number}_frei_png", f"traj{number}n_frei_png", f"office_room_traj{number}_frei_png"]
    return [name]


def peer_poses(folder: Path, name: str, frames: Sequence[Frame]) -> tuple[Floats, str]:
    """Another system's poses (N, 4, 4) of these frames, NaN where it has none, and where they were found.

    They are looked for in `folder/<sequence>`, then in the folder itself: one file a frame, `frame-000000.pose.txt`
    with 4x4 numbers (BundleFusion's own; −inf where it lost track), or a TUM file `<sequence>.txt`, `poses.tum`, ….
    Raises `SourceError` where there is neither, or where not one pose belongs to a frame.
    """
    for place in (folder / name, folder):
        files = {int(match[1]): path for path in _files(place) if (match := POSE_FILE.fullmatch(path.name))}
        if files:
            return _from_files(files, frames, place)
        for path in (place / f"{name}.tum", place / f"{name}.txt", place / "poses.tum", place / "trajectory.txt"):
            if path.is_file():
                return _from_tum(path, frames)
    raise SourceError(f"{folder}: no poses of {name}: expected frame-000000.pose.txt files or a TUM file {name}.txt")


def _files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _from_files(files: dict[int, Path], frames: Sequence[Frame], place: Path) -> tuple[Floats, str]:
    poses = np.full((len(frames), 4, 4), np.nan)
    for row, frame in enumerate(frames):
        path = files.get(round(frame.stamp_s))
        if path is not None:
            poses[row] = _read_pose(path)
    return _checked(poses, place)


def _read_pose(path: Path) -> Floats:
    try:
        numbers = [float(word) for word in path.read_text("utf-8").split()]
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read as 16 numbers: {error}") from error
    if len(numbers) != 16:
        raise SourceError(f"{path}: has {len(numbers)} numbers, a pose has 16 (4x4, row by row)")
    pose = np.array(numbers).reshape(4, 4)
    return pose if bool(se3.is_motion(pose)) else np.full((4, 4), np.nan)


def _from_tum(path: Path, frames: Sequence[Frame]) -> tuple[Floats, str]:
    stamps_s, world_from_cam = _read_tum(path)
    poses = np.full((len(frames), 4, 4), np.nan)
    ours, theirs = associate(np.array([frame.stamp_s for frame in frames]), stamps_s, MAX_STAMP_DIFFERENCE_S)
    poses[ours] = world_from_cam[theirs]
    return _checked(poses, path)


def _read_tum(path: Path) -> tuple[Floats, Floats]:
    """Stamps (M,), ascending, and poses (M, 4, 4)."""
    try:
        table = np.loadtxt(path, comments="#", ndmin=2)
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read as lines of stamp tx ty tz qx qy qz qw: {error}") from error
    if table.shape[1:] != (8,) or not len(table):
        raise SourceError(f"{path}: has rows of {table.shape[-1]} numbers, expected stamp tx ty tz qx qy qz qw")
    table = table[np.isfinite(table).all(axis=1) & (np.abs(table[:, 4:]).max(axis=1) > 0)]
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table[:, 0], se3.from_quat_xyzw(table[:, 1:4], table[:, 4:])


def _checked(poses: Floats, place: Path) -> tuple[Floats, str]:
    known = int(np.isfinite(poses).all(axis=(1, 2)).sum())
    if not known:
        raise SourceError(f"{place}: no pose in it belongs to a frame of the sequence: check frame numbers and stamps")
    return poses, f"peer: {known} of {len(poses)} poses"

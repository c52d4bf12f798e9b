"""Refined poses written back into the form of the file they came from: only the poses change, all else stays."""

from __future__ import annotations

import dataclasses
import re
import shutil
from codecs import BOM_UTF8
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from hodge_adapters.json_files import read_json, write_json
from hodge_adapters.nerfstudio import opengl_matrix, transforms_file
from hodge_adapters.open3d_json import Open3dReader, Open3dTrajectoryWriter
from hodge_adapters.seven_scenes.files import FRAME_FILE, sequence_folders
from hodge_adapters.text_rows import reading, separator_of, to_floats, write_bytes_atomically, write_text_atomically
from hodge_adapters.trajectories.euroc import NANO
from hodge_adapters.trajectories.euroc import file_of as euroc_file
from hodge_adapters.trajectories.text import COLUMNS, has_w_first, tum_stamps, unit_of
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Floats, Trajectory
from hodge_pipeline.types.input_files import read_input

NO_OPTIONS = ConfigDict(extra="forbid")


@dataclasses.dataclass(frozen=True)
class _Poses:
    """The refined poses by their exact stamps."""

    trajectory: Trajectory

    def at(self, stamp_s: float) -> Floats | None:
        row = int(np.searchsorted(self.trajectory.stamps_s, stamp_s))
        found = row < len(self.trajectory) and self.trajectory.stamps_s[row] == stamp_s
        return self.trajectory.world_from_cam[row] if found else None


class _OneFile:
    """A format of one file, which EuRoC has in folders of its own."""

    def copy(self, folder: Path, original: Path) -> Path:
        """See `PoseRewriter`."""
        original = euroc_file(original)
        out = folder / f"refined{original.suffix}"
        shutil.copyfile(original, out)
        return out


@dataclass(frozen=True, config=NO_OPTIONS)
class TumRewriter(_OneFile):
    """Lines of `stamp tx ty tz qx qy qz qw`."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """See `PoseRewriter`; lines that hold no pose stay as they are."""
        poses, per_second = _Poses(trajectory), unit_of(tum_stamps(original))[1]
        shift = int(has_w_first(original))

        def numbers(fields: list[str]) -> list[float] | None:
            values = to_floats(fields)
            pose = poses.at(values[0] / per_second) if values and len(values) in COLUMNS else None
            return None if pose is None else [*pose[:3, 3], *np.roll(se3.to_quat_xyzw(pose), shift)]

        return _rewritten(folder, original, numbers, first=1)


@dataclass(frozen=True, config=NO_OPTIONS)
class KittiRewriter(_OneFile):
    """Lines of twelve numbers, which are the poses in their order."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """See `PoseRewriter`."""
        rows = iter(trajectory.world_from_cam)

        def numbers(fields: list[str]) -> list[float] | None:
            return next(rows)[:3].ravel().tolist() if len(fields) == 12 else None

        return _rewritten(folder, original, numbers, first=0)


@dataclass(frozen=True, config=NO_OPTIONS)
class EurocRewriter(_OneFile):
    """Lines of `nanoseconds,x,y,z,qw,qx,qy,qz,…`: further columns (velocities, biases) stay as they are."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """See `PoseRewriter`; the nanoseconds are not touched."""
        poses = _Poses(trajectory)

        def numbers(fields: list[str]) -> list[float] | None:
            whole = fields[0].isascii() and fields[0].isdecimal()
            pose = poses.at(float(np.float64(int(fields[0])) / NANO)) if whole and len(fields) >= 8 else None
            return None if pose is None else [*pose[:3, 3], *np.roll(se3.to_quat_xyzw(pose), 1)]

        return _rewritten(folder, euroc_file(original), numbers, first=1)


@dataclass(frozen=True, config=NO_OPTIONS)
class LogRewriter(_OneFile):
    """Blocks of `i j n` and four rows of a matrix."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """See `PoseRewriter`; blocks of pairs stay as they are."""
        poses = _Poses(trajectory)
        pending: list[list[float]] = []

        def numbers(fields: list[str]) -> list[float] | None:
            if pending:
                return pending.pop(0) or None
            values = to_floats(fields)
            pose = poses.at(values[0]) if values and len(values) > 1 and values[0] == values[1] else None
            pending.extend([[], [], [], []] if pose is None else pose.tolist())
            return None

        return _rewritten(folder, original, numbers, first=0)


@dataclass(frozen=True, config=NO_OPTIONS)
class SevenScenesRewriter:
    """A folder of `frame-000000.pose.txt`: a folder `refined` with the same files."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """See `PoseRewriter`."""
        poses, out = _Poses(trajectory), _emptied(folder / "refined")
        for file in _pose_files(original):
            match = FRAME_FILE.match(file.name)
            pose = poses.at(float(match[1])) if match else None
            if pose is None:
                shutil.copyfile(file, _beside(out, original, file))
            else:
                rows = ("\t".join(f"{value:.17g}" for value in row) for row in pose)
                write_text_atomically(_beside(out, original, file), "".join(f"{row}\n" for row in rows))
        return out

    def copy(self, folder: Path, original: Path) -> Path:
        """See `PoseRewriter`."""
        return self.rewrite(folder, original, Trajectory(np.zeros(0), np.zeros((0, 4, 4))))


@dataclass(frozen=True, config=NO_OPTIONS)
class Open3dRewriter(_OneFile):
    """Open3D's camera trajectory in JSON, with its cameras."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """See `PoseRewriter`."""
        source, poses = Open3dReader().open(original), _Poses(trajectory)
        frames = tuple(dataclasses.replace(frame, world_from_cam=poses.at(frame.stamp_s)) for frame in source.frames)
        if not frames:
            raise SourceError(f"{original}: a pose graph holds no trajectory of frames: give it to hodge solve")
        out = folder / f"refined{original.suffix}"
        Open3dTrajectoryWriter().write(out, dataclasses.replace(source, frames=frames, trajectory=trajectory))
        return out


@dataclass(frozen=True, config=NO_OPTIONS)
class NerfstudioRewriter:
    """nerfstudio's `transforms.json`: the poses of its frames; cameras, paths and all else stay."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """See `PoseRewriter`."""
        content, poses, out = read_json(transforms_file(original)), _Poses(trajectory), folder / "refined.json"
        for row, entry in enumerate(content["frames"]):
            pose = poses.at(float(row))
            if pose is not None:
                entry["transform_matrix"] = opengl_matrix(pose)
        write_json(out, content)
        return out

    def copy(self, folder: Path, original: Path) -> Path:
        """See `PoseRewriter`."""
        return Path(shutil.copyfile(transforms_file(original), folder / "refined.json"))


def _rewritten(folder: Path, original: Path, numbers: Callable[[list[str]], list[float] | None], *, first: int) -> Path:
    """The file with the fields of each line from `first` on replaced by what `numbers` gives for the line, if any;
    every other byte stays, whatever the text is encoded in and its lines end in.
    """
    with reading(original):
        contents = read_input(original)
    mark = BOM_UTF8 if contents.startswith(BOM_UTF8) else b""
    lines = []
    for line in contents[len(mark) :].decode("utf-8", "surrogateescape").splitlines(keepends=True):
        content = line.split("#", 1)[0]
        spans = [match.span() for match in re.finditer(rf"[^\s{separator_of(content)}]+", content)]
        new = numbers([content[slice(*span)] for span in spans]) if spans else None
        if new is not None:
            for (begin, end), value in reversed(list(zip(spans[first:], new, strict=False))):
                line = f"{line[:begin]}{float(value) + 0.0!r}{line[end:]}"
        lines.append(line)
    out = folder / f"refined{original.suffix}"
    write_bytes_atomically(out, mark + "".join(lines).encode("utf-8", "surrogateescape"))
    return out


def _pose_files(original: Path) -> list[Path]:
    """The pose files in the folder, or in its sequences' folders where it is a scene."""
    folders = [original, *(folder for _, folder in sequence_folders(original))]
    files = (path for folder in folders for path in sorted(folder.iterdir()))
    named = ((path, FRAME_FILE.match(path.name)) for path in files)
    return [path for path, match in named if match and match[2].lower() == "pose"]


def _beside(out: Path, original: Path, file: Path) -> Path:
    """Where the file lies in `out` as it does in the original folder; its folder is made."""
    path = out / file.relative_to(original)
    path.parent.mkdir(exist_ok=True)
    return path


def _emptied(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder

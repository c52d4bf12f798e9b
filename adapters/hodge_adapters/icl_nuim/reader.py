"""ICL-NUIM in its three layouts: TUM-like PNG folders, POV-Ray files, and Redwood's re-renderings of its rooms.

The first two have y pointing up, so fy = −480; the world is the files' own.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.association import unpaired_doubts
from hodge_adapters.icl_nuim.pov import list_pov, pov_frames
from hodge_adapters.images.camera_files import Intrinsics, checked, find_camera_file, read_intrinsics
from hodge_adapters.images.fitted_camera import UNSTAMPED_STEP_S, assumed_camera_doubts
from hodge_adapters.posed import posed_frames
from hodge_adapters.seven_scenes.files import FrameFiles, read_poses
from hodge_adapters.text_rows import first_text, listed, names_in
from hodge_adapters.trajectories.log import read_log_file
from hodge_adapters.trajectories.text import parse_tum
from hodge_adapters.tum.image_lists import (
    StampedImages,
    find_association_file,
    find_colour_folder,
    read_pairs,
    stamped_images,
)
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Frame, Source
from hodge_pipeline.types.text import counted

ICL = Intrinsics(481.2, -480.0, 319.5, 239.5, (640, 480))
REDWOOD = Intrinsics(525.0, 525.0, 319.5, 239.5, (640, 480))
ICL_UNITS_PER_METRE, REDWOOD_UNITS_PER_METRE = 5000.0, 1000.0
LAYOUT = "put depth (PNG of 16 bits) in depth/ and colour in color/, both named by one number, 00000.png, …"
TRUTH_PATTERN = "*.gt.freiburg*"
MAX_GAP_FRAMES = 1.0
VIDEO_HZ = 30.0
"""Frames are rendered at this rate along a walked path."""
SNIFFED_BYTES = 1 << 16
LOG_FILES = ("trajectory.log", "scene/trajectory.log", "test_scene/trajectory.log")
TUM_FILES = ("depth.txt", "rgb.txt", "groundtruth.txt")
_NUMBER = re.compile(r"(?<!\d)\d{1,18}(?!\d)")
_IMAGES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class IclNuimReader:
    """Reads a folder of any of the three layouts, or a `.gt.freiburg` file alone."""

    camera: tuple[float, float, float, float] | None = Field(
        None,
        description="fx fy cx cy in pixels; none: 481.2 -480 319.5 239.5; for Redwood's layout those of "
        "a camera file in the folder, else 525 525 319.5 239.5",
    )
    depth_scale: float | None = Field(
        None,
        gt=0,
        description="stored units per metre; none: 5000 (TUM-like), 1 (POV-Ray, positions too), 1000 (Redwood)",
    )
    every: int = Field(1, ge=1, description="take every n-th frame")

    def sniff(self, path: Path) -> Sniff:
        """Sure of POV-Ray files and of a `.gt.freiburg` beside image lists, less sure of Redwood's folders and of
        lists that number their images.
        """
        path = Path(path)
        try:
            if path.is_file():
                truth_alone = ".gt.freiburg" in path.name
                return Sniff(0.9, "a .gt.freiburg file") if truth_alone else Sniff(0.0, "not a folder")
            if _find_truth(path) and (find_association_file(path) or (path / "depth.txt").is_file()):
                return Sniff(0.95, "a .gt.freiburg file beside image lists")
            if _find_truth(path) and is_redwood(path):
                return Sniff(0.9, "a .gt.freiburg file beside depth/ and rgb/")
            if list_pov(path):
                return Sniff(0.95, "scene_00_0000.depth files")
            if is_redwood(path):
                return Sniff(0.7, "depth/ and image/ or color/ without lists of stamps")
            association = find_association_file(path)
            if association and _is_numbered(association):
                return Sniff(0.5, f"{association.name} with frame numbers for stamps")
        except (OSError, SourceError):
            return Sniff(0.0, "not a folder that can be read")
        return Sniff(0.0, "no .gt.freiburg, no scene_00_0000.depth, no depth/ beside image/ or color/")

    def open(self, path: Path) -> Source:
        """Frames with the number in the file name (or the list's stamp) as id and stamp, and the truth as trajectory.

        Redwood's `trajectory.log` is an estimate: its poses are given to the frames with a note that says so, and
        there is no reference trajectory.
        """
        path = Path(path)
        if path.is_file():
            parsed = parse_tum(path)
            return Source(path.name, path, trajectory=parsed.trajectory, notes=parsed.notes, files=(path,))
        if not path.is_dir():
            raise SourceError(f"{path}: not there: give a folder of ICL-NUIM, or a .gt.freiburg file")
        pov = list_pov(path)
        if pov:
            return self._open_pov(path, pov)
        if find_association_file(path) or (path / "depth.txt").is_file():
            return self._open_lists(path)
        if is_redwood(path):
            return self._open_unlisted(path) if _find_truth(path) else self._open_redwood(path)
        raise SourceError(
            f"{path}: no associations.txt, no scene_00_0000.depth, no depth/ beside image/ or color/ in it: {LAYOUT}"
        )

    def _camera(self, default: Intrinsics) -> Intrinsics:
        return checked(Intrinsics(*self.camera), "option camera") if self.camera else default

    def _open_lists(self, path: Path) -> Source:
        notes: list[str] = []
        return self._numbered(path, read_pairs(path, 0.0, notes), notes)

    def _open_unlisted(self, path: Path) -> Source:
        """The TUM-like layout without its list: images are paired by the numbers in their names."""
        notes = ["no associations.txt: images are paired by the numbers in their names"]
        return self._numbered(path, list_images(path, notes), notes)

    def _numbered(self, path: Path, listing: StampedImages, notes: list[str]) -> Source:
        truth = _find_truth(path)
        trajectory, poses = None, np.full((len(listing.depth), 4, 4), np.nan)
        if truth:
            parsed = parse_tum(truth)
            trajectory = parsed.trajectory
            notes.extend(parsed.notes)
            poses = se3.poses_at(trajectory, listing.stamps_s, MAX_GAP_FRAMES)
        without = int(np.isnan(poses[:, 0, 0]).sum())
        if without:
            notes.append(f"{without} of {len(poses)} frames have no truth")
        frames = self._frames(listing, ICL, poses, ICL_UNITS_PER_METRE, notes, is_true=True)
        files = (*listing.files, *filter(None, [truth]), *listing.depth, *filter(None, listing.colour))
        return Source(
            path.resolve().name,
            path,
            frames,
            trajectory,
            notes=tuple(notes),
            files=files,
            doubts=listing.doubts,
            numbered_hz=VIDEO_HZ,
        )

    def _frames(
        self,
        listing: StampedImages,
        default: Intrinsics,
        poses: Floats,
        units_per_metre: float,
        notes: list[str],
        *,
        is_true: bool,
    ) -> tuple[Frame, ...]:
        camera = self._camera(default).camera_of(listing.depth, notes)
        scale = self.depth_scale or default.units_per_metre or units_per_metre
        return listing.frames(camera, poses, self.every, notes, units_per_metre=scale, is_true=is_true)

    def _open_pov(self, path: Path, pov: dict[int, Path]) -> Source:
        notes: list[str] = []
        colours = [file for file in (depth.with_suffix(".png") for depth in pov.values()) if file.is_file()]
        own = self._camera(ICL)
        camera = own.camera_of(colours, notes) if colours else own.camera((640, 480))
        frames, files = pov_frames(pov, camera, self.depth_scale or 1.0, notes)
        every = tuple(frames[:: self.every])
        return Source(
            path.resolve().name,
            path,
            every,
            posed_frames(frames),
            notes=tuple(notes),
            files=files,
            numbered_hz=VIDEO_HZ,
        )

    def _open_redwood(self, path: Path) -> Source:
        notes: list[str] = []
        listing = list_images(path, notes)
        poses, log = _estimated(path, listing.ids, notes)
        own = None if self.camera else find_camera_file(path)
        if own:
            notes.append(f"intrinsics from {own.relative_to(path)}")
        doubts = listing.doubts
        if own is None and not self.camera:
            stamps_s, scale = UNSTAMPED_STEP_S * listing.stamps_s, self.depth_scale or REDWOOD_UNITS_PER_METRE
            doubts += assumed_camera_doubts(REDWOOD, listing.depth, listing.colour, stamps_s, scale)
            notes.append(
                "Redwood's intrinsics taken (525 525 319.5 239.5), since there is no camera file in the folder"
            )
        default = read_intrinsics(own) if own else REDWOOD
        frames = self._frames(listing, default, poses, REDWOOD_UNITS_PER_METRE, notes, is_true=False)
        files = (*filter(None, [log, own]), *listing.depth, *filter(None, listing.colour))
        return Source(
            path.resolve().name, path, frames, notes=tuple(notes), files=files, doubts=doubts, numbered_hz=VIDEO_HZ
        )


def _estimated(path: Path, numbers: list[int], notes: list[str]) -> tuple[Floats, Path | None]:
    """Poses (N, 4, 4) of these frames by `trajectory.log`, or by ScanNet's `pose/0.txt`, …, NaN where there is
    none; and the path of the log, if there is one.
    """
    log, folder = find_log(path), path / "pose"
    if log is None and not folder.is_dir():
        return np.full((len(numbers), 4, 4), np.nan), None
    notes.append(f"poses from {(log or folder).relative_to(path)}: an estimate of another program, not the truth")
    if log is None:
        files = [FrameFiles(folder.name, number, 0, {"pose": folder / f"{number}.txt"}) for number in numbers]
        return read_poses(files, notes), None
    estimates = read_log_file(log).poses
    poses = np.array([estimates.get(number, np.full((4, 4), np.nan)) for number in numbers])
    without = int(np.isnan(poses[:, 0, 0]).sum())
    if without:
        notes.append(f"{without} of {len(poses)} frames have no pose in it")
    return poses, log


def _find_truth(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob(TRUTH_PATTERN))), None)


def _is_numbered(association: Path) -> bool:
    """Whether the first row of an association file has a frame number where TUM has a time."""
    lines = first_text(association, SNIFFED_BYTES).splitlines()
    row = next((line.split() for line in lines if line.strip() and not line.startswith("#")), [""])
    return row[0].isdigit()


def is_redwood(folder: Path) -> bool:
    """Whether the folder has a depth and a colour folder, and no list or truth of a TUM sequence."""
    if any((folder / name).is_file() for name in TUM_FILES):
        return False
    return find_colour_folder(folder) is not None and (folder / "depth").is_dir()


def list_images(folder: Path, notes: list[str]) -> StampedImages:
    """The images of a folder by the number in their names, their stamp; depth without colour is noted."""
    if stamped_images(folder / "depth"):
        raise SourceError(
            f"{folder / 'depth'}: its images are named by their stamps: read them with the reader tum (hodge run tum), "
            "and set source.reader.depth_scale=1000 if depth is in millimetres"
        )
    depth = _by_number(folder / "depth", notes)
    if not depth:
        raise SourceError(f"{folder / 'depth'}: no PNG in it: {LAYOUT}")
    colour_folder = find_colour_folder(folder)
    colour = _by_number(colour_folder, notes) if colour_folder else {}
    numbers = sorted(depth)
    alone = [number for number in numbers if number not in colour]
    if alone:
        notes.append(f"{counted(len(alone), 'frame has|frames have')} no colour image: {listed(alone)}")
    doubts = unpaired_doubts([number in colour for number in numbers]) if colour else ()
    none_s, one_run = np.zeros(len(numbers)), np.zeros(len(numbers), np.int64)
    stamps_s = np.array(numbers, float)
    images = [depth[number] for number in numbers], [colour.get(number) for number in numbers]
    return StampedImages(stamps_s, *images, none_s, (), one_run, doubts)


def find_log(folder: Path) -> Path | None:
    """The trajectory of a folder, by its usual places."""
    return next((folder / name for name in LOG_FILES if (folder / name).is_file()), None)


def _by_number(folder: Path, notes: list[str]) -> dict[int, Path]:
    """The images of a folder by the first of the numbers in their names that tells most of them apart, so that
    `d435_0001.png` is 1. Raises `SourceError` where most have none of their own.
    """
    names = [name for name in names_in(folder) if name.lower().endswith(_IMAGES)]
    numbers = [[int(digits) for digits in _NUMBER.findall(Path(name).stem)] for name in names]
    places = range(max(map(len, numbers), default=0))
    place = max(places, key=lambda place: len({each[place] for each in numbers if place < len(each)}), default=0)
    found: dict[int, Path] = {}
    skipped: list[str] = []
    for name, each in zip(names, numbers, strict=True):
        if place >= len(each) or each[place] in found:
            skipped.append(name)
        else:
            found[each[place]] = folder / name
    if len(skipped) > len(found):
        raise SourceError(
            f"{folder}: {len(skipped)} of {len(names)} images have no number of their own ({listed(skipped)}), by "
            f"which depth and colour are paired: {LAYOUT}"
        )
    if skipped:
        left_out = counted(len(skipped), "image")
        notes.append(f"{folder.name}: {left_out} without an own number left out: {listed(skipped)}")
    return found

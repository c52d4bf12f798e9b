"""ICL-NUIM in its three layouts: TUM-like PNG folders, POV-Ray files, and Redwood's re-renderings of its rooms, whose
layout Replica, ScanNet and Stray Scanner nearly have.

The first two have y pointing up, so fy = −480; the world is the files' own.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.icl_nuim.numbered import (
    LAYOUT,
    REPLICA_IMAGES,
    estimated_poses,
    find_images,
    list_images,
    phone_advice,
    true_poses,
)
from hodge_adapters.icl_nuim.pov import list_pov, pov_frames
from hodge_adapters.images import pixels
from hodge_adapters.images.camera_files import Intrinsics, checked, find_camera_file, read_intrinsics
from hodge_adapters.images.fitted_camera import UNSTAMPED_STEP_S, assumed_camera_doubts
from hodge_adapters.seven_scenes.files import placeholders, told_lost
from hodge_adapters.text_rows import first_text
from hodge_adapters.trajectories.text import parse_tum
from hodge_adapters.tum.image_lists import (
    StampedImages,
    find_association_file,
    read_pairs,
)
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Frame, Source, Trajectory

ICL = Intrinsics(481.2, -480.0, 319.5, 239.5, (640, 480))
REDWOOD = Intrinsics(525.0, 525.0, 319.5, 239.5, (640, 480))
REPLICA = Intrinsics(600.0, 600.0, 599.5, 339.5, (1200, 680), 6553.5)
"""As NICE-SLAM's `cam_params.json` has it."""
ICL_UNITS_PER_METRE, REDWOOD_UNITS_PER_METRE = 5000.0, 1000.0
TRUTH_PATTERN = "*.gt.freiburg*"
MAX_GAP_FRAMES = 1.0
"""The truth has a pose for every frame."""
VIDEO_HZ = 30.0
"""Frames are rendered at this rate along a walked path."""
SNIFFED_BYTES = 1 << 16
"""Of a list: some hundred lines tell what it lists."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class IclNuimReader:
    """Reads a folder of any of the three layouts, or a `.gt.freiburg` file alone."""

    camera: tuple[float, float, float, float] | None = Field(
        None,
        description="fx fy cx cy in pixels; none: those of a camera file in the folder, else 481.2 -480 319.5 239.5, "
        "for Redwood's layout 525 525 319.5 239.5",
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
                alone = Sniff(0.9, "a .gt.freiburg file")
                return alone if truth_alone else Sniff(0.0, "not a folder", phone_advice(path))
            if _find_truth(path) and (find_association_file(path) or (path / "depth.txt").is_file()):
                return Sniff(0.95, "a .gt.freiburg file beside image lists")
            if _find_truth(path) and find_images(path):
                return Sniff(0.9, "a .gt.freiburg file beside depth/ and rgb/")
            if list_pov(path):
                return Sniff(0.95, "scene_00_0000.depth files")
            if images := find_images(path):
                apart = images[0] != images[1]
                told = (
                    "depth/ and image/ or color/ without lists of stamps" if apart else "depth and colour in one folder"
                )
                return Sniff(0.7 if apart else 0.6, told)
            association = find_association_file(path)
            if association and _is_numbered(association):
                return Sniff(0.5, f"{association.name} with frame numbers for stamps")
        except (OSError, SourceError):
            return Sniff(0.0, "not a folder that can be read")
        why = "no .gt.freiburg, no scene_00_0000.depth, no depth/ beside image/ or color/"
        return Sniff(0.0, why, phone_advice(path))

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
        if find_images(path):
            return self._open_unlisted(path) if _find_truth(path) else self._open_redwood(path)
        raise SourceError(
            f"{path}: no associations.txt, no scene_00_0000.depth, no depth/ beside image/ or color/ in it: {LAYOUT}"
        )

    def _camera(self, default: Intrinsics) -> Intrinsics:
        return checked(Intrinsics(*self.camera), "option camera") if self.camera else default

    def _icl_camera(self, path: Path, notes: list[str]) -> tuple[Intrinsics, tuple[Path, ...]]:
        """That of a camera file in the folder, and the file; else ICL-NUIM's. One that states ICL-NUIM's own with y
        down is taken with y up, as all its images and poses are.
        """
        file = None if self.camera else find_camera_file(path)
        if file is None:
            return ICL, ()
        found = read_intrinsics(file)
        if np.allclose((found.fx, found.fy), (ICL.fx, -ICL.fy), rtol=1e-3):
            notes.append(
                f"{file.name} states ICL-NUIM's camera with y down: fy = {ICL.fy:g} taken, since its y points up"
            )
            return replace(found, fy=-found.fy), (file,)
        notes.append(f"intrinsics from {file.name}")
        return found, (file,)

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
            trajectory = _without_placeholders(parsed.trajectory, notes)
            notes.extend(parsed.notes)
            poses = se3.poses_at(trajectory, listing.stamps_s, MAX_GAP_FRAMES)
        without = int(np.isnan(poses[:, 0, 0]).sum())
        if without:
            notes.append(f"{without} of {len(poses)} frames have no truth")
        camera, camera_files = self._icl_camera(path, notes)
        frames = self._frames(listing, camera, poses, ICL_UNITS_PER_METRE, notes, is_true=True)
        files = (
            *listing.files, *camera_files, *filter(None, [truth]), *listing.depth, *filter(None, listing.colour)
        )  # fmt: skip
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
        found = self._camera(default)
        if found.size is None:
            found = _sized(found, listing)
        camera = found.camera_of(listing.depth, notes)
        scale = self.depth_scale or default.units_per_metre or units_per_metre
        return listing.frames(camera, poses, self.every, notes, units_per_metre=scale, is_true=is_true)

    def _open_pov(self, path: Path, pov: dict[int, Path]) -> Source:
        notes: list[str] = []
        colours = [file for file in (depth.with_suffix(".png") for depth in pov.values()) if file.is_file()]
        default, camera_files = self._icl_camera(path, notes)
        own = self._camera(default)
        camera = own.camera_of(colours, notes) if colours else own.camera((640, 480))
        frames, files = pov_frames(pov, camera, self.depth_scale or 1.0, notes)
        every = tuple(frames[:: self.every])
        return Source(
            path.resolve().name,
            path,
            every,
            Trajectory.of_frames(frames),
            notes=tuple(notes),
            files=(*camera_files, *files),
            numbered_hz=VIDEO_HZ,
        )

    def _open_redwood(self, path: Path) -> Source:
        notes: list[str] = []
        listing = list_images(path, notes)
        true = true_poses(path, listing.ids, notes)
        poses, file = true or estimated_poses(path, listing.ids, notes)
        known, name = (REPLICA, "Replica") if (path / REPLICA_IMAGES).is_dir() else (REDWOOD, "Redwood")
        own = None if self.camera else self._camera_file(path)
        if own:
            notes.append(f"intrinsics from {own.name if own.parent != path else own.relative_to(path)}")
        doubts = listing.doubts
        units_per_metre = known.units_per_metre or REDWOOD_UNITS_PER_METRE
        if own is None and not self.camera:
            stamps_s, scale = UNSTAMPED_STEP_S * listing.stamps_s, self.depth_scale or units_per_metre
            doubts += assumed_camera_doubts(known, listing.depth, listing.colour, stamps_s, scale)
            pinhole = f"{known.fx:g} {known.fy:g} {known.cx:g} {known.cy:g}"
            notes.append(f"{name}'s intrinsics taken ({pinhole}), since there is no camera file in the folder")
        default = read_intrinsics(own) if own else known
        frames = self._frames(listing, default, poses, units_per_metre, notes, is_true=true is not None)
        files = (*filter(None, [file, own]), *listing.depth, *filter(None, listing.colour))
        return Source(
            path.resolve().name,
            path,
            frames,
            Trajectory.of_frames(frames) if true else None,
            notes=tuple(notes),
            files=files,
            doubts=doubts,
            numbered_hz=VIDEO_HZ,
        )

    @staticmethod
    def _camera_file(path: Path) -> Path | None:
        """That of the folder; Replica has one for all its rooms."""
        above = path.resolve().parent if (path / REPLICA_IMAGES).is_dir() else path
        return find_camera_file(path) or find_camera_file(above)


def _sized(found: Intrinsics, listing: StampedImages) -> Intrinsics:
    """The intrinsics with the size of depth or of colour: that whose middle lies nearer to the principal point, since
    phones state those of colour, seven times as large as depth.
    """
    colour = [path for path in listing.colour if path]
    sizes = [pixels.common_size(images) for images in (listing.depth, colour) if images]
    return replace(found, size=min(sizes, key=lambda size: abs(np.log(2 * found.cx / size[0])) if found.cx > 0 else 0))


def _without_placeholders(truth: Trajectory, notes: list[str]) -> Trajectory:
    lost = placeholders(truth.world_from_cam)
    notes.extend([told_lost([f"{stamp:g}" for stamp in truth.stamps_s[lost]])] if lost.any() else [])
    return Trajectory(truth.stamps_s[~lost], truth.world_from_cam[~lost])


def _find_truth(folder: Path) -> Path | None:
    return next(iter(sorted(folder.glob(TRUTH_PATTERN))), None)


def _is_numbered(association: Path) -> bool:
    """Whether the first row of an association file has a frame number where TUM has a time."""
    lines = first_text(association, SNIFFED_BYTES).splitlines()
    row = next((line.split() for line in lines if line.strip() and not line.startswith("#")), [""])
    return row[0].isdigit()

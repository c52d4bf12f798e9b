"""TUM RGB-D: `depth.txt` and `rgb.txt` (or an association file), images, `groundtruth.txt`; depth at 5000 a metre.

Poses are camera to world, of the camera whose images these are: depth is registered to colour in this data set.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.images import pixels
from hodge_adapters.images.camera_files import Intrinsics, checked, find_camera_file, read_intrinsics
from hodge_adapters.images.fitted_camera import CameraFit, assumed_camera_doubts, fitting, untold_camera_doubts
from hodge_adapters.images.frames import Lens
from hodge_adapters.trajectories.text import parse_tum
from hodge_adapters.tum.image_lists import StampedImages, find_association_file, read_pairs, stamped_images
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Source, Trajectory
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted

UNITS_PER_METRE = 5000.0
READOUT_S = 0.0225
"""Of the first Kinect's rolling shutter: where landmarks of fr1/xyz and fr1/rpy fit best, 22.2 and 23.1 ms."""
CAMERAS = {
    "fr1": Intrinsics(
        517.3,
        516.5,
        318.6,
        255.3,
        (640, 480),
        distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
        readout_s=READOUT_S,
    ),  # fmt: skip
    "fr2": Intrinsics(520.9, 521.0, 325.1, 249.7, (640, 480), distortion=(0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "fr3": Intrinsics(535.4, 539.2, 320.1, 247.6, (640, 480)),
    "default": Intrinsics(525.0, 525.0, 319.5, 239.5, (640, 480)),
}
RECORDED_ON = {"fr1": {"2011-05-10"}, "fr2": {"2011-07-28"}, "fr3": {"2012-07-08", "2012-07-09"}}
"""The days, UTC, of the benchmark's sequences: images hardly tell fr1 from fr2, whose lenses bend them nearly alike."""
TRUTH_FILE = "groundtruth.txt"

_FREIBURG = re.compile(r"(?:freiburg|fr)([123])(?![0-9a-z])|freiburg([123])", re.IGNORECASE)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class TumReader:
    """Reads a folder in the layout of the TUM RGB-D benchmark."""

    camera: str | tuple[float, float, float, float] = Field(
        "auto",
        description="fr1, fr2, fr3, default (525 525 319.5 239.5), a file in the folder, or fx fy cx cy in pixels; "
        "auto: intrinsics.txt or another camera file in the folder, else the folder's name (freiburg1), else the day "
        "of its stamps, else that of fr1, fr2 and fr3 under which frames agree better than under default, else default",
    )
    depth_scale: float | None = Field(
        None, gt=0, description="stored units per metre; none: DepthMapFactor of the camera file, else TUM's 5000"
    )
    no_depth: tuple[int, ...] = Field((0, 65535), description="stored values that mean no depth; 65535 is the largest")
    max_difference_s: float = Field(
        0.02,
        ge=0,
        description="seconds between a depth image and its colour image, or its true pose where `max_gap_s` has none; "
        "TUM's own tools take 0.02",
    )
    truth: str = Field(TRUTH_FILE, description="file of the ground truth in the folder, TUM text; empty: none")
    truth_match: Literal["stamp", "row"] = Field(
        "stamp", description="row: the n-th pose belongs to the n-th frame listed, for lists that hold frame numbers"
    )
    max_gap_s: float = Field(
        0.1, ge=0, description="seconds to the truth's neighbours of a frame; a hand-held camera moves 5 cm in 0.1 s"
    )
    undistort: bool = Field(
        True,
        description="undistort the images where the lens is known: of fr1 and fr2, as the benchmark publishes it, or "
        "by k1 k2 p1 p2 k3 of a camera file. Distortion reaches 8 pixels in the corners; about 4 ms an image",
    )
    every: int = Field(1, ge=1, description="take every n-th frame")

    def sniff(self, path: Path) -> Sniff:
        """Sure where `depth.txt` lies beside `rgb.txt`, less sure of an association file, or of parts of a sequence."""
        path = Path(path)
        try:
            if (path / "depth.txt").is_file():
                return Sniff(0.9, "depth.txt and rgb.txt") if (path / "rgb.txt").is_file() else Sniff(0.6, "depth.txt")
            association = find_association_file(path)
            halves = [name for name in ("rgb.txt", TRUTH_FILE) if (path / name).is_file()]
            if not association and stamped_images(path / "depth"):
                return Sniff(0.8, "depth images named by their stamps, but no depth.txt")
            if not association and halves:
                return Sniff(0.5, f"{halves[0]}, but no depth.txt")
        except OSError:
            return Sniff(0.0, "not a folder that can be read")
        return Sniff(0.6, association.name) if association else Sniff(0.0, "no depth.txt and no associations.txt")

    def open(self, path: Path) -> Source:
        """Frames in order of their depth stamps, and the whole truth as the trajectory.

        `frame_id` is the stamp where the lists hold frame numbers, else the row among the frames. A frame's pose is
        the truth interpolated at its stamp, None where the truth has a gap.
        """
        path = Path(path)
        if not path.is_dir():
            raise SourceError(f"{path}: not a folder: give the folder that holds depth.txt and rgb.txt")
        notes: list[str] = []
        listing = read_pairs(path, self.max_difference_s, notes)
        doubts = list(listing.doubts)
        found, camera_file = self._intrinsics(path, listing, notes, doubts)
        scale = self.depth_scale or found.units_per_metre or UNITS_PER_METRE
        doubts += self._doubts(found, listing, scale)
        camera = found.camera_of(listing.depth, notes)
        lens = Lens(camera, found.distortion) if found.distortion and self.undistort else None
        if found.distortion:
            notes.append(
                f"lens distortion is {'removed from the images' if lens else 'left in the images: undistort is off'}"
            )
        trajectory, truth_file = self._truth(path, listing.stamps_s, notes)
        poses = self._poses(trajectory, listing, notes)
        options = {"units_per_metre": scale, "no_depth": self.no_depth, "is_true": True, "lens": lens}
        return Source(
            name=path.resolve().name,
            path=path,
            frames=listing.frames(camera, poses, self.every, notes, **options),
            trajectory=trajectory,
            notes=tuple(notes),
            doubts=tuple(doubts),
            files=(*listing.files, *camera_file, *truth_file, *listing.depth, *filter(None, listing.colour)),
        )

    def _intrinsics(
        self, path: Path, listing: StampedImages, notes: list[str], doubts: list[Note]
    ) -> tuple[Intrinsics, tuple[Path, ...]]:
        if not isinstance(self.camera, str):
            return checked(Intrinsics(*self.camera), "option camera"), ()
        if self.camera in CAMERAS:
            return CAMERAS[self.camera], ()
        file = find_camera_file(path) if self.camera == "auto" else path / self.camera
        if file:
            return self._from_file(file, notes)
        days = {str(day) for day in np.asarray(listing.stamps_s, "datetime64[s]").astype("datetime64[D]")}
        dated = next((name for name, recorded in RECORDED_ON.items() if recorded & days), None)
        match = _FREIBURG.search(path.resolve().name)
        if match:
            name = f"fr{match[1] or match[2]}"
            notes.append(f"intrinsics of {name} taken: by the folder's name")
            if dated and dated != name:
                told = (
                    f"the folder's name says {name}, but the day of the stamps, {', '.join(sorted(days))}, is {dated}'s"
                )
                doubts.append(Note("reader's doubt", detail=f"{told}: set source.reader.camera={dated} if it was"))
            return CAMERAS[name], ()
        if dated:
            notes.append(f"intrinsics of {dated} taken: by the day of the stamps, {', '.join(sorted(days))}")
            return CAMERAS[dated], ()
        tried = self._tried(listing)
        own = "give those of your camera with camera=[fx,fy,cx,cy]"
        if tried:
            name = next(iter(tried))
            gains = ", ".join(f"{each} by {100 * fit.gain:.0f} %" for each, fit in tried.items())
            notes.append(
                f"intrinsics of {name} taken, tried on the images: errors are smaller than with 525 525 319.5 239.5 "
                f"({gains}): {own}"
            )
            doubts += untold_camera_doubts(tried)
            return CAMERAS[name], ()
        notes.append(
            "default intrinsics taken (525 525 319.5 239.5), since there is no camera file, and no freiburg1, 2 or 3 "
            f"in the folder's name, whose cameras fit no better: {own}"
        )
        return CAMERAS["default"], ()

    def _tried(self, listing: StampedImages) -> dict[str, CameraFit]:
        """The known cameras that surely fit the images better than the default one, the best first."""
        if pixels.common_size(listing.depth) != CAMERAS["default"].size:
            return {}
        scale = self.depth_scale or UNITS_PER_METRE
        return fitting(CAMERAS, "default", listing.depth, listing.colour, listing.stamps_s, scale)

    def _doubts(self, taken: Intrinsics, listing: StampedImages, scale: float) -> tuple[Note, ...]:
        if taken is not CAMERAS["default"] or self.camera == "default":
            return ()
        return assumed_camera_doubts(taken, listing.depth, listing.colour, listing.stamps_s, scale)

    def _from_file(self, file: Path, notes: list[str]) -> tuple[Intrinsics, tuple[Path, ...]]:
        found = read_intrinsics(file)
        notes.append(f"intrinsics from {file.name}")
        if found.distorted and not found.distortion:
            notes.append(f"{file.name} has lens distortion, which is not corrected: images are taken as undistorted")
        if self.depth_scale and found.units_per_metre and self.depth_scale != found.units_per_metre:
            notes.append(f"depth_scale {self.depth_scale:g} taken, {file.name} says {found.units_per_metre:g}")
        return found, (file,)

    def _truth(self, path: Path, stamps_s: Floats, notes: list[str]) -> tuple[Trajectory | None, tuple[Path, ...]]:
        file = path / self.truth
        if not self.truth or (self.truth == TRUTH_FILE and not file.is_file()):
            notes.append("no ground truth")
            return None, ()
        parsed = parse_tum(file)
        notes.extend(parsed.notes)
        if self.truth_match == "stamp":
            return parsed.trajectory, (file,)
        if len(parsed.trajectory) != len(stamps_s):
            counts = f"{counted(len(parsed.trajectory), 'pose')} for {counted(len(stamps_s), 'frame')}"
            raise SourceError(f"{file}: {counts}: truth_match row needs one pose for each frame")
        return Trajectory(stamps_s, parsed.trajectory.world_from_cam), (file,)

    def _poses(self, trajectory: Trajectory | None, listing: StampedImages, notes: list[str]) -> Floats:
        """Poses (N, 4, 4) at the frames' stamps, NaN where the truth has none."""
        stamps_s = listing.stamps_s
        if trajectory is None:
            return np.full((len(stamps_s), 4, 4), np.nan)
        poses = se3.poses_at(trajectory, stamps_s, self.max_gap_s, self.max_difference_s)
        if listing.runs.any() and self.truth_match == "stamp":
            poses[listing.runs > 0] = np.nan
            notes.append("the truth is taken for the frames before the clock jumps back alone")
        without = int(np.isnan(poses[:, 0, 0]).sum())
        if without:
            hint = ": are its stamps of another clock? see truth_match" if without == len(stamps_s) else ""
            notes.append(f"{without} of {len(stamps_s)} frames have no truth within {self.max_gap_s:g} s{hint}")
        return poses

"""7-Scenes, and 3DMatch's copies of it: `seq-01/frame-000000.{color,depth,pose}.*`, poses camera to world.

Depth is uint16 millimetres, where both 0 and 65535 mean no depth. Depth and colour are, as the data set's authors say,
not registered to each other: colour is reprojected onto the depth's pixels as a Kinect is built, unless edges show that
it is registered, as in re-exports.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.images import pixels
from hodge_adapters.images.camera_files import Intrinsics, checked, find_camera_file, read_intrinsics
from hodge_adapters.images.frames import as_jpeg, image_frame
from hodge_adapters.seven_scenes.colour import (
    DepthFile,
    frames_late,
    is_unregistered,
    read_depth,
    read_registered_colour,
)
from hodge_adapters.seven_scenes.files import (
    FRAME_FILE,
    Colours,
    FrameFiles,
    colours_of,
    packed_sequences,
    read_poses,
    sequence_folders,
    sequence_number,
    split_numbers,
    with_colour_of,
    with_depth,
)
from hodge_adapters.text_rows import listed
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Camera, Floats, Frame, Source, Trajectory
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.text import counted

VIDEO_HZ = 30.0
"""A Kinect's frames a second, which the files' numbers count."""
KINECT = Intrinsics(585.0, 585.0, 320.0, 240.0, (640, 480))


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class SevenScenesReader:
    """Reads a sequence folder (its frames inside) or a scene folder (sequences inside)."""

    split: Literal["all", "train", "test"] = Field(
        "all", description="which sequences of a scene: all, or those that TrainSplit.txt or TestSplit.txt lists"
    )
    sequences: tuple[str, ...] = Field((), description="names such as seq-01; empty: every sequence of the split")
    every: int = Field(1, ge=1, description="take every n-th frame of each sequence")
    camera: tuple[float, float, float, float] | None = Field(
        None,
        description="fx fy cx cy in pixels; none: camera-intrinsics.txt or another camera file in the folder "
        "or the one above it, else 585 585 320 240, which the authors give for the depth camera",
    )
    depth_scale: float = Field(1000.0, gt=0, description="stored units per metre; 7-Scenes and BundleFusion: mm")
    no_depth: tuple[int, ...] = Field(
        (0, 65535), description="stored values that mean no depth; 7-Scenes has 65535, its re-exports have 0 as well"
    )
    colour_camera: Literal["auto", "same", "kinect"] = Field(
        "auto",
        description="the camera of the colour images: same as depth, as registered images have it; kinect: 525 pixels, "
        "2.5 cm beside, as the sensor is built; auto: kinect where colour then changes more at depth edges, by a "
        "few images (red kitchen: 2.6 to 3.5 times as much as elsewhere, in place of 1.3)",
    )

    def sniff(self, path: Path) -> Sniff:
        """Certain where a file named `frame-000000.depth.png` lies in the folder or in a sequence below it."""
        try:
            for folder in (path, *(folder for _, folder in sequence_folders(path))):
                with os.scandir(folder) as entries:
                    for entry in entries:
                        match = FRAME_FILE.match(entry.name)
                        if match and match[2].lower() == "depth":
                            return Sniff(0.95, f"frame-*.depth.png in {folder.name}")
        except (OSError, SourceError):
            return Sniff(0.0, "not a folder that can be read")
        packed = list(packed_sequences(path).values())
        advice = f"its sequences are packed: unpack {listed(packed)} in it" if packed else ""
        return Sniff(0.0, "no frame-000000.depth.png in it or in a folder seq-01", advice)

    def open(self, path: Path) -> Source:
        """The frames of all chosen sequences, in order; `frame_id` and `stamp_s` are the number in the file name.

        With several sequences the id is `seq-01/000004`, and there is no trajectory, since stamps start again in each.
        Frames without depth are left out, poses that are not finite or singular become None; `notes` count both.
        """
        path = Path(path)
        notes: list[str] = []
        usable, every_colour, doubts = with_depth(path, self._chosen(path, notes), notes)
        camera, camera_files = self._camera(path, usable, notes)
        colours = [files.paths.get("color") for files in usable]
        colour_size = pixels.colour_size(colours, (camera.width, camera.height), notes)
        images = {file for files in usable for file in files.paths.values()}
        usable, late = self._paired(usable, every_colour, camera)
        images |= {file for files in usable for file in files.paths.values()}
        is_unregistered = self._is_unregistered(usable, camera, notes)
        poses = read_poses(usable, notes)
        several = len({files.sequence for files in usable}) > 1
        taken = [row for row, files in enumerate(usable) if files.rank % self.every == 0]
        return Source(
            name=path.resolve().name,
            path=path,
            frames=tuple(
                self._frame(usable[row], camera, poses[row], several, colour_size, is_unregistered) for row in taken
            ),
            trajectory=None if several else _trajectory(usable, poses),
            notes=tuple(notes),
            doubts=(*doubts, *late),
            numbered_hz=VIDEO_HZ,
            files=(*camera_files, *sorted(images)),
        )

    def _chosen(self, path: Path, notes: list[str]) -> list[tuple[str, Path]]:
        """Names and folders of the sequences to read; a folder without sequences is one itself."""
        folders = sequence_folders(path)
        if not folders:
            if self.split != "all" or self.sequences:
                raise SourceError(f"{path}: no sequences to choose from: give the scene's folder, with seq-01 in it")
            return [(path.resolve().name, path)]
        numbers = {name: sequence_number(name, str(path)) for name, _ in folders}
        packed = packed_sequences(path)
        by_name = {sequence_number(name, "the option sequences") for name in self.sequences}
        by_split = split_numbers(path, self.split) if self.split != "all" else set()
        absent = sorted((by_name | by_split) - set(numbers.values()) - set(packed))
        if absent:
            notes.append(f"sequences asked for but not there: {listed([f'seq-{number:02d}' for number in absent])}")
        left = [name for number, name in packed.items() if number in (by_name or by_split or packed)]
        if left:
            notes.append(f"sequences that are still packed left out: {listed(left)}")
        for wanted in filter(None, (by_name, by_split)):
            folders = [(name, folder) for name, folder in folders if numbers[name] in wanted]
        if not folders:
            raise SourceError(
                f"{path}: none of the sequences asked for is there: change the options split and sequences"
            )
        return folders

    def _camera(self, path: Path, usable: Sequence[FrameFiles], notes: list[str]) -> tuple[Camera, tuple[Path, ...]]:
        beside = [file for folder in (path, path.resolve().parent) if (file := find_camera_file(folder))]
        if self.camera:
            beside, found = [], checked(Intrinsics(*self.camera), "option camera")
        elif beside:
            found = read_intrinsics(beside[0])
        else:
            found = KINECT
            notes.append("no camera-intrinsics.txt: the depth camera's published 585 585 320 240 is used")
        depth = [files.paths["depth"] for files in usable]
        camera = found.camera_of(depth, notes)
        return camera, tuple(beside[:1])

    def _paired(
        self, usable: list[FrameFiles], colours: Colours, camera: Camera
    ) -> tuple[list[FrameFiles], tuple[Note, ...]]:
        """The frames, each with the colour of its moment, and a note where the files have that of another.

        Colour of a camera beside the depth camera alone: registered colour is tried by who runs the sequence.
        """
        if self.colour_camera == "same":
            return usable, ()
        depth = [self._depth(files, camera) for files in usable]
        late = frames_late(partial(colours_of, usable, colours), depth)
        if not late:
            return usable, ()
        told = f"{counted(abs(late), 'frame')} {'later' if late > 0 else 'earlier'}"
        return with_colour_of(usable, colours, late), (Note("colour paired anew", late, told),)

    def _is_unregistered(self, usable: Sequence[FrameFiles], camera: Camera, notes: list[str]) -> bool:
        """Whether colour is unregistered, of a Kinect's colour camera beside the depth camera."""
        if self.colour_camera != "auto":
            return self.colour_camera == "kinect"
        both = [files for files in usable if "color" in files.paths]
        depth = [self._depth(files, camera) for files in both]
        found = is_unregistered([files.paths["color"] for files in both], depth)
        if found:
            notes.append(
                "colour is not registered to depth, as edges in both show: it is reprojected from a Kinect's colour "
                "camera, 2.5 cm beside the depth camera (colour_camera=same takes it as registered)"
            )
        return found

    def _frame(
        self,
        files: FrameFiles,
        camera: Camera,
        pose: Floats,
        several: bool,
        colour_size: tuple[int, int],
        is_unregistered: bool,
    ) -> Frame:
        frame = image_frame(
            f"{files.sequence}/{files.number:06d}" if several else files.number,
            files.number,
            camera,
            files.paths["depth"],
            files.paths.get("color"),
            units_per_metre=self.depth_scale,
            no_depth=self.no_depth,
            world_from_cam=pose,
            is_true=True,
            sequence=files.sequence,
            colour_size=colour_size,
        )
        if not is_unregistered or "color" not in files.paths:
            return frame
        depth = self._depth(files, camera)
        colour = partial(read_registered_colour, files.paths["color"], depth)
        return replace(
            frame,
            read_depth=partial(read_depth, depth),
            read_colour=colour,
            encoded_colour=partial(as_jpeg, colour),
            image=None,
        )

    def _depth(self, files: FrameFiles, camera: Camera) -> DepthFile:
        return DepthFile(files.paths["depth"], camera, self.depth_scale, self.no_depth)


def _trajectory(usable: Sequence[FrameFiles], poses: Floats) -> Trajectory | None:
    good = se3.has_pose(poses)
    stamps = np.array([files.number for files in usable], np.float64)
    return Trajectory(stamps[good], poses[good]) if good.any() else None

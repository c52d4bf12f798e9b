"""The demo's sequences: a room or building seen along a path, written in the TUM RGB-D layout, and their cache."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar, Protocol

import cv2
import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.demo.noise import measured_depth, photographed
from hodge_pipeline.demo.path import HandHeldLoop, Walk
from hodge_pipeline.demo.render import Renderer
from hodge_pipeline.demo.room import Room, build_building, build_room
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Advance, no_progress
from hodge_pipeline.types import Bytes, Camera, Floats
from hodge_pipeline.types.input_files import read_input_text

VERSION = 3
"""Raised whenever the same options give other files, so that nobody goes on with old ones."""
STAMP_FILE = "demo.json"
"""The file that says by which options a folder was made."""
FIRST_STAMP_S = 1_400_000_000.0
"""Unix time, as TUM's stamps are."""
CAMERA_HZ, TRUTH_HZ = 30.0, 100.0
UNITS_PER_METRE = 5000
"""Of depth images, as TUM's."""
FOCAL_SHARE_OF_WIDTH = 525 / 640
"""Focal length of the first Kinect."""
JPEG_QUALITY = 92
FULL_LOOP, STEP_DEG = 1.12, 3.4
"""Rounds of a path that closes its loop, and the turn between neighbours for which frames must suffice."""
CACHED_SEQUENCES, ABANDONED_S = 4, 86_400.0
"""Sequences that the cache keeps, and the age of a draft whose process was killed."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DemoOptions:
    """What is rendered."""

    frames: int = Field(
        default=120, ge=2, description="images; neighbours are 3 degrees and 6 cm apart unless turns says other"
    )
    width: int = Field(
        default=320, ge=16, description="pixels; 320 keeps the complete demo below a minute on two cores"
    )
    height: int = Field(default=240, ge=16, description="pixels")
    seed: int = Field(default=0, ge=0, description="of textures, books, tremor and noise")
    noise: float = Field(default=1.0, ge=0, description="scale of every error of the camera; 0 gives exact images")
    turns: float | None = Field(
        default=None,
        gt=0,
        description="rounds of the room; above 1 the last images overlap the first, below 1 the camera goes there and "
        "back; none: 1.12, or, with too few frames for that, as far as neighbours stay 3 degrees apart",
    )
    stride: int = Field(default=5, ge=1, description="of a 30 Hz camera's images every stride-th is kept")
    readout_s: float = Field(
        default=0.0, ge=0, description="how much later the last row is read than the first one: a rolling shutter"
    )
    exposure_s: float = Field(default=0.0, ge=0, description="of the colour image, which blurs it")

    @classmethod
    def video(cls, **changed: Any) -> DemoOptions:
        """Every image of a camera like the first Kinect, in poor light: ten seconds, of which these are `changed`."""
        of_kinect = {"width": 640, "height": 480, "stride": 1, "readout_s": 0.0225, "exposure_s": 0.015}
        return cls(**({"frames": 300, "turns": 0.4} | of_kinect | changed))

    @property
    def camera(self) -> Camera:
        """The camera, 63 degrees wide."""
        focal, centre = FOCAL_SHARE_OF_WIDTH * self.width, ((self.width - 1) / 2, (self.height - 1) / 2)
        return Camera(self.width, self.height, focal, focal, *centre, self.readout_s)

    @property
    def rounds(self) -> float:
        """`turns`, or the default that suits the number of frames."""
        if self.turns is not None:
            return self.turns
        reach = self.frames * STEP_DEG / 360
        return FULL_LOOP if reach >= FULL_LOOP else min(reach, 1.0) / 2

    @property
    def path(self) -> HandHeldLoop:
        """The camera's path."""
        return HandHeldLoop(self.seed, self.frames * self.stride / CAMERA_HZ, self.rounds)

    def build(self) -> Room:
        """What it sees."""
        return build_room(self.seed)

    def write(self, draft: Path, advance: Advance) -> None:
        """The sequence in the TUM layout: `rgb/*.jpg`, `depth/*.png` (16 bit, 5000 a metre), `rgb.txt`, `depth.txt`,
        `groundtruth.txt` (poses at 100 Hz) and `intrinsics.txt` (`fx fy cx cy width height`; of a rolling shutter as
        `fx: …` lines, with `readout_s`).
        """
        _write(draft, self, advance)


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class BuildingOptions:
    """What is rendered of a walk through many rooms and back, every image of a 30 Hz camera: about 450 a room."""

    rooms: int = Field(default=4, ge=2, description="of the building, one behind the other")
    width: int = Field(default=160, ge=16, description="pixels; 20,000 frames of 160 are rendered in minutes")
    height: int = Field(default=120, ge=16, description="pixels")
    seed: int = Field(default=0, ge=0, description="of textures, paint, pictures, books, tremor and noise")
    noise: float = Field(default=1.0, ge=0, description="scale of every error of the camera; 0 gives exact images")
    stride: int = Field(default=1, ge=1, description="of a 30 Hz camera's images every stride-th is kept")
    exposure_s: ClassVar[float] = 0.0

    @property
    def camera(self) -> Camera:
        """The camera of the room."""
        return DemoOptions(width=self.width, height=self.height).camera

    @property
    def frames(self) -> int:
        """As many images as the walk takes."""
        return int(self.path.duration_s * CAMERA_HZ / self.stride)

    @property
    def path(self) -> Walk:
        """The camera's path."""
        return Walk(self.seed, self.rooms)

    def build(self) -> Room:
        """What it sees."""
        return build_building(self.rooms, self.seed)

    def write(self, draft: Path, advance: Advance) -> None:
        """As `DemoOptions` writes the room."""
        _write(draft, self, advance)


class World(Protocol):
    """Options of a modelled world that writes itself as a sequence."""

    @property
    def frames(self) -> int:
        """How many frames the sequence has."""

    def write(self, draft: Path, advance: Advance) -> None:
        """Write the sequence into an empty folder; calls `advance(1)` after each frame."""


def make_sequence(folder: Path | str, options: World | None, advance: Advance = no_progress) -> Path:
    """The folder with the sequence of these options, written unless it is there already.

    It is written beside the folder and renamed when complete, so that a killed process leaves no half of it.
    `advance(1)` is called after each frame. Raises `SourceError` where the folder holds anything else.
    """
    folder, options = Path(folder), options or DemoOptions()
    if _is_made(folder, options):
        advance(options.frames)
        return folder
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SourceError(
            f"{folder}: exists and is not the demo sequence of these options; name another folder, or remove it"
        )
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", suffix=".partial", dir=folder.parent))
        try:
            options.write(draft, advance)
            (draft / STAMP_FILE).write_text(_stamp(options))
            _publish(draft, folder, options)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    except OSError as error:
        raise SourceError(
            f"{folder}: cannot write the demo sequence ({error}); free the disk or name another folder"
        ) from error
    return folder


def demo_source(options: World, advance: Advance = no_progress) -> Path:
    """The folder of the sequence in the user's cache, written at the first call.

    The cache, `$XDG_CACHE_HOME/hodge-pipeline` or `~/.cache/hodge-pipeline`, keeps the sequences used last.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "hodge-pipeline"
    key = hashlib.sha256(_stamp(options).encode()).hexdigest()[:12]
    folder = make_sequence(cache / f"demo-{key}", options, advance)
    os.utime(folder)
    _forget_oldest(cache, folder)
    return folder


def _forget_oldest(cache: Path, keep: Path) -> None:
    """Remove all but the sequences used last, and drafts of killed processes; nothing else in the cache."""
    for draft in cache.glob(".demo-*.partial"):
        if time.time() - draft.stat().st_mtime > ABANDONED_S:
            shutil.rmtree(draft, ignore_errors=True)
    others = [p.parent for p in cache.glob(f"demo-*/{STAMP_FILE}") if p.parent != keep]
    others.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    for old in others[CACHED_SEQUENCES - 1 :]:
        shutil.rmtree(old, ignore_errors=True)


def _stamp(options: World) -> str:
    """What identifies the sequence of these options."""
    told = {"version": VERSION, "world": type(options).__name__, "options": asdict(options)}  # type: ignore[call-overload]
    return json.dumps(told, indent=1, sort_keys=True) + "\n"


def _is_made(folder: Path, options: World) -> bool:
    stamp = folder / STAMP_FILE
    return stamp.is_file() and read_input_text(stamp, errors="replace") == _stamp(options)


def _publish(draft: Path, folder: Path, options: World) -> None:
    """Rename the draft; where another process was first, its equal sequence stays."""
    draft.chmod(0o755)
    try:
        draft.rename(folder)
    except OSError:
        if not _is_made(folder, options):
            raise


def _write(draft: Path, options: DemoOptions | BuildingOptions, advance: Advance) -> None:
    """Write the complete sequence; two threads render, since no frame depends on another."""
    rng = np.random.default_rng([options.seed, 2])
    colour_s = np.arange(options.frames) * options.stride / CAMERA_HZ + rng.uniform(0, 0.002, options.frames) + 0.05
    depth_s = colour_s + rng.uniform(-0.006, 0.006, options.frames)
    path = options.path
    recorder = _Recorder(draft, options, path)
    (draft / "rgb").mkdir()
    (draft / "depth").mkdir()
    with ThreadPoolExecutor(2) as pool:
        names = []
        for pair in pool.map(recorder.record, range(options.frames), colour_s, depth_s):
            names.append(pair)
            advance(1)
    _write_list(draft / "rgb.txt", "colour images", [colour for colour, _ in names])
    _write_list(draft / "depth.txt", "depth images", [depth for _, depth in names])
    _write_truth(draft / "groundtruth.txt", path)
    _write_intrinsics(draft / "intrinsics.txt", options.camera)


class _Recorder:
    """Renders and writes one frame at a time; colour and depth each at the pose of their own time."""

    def __init__(self, folder: Path, options: DemoOptions | BuildingOptions, path: HandHeldLoop | Walk) -> None:
        self.folder, self.options, self.path = folder, options, path
        self.renderer = Renderer(options.build(), options.camera)

    def record(self, number: int, colour_s: float, depth_s: float) -> tuple[str, str]:
        """Write a frame; the paths of its colour and depth image in the sequence's folder."""
        rng = np.random.default_rng([self.options.seed, 3, number])
        image = photographed(
            self.renderer.colour(self._poses(colour_s), self._moved(colour_s)), rng, self.options.noise
        )
        depth_m = measured_depth(*self.renderer.depth(self._poses(depth_s)), rng, self.options.noise)
        colour_name, depth_name = f"rgb/{_stamp_of(colour_s)}.jpg", f"depth/{_stamp_of(depth_s)}.png"
        jpeg = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        _write_image(self.folder / colour_name, image[..., ::-1], jpeg)
        _write_image(self.folder / depth_name, np.rint(depth_m * UNITS_PER_METRE).astype(np.uint16), [])
        return colour_name, depth_name

    def _poses(self, time_s: float) -> Floats:
        """The pose (4, 4) at a time, or with a rolling shutter those (H, 4, 4) of its rows, the middle one at it."""
        camera = self.options.camera
        if not camera.readout_s:
            return np.asarray(self.path.world_from_cam(np.array([time_s]))[0])
        return self.path.world_from_cam(time_s + camera.readout_s * (np.arange(camera.height) / camera.height - 0.5))

    def _moved(self, time_s: float) -> Floats | None:
        """The camera's twist (6,) while its shutter is open, in its own axes; None without an exposure time."""
        half_s = self.options.exposure_s / 2
        if not half_s:
            return None
        begin, end = self.path.world_from_cam(np.array([time_s - half_s, time_s + half_s]))
        return se3.log(se3.inverse(begin) @ end)


def _stamp_of(time_s: float) -> str:
    """The stamp of a time in names and lists."""
    return f"{FIRST_STAMP_S + time_s:.6f}"


def _write_image(
    path: Path, image: Bytes | np.ndarray[tuple[int, ...], np.dtype[np.uint16]], how: Sequence[int]
) -> None:
    done, encoded = cv2.imencode(path.suffix, image, how)
    if not done:
        raise SourceError(f"{path}: OpenCV cannot encode this image; install opencv-python-headless with {path.suffix}")
    path.write_bytes(encoded.tobytes())


def _write_list(path: Path, what: str, names: Sequence[str]) -> None:
    lines = [f"{Path(name).stem} {name}" for name in names]
    path.write_text("\n".join([f"# {what}", "# timestamp filename", *lines]) + "\n")


def _write_truth(path: Path, loop: HandHeldLoop | Walk) -> None:
    times_s = np.arange(0, loop.duration_s + 0.2, 1 / TRUTH_HZ) + 0.0037
    world_from_cam: Floats = loop.world_from_cam(times_s)
    rows = np.concatenate([world_from_cam[:, :3, 3], se3.to_quat_xyzw(world_from_cam)], axis=1)
    lines = [
        f"{_stamp_of(t)} " + " ".join(f"{value:.7f}" for value in row) for t, row in zip(times_s, rows, strict=True)
    ]
    path.write_text("\n".join(["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw", *lines]) + "\n")


def _write_intrinsics(path: Path, camera: Camera) -> None:
    if camera.readout_s:
        path.write_text("".join(f"{name}: {value}\n" for name, value in asdict(camera).items()))
        return
    values = f"{camera.fx} {camera.fy} {camera.cx} {camera.cy} {camera.width} {camera.height}"
    path.write_text(f"# fx fy cx cy width height\n{values}\n")

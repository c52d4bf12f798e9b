"""What the contracts of all kinds of stages share: how properties are checked, and a small room as data."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Generic, TypeVar

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.types import Bytes, Camera, CloudSet, Floats, Floats32, Frame, PointCloud, Source

Case = TypeVar("Case")
IS_A_STAGE = "is a stage"

FRAMES, TURNS, WIDTH, HEIGHT = 8, 0.02, 320, 240
"""Neighbours are up to 6 cm and 4 degrees apart; the camera goes there and back."""
CLOUD_VOXEL_M, LANDMARKS = 0.04, 500
PAIR = (2, 4)
"""Two views of the room 10 cm and 5 degrees apart, as far as every registrar's guess may be off."""
TURNED = se3.exp(np.array([0.4, 1.1, -2.0, 3.0, -1.0, 2.0]))
"""Other axes of a cloud, far from its own."""


def check_stage(stage: object) -> None:
    """Assert that it pickles and cannot be changed."""
    assert type(stage) is type(pickle.loads(pickle.dumps(stage))), "the stage does not pickle"
    assert pickle.loads(pickle.dumps(stage)) == stage, "the stage pickled is not equal to itself: is it a dataclass?"
    try:
        stage.made_by_a_check = True  # type: ignore[attr-defined]
    except Exception:  # noqa: BLE001 - whatever it raises, it refused
        return
    raise AssertionError("the stage can be changed: make it a frozen dataclass")


def check_kind(stage: object, protocol: type) -> None:
    """Assert that it is a stage of this kind: it has the methods, pickles, is hashable and cannot be changed."""
    assert isinstance(stage, protocol), f"it lacks a method of {protocol.__name__}"
    check_stage(stage)
    try:
        hash(stage)
    except TypeError as error:
        raise AssertionError(f"the stage has no hash, by which workers know it: {error}") from error


@dataclass(frozen=True)
class Contract(Generic[Case]):
    """The check of one kind of stage: called with a stage, and what else `case` takes, it asserts all properties.

    First that the stage has the methods of its `protocol`, pickles, is hashable and cannot be changed; then each of
    `promises`.
    """

    protocol: type
    promises: Mapping[str, Callable[[Case], None]]
    case: Callable[..., Case] = lambda stage: stage  # noqa: E731

    @property
    def properties(self) -> tuple[str, ...]:
        """What is checked, by name."""
        return (IS_A_STAGE, *self.promises)

    def __call__(
        self, stage: object, *given: Any, lacks: Collection[str] = (), properties: Collection[str] | None = None
    ) -> None:
        """Check all properties, or those that are named. Raises `AssertionError`: which does not hold, and why.

        A property that the stage lacks by its nature is declared in `lacks`, and must then fail.
        """
        unknown = {*lacks, *(properties or ())} - {*self.properties}
        assert not unknown, f"no such property: {sorted(unknown)}; there are {list(self.properties)}"
        for name in self.properties if properties is None else properties:
            try:
                if name == IS_A_STAGE:
                    check_kind(stage, self.protocol)
                else:
                    self.promises[name](self.case(stage, *given))
            except Exception as error:
                if name in lacks:
                    continue
                why = str(error) if isinstance(error, AssertionError) else f"raises {type(error).__name__}: {error}"
                raise AssertionError(f"{name}: {why}") from error
            assert name not in lacks, f"{name}: declared as lacking, but it holds: take it out of `lacks`"


def raises(error: type[Exception], call: Callable[[], Any]) -> str | None:
    """The message of the error of this type that the call raises, None where it raises none."""
    try:
        call()
    except error as raised:
        return str(raised)
    return None


@dataclass(frozen=True)
class Room:
    """Frames with depth, colour and true poses, and their clouds with normals, colours and landmarks."""

    frames: tuple[Frame, ...]
    clouds: CloudSet

    @property
    def world_from_cam(self) -> Floats:
        """The true poses (N, 4, 4), a copy."""
        return np.array([frame.world_from_cam for frame in self.frames])

    @property
    def source(self) -> Source:
        """A source of the frames."""
        from pathlib import Path

        return Source("room", Path("room"), self.frames)


@cache
def room() -> Room:
    """The room, rendered at the first call (about a second)."""
    from hodge_pipeline.registration import one_thread  # noqa: F401 - before anything else loads open3d

    # isort: split
    from hodge_pipeline.demo.path import HandHeldLoop
    from hodge_pipeline.demo.render import Renderer
    from hodge_pipeline.demo.room import build_room
    from hodge_pipeline.registration.clouds import CloudOptions, make_cloud

    focal = 0.82 * WIDTH
    camera = Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    renderer, path = Renderer(build_room(0), camera), HandHeldLoop(0, float(FRAMES), TURNS)
    frames = []
    for row, pose in enumerate(path.world_from_cam(np.arange(FRAMES, dtype=float))):
        colour = np.round(255 * renderer.colour(pose)).astype(np.uint8)
        frames.append(_frame(row, camera, renderer.depth(pose)[0], colour, pose))
    options = CloudOptions(stride=1, voxel_m=CLOUD_VOXEL_M, landmarks=LANDMARKS)
    return Room(tuple(frames), CloudSet.from_clouds([make_cloud(frame, options)[0] for frame in frames]))


def _frame(row: int, camera: Camera, depth_m: Floats32, colour: Bytes, pose: Floats) -> Frame:
    return Frame(
        frame_id=row,
        stamp_s=row / 10,
        camera=camera,
        read_depth=partial(np.array, depth_m),
        read_colour=partial(np.array, colour),
        world_from_cam=pose,
    )


def seen_from(cloud: PointCloud, b_from_a: Floats) -> PointCloud:
    """The cloud in other axes, its normals and landmarks with it."""
    normals, marks = cloud.normals_in_cam, cloud.landmarks
    return replace(
        cloud,
        points_in_cam=_moved(cloud.points_in_cam, b_from_a),
        normals_in_cam=None if normals is None else np.asarray(normals @ b_from_a[:3, :3].T, np.float32),
        landmarks=None if marks is None else replace(marks, points_in_cam=_moved(marks.points_in_cam, b_from_a)),
    )


def _moved(points: Floats32, b_from_a: Floats) -> Floats32:
    return np.asarray(se3.transform(b_from_a, points.astype(float)), np.float32)


def nothing() -> PointCloud:
    """A cloud without a point."""
    return CloudSet.from_clouds([PointCloud(np.zeros((0, 3), np.float32))])[0]


def without_points(clouds: CloudSet, rows: Sequence[int]) -> CloudSet:
    """The clouds, those of these rows empty."""
    return CloudSet.from_clouds([nothing() if row in rows else cloud for row, cloud in enumerate(clouds)])


def off_by(motion: Floats, truth: Floats) -> tuple[float, float]:
    """Radians and metres by which a motion (4, 4) is off."""
    error = se3.inverse(truth) @ motion
    return float(se3.rotation_angle(error)), float(np.linalg.norm(error[:3, 3]))

"""Stages each of which breaks one promise of its contract."""

from __future__ import annotations

import itertools
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError, WorkerError
from hodge_pipeline.executors.local import InProcess, LocalExecutor
from hodge_pipeline.fusion.tsdf import TsdfFuser
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.stages import Step
from hodge_pipeline.start.odometry import OdometryStart
from hodge_pipeline.types import Edges, Floats, PointCloud, Source
from hodge_pipeline.types.notes import Note

OFF = se3.exp(np.array([0.0, 0.0, 0.3, 0.5, 0.0, 0.0]))
CALLS = [0]


def counted() -> int:
    """1, 2, 3, …: what never repeats itself."""
    CALLS[0] += 1
    return CALLS[0]


@dataclass
class Changeable:
    """A stage of every kind but for its work, that can be changed."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "made_by_a_check":
            raise AttributeError(name)
        return print


@dataclass(frozen=True)
class Unhashable:
    names: list[str] = field(default_factory=list)

    def propose(self, frames: Any, clouds: Any, world_from_cam: Floats) -> Edges:
        return SequentialEdges().propose(frames, clouds, world_from_cam)


# Edge builders ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Builder:
    how: str

    def propose(self, frames: Any, clouds: Any, world_from_cam: Floats) -> Any:
        inner = SequentialEdges().propose(frames, clouds, world_from_cam)
        match self.how:
            case "a list":
                return inner.pairs.tolist()
            case "no pair":
                return Edges.proposed(np.zeros((0, 2), np.int64), "x")
            case "backwards":
                return replace(inner, pairs=inner.pairs[:, ::-1].copy())
            case "twice":
                return Edges.of(np.repeat(inner.pairs, 2, axis=0), "x")
            case "no reason":
                return Edges.of(inner.pairs, "")
            case "overlap":
                return replace(inner, overlap=np.full(len(inner), 3.0))
            case "moves":
                world_from_cam += 1e-9
            case "random":
                return inner.select(slice(counted() % 3, None))
            case "empty ones":
                return Edges.proposed(np.array([[3, 4], [6, 7]]), "x") if len(frames) > 7 else inner
            case "names":
                ids = [frame.frame_id for frame in frames]
                return inner if all(isinstance(name, int) for name in ids) else inner.select(slice(1, None))
            case "truth":
                return inner if len(frames) and frames[0].world_from_cam is not None else inner.select(slice(1, None))
            case "itself":
                return inner if len(frames) > 1 else Edges.of([(0, 1)], "x")
        return inner


# Registrars ---------------------------------------------------------------------------------------------------------


def as_it_is(result: Any, *given: Any) -> Any:
    return result


def what_is_given(*given: Any) -> Any:
    return given


@dataclass(frozen=True)
class Spoiled:
    """A stage with something spoiled: what one of its methods is given, or what it gives."""

    inner: Any
    after: Callable[..., Any] = as_it_is
    before: Callable[..., Any] = what_is_given

    def prepare(self, cloud: PointCloud) -> Any:
        return self.inner.prepare(cloud)

    def register(self, target: Any, source: Any, i_from_j: Floats) -> Any:
        given = self.before(target, source, i_from_j)
        return self.after(self.inner.register(*given), *given)

    def describe(self, cloud: PointCloud) -> Any:
        return self.inner.describe(cloud)

    def match(self, target: Any, source: Any) -> Any:
        given = self.before(target, source)
        return self.after(self.inner.match(*given), *given)


def without_guess(target: Any, source: Any, guess: Floats) -> Any:
    return target, source, np.eye(4)


def as_guessed(found: Any, target: Any, source: Any, guess: Floats) -> Any:
    return replace(found, i_from_j=guess)


def never_the_same(found: Any, *_: Any) -> Any:
    return replace(found, i_from_j=found.i_from_j @ se3.exp(np.full(6, 1e-12 * counted())))


def mark(target: Any, source: Any, guess: Floats) -> Any:
    source.points = source.points + 1e-4  # what was prepared for one pair is changed for the next
    return target, source, guess


def always_converged(found: Any, *_: Any) -> Any:
    return replace(found, converged=True)


def sure(found: Any, *_: Any) -> Any:
    return replace(found, information=np.eye(6))


def lopsided(found: Any, *_: Any) -> Any:
    return replace(found, information=np.triu(np.ones((6, 6))))


@dataclass(frozen=True)
class NeedsFinite:
    """It takes points that are not finite for the origin."""

    def prepare(self, cloud: PointCloud) -> Any:
        points = np.where(np.isfinite(cloud.points_in_cam), cloud.points_in_cam, 3.0).astype(np.float32)
        if np.isnan(cloud.points_in_cam).any():
            points = points[:20]
        return Gicp().prepare(PointCloud(points))

    def register(self, target: Any, source: Any, i_from_j: Floats) -> Any:
        return Gicp().register(target, source, i_from_j)


def unchanged(found: Any, *_: Any) -> Any:
    return replace(found, i_from_j=np.eye(4))


def more_inliers(found: Any, *_: Any) -> Any:
    return replace(found, inliers=found.matches + 1)


def some_inliers(found: Any, *_: Any) -> Any:
    return replace(found, inliers=max(found.inliers, 1), matches=max(found.matches, 1))


# Fusers ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fuser:
    how: str

    def fuse(self, frames: Any, world_from_cam: Floats, advance: Any = print) -> Any:
        inner = TsdfFuser(voxel_m=0.04)
        match self.how:
            case "nowhere":
                return inner.fuse(frames, np.tile(np.eye(4), (len(frames), 1, 1)), advance)
            case "silent":
                return inner.fuse(frames, world_from_cam)
            case "blind":
                if not any(frame.read_depth for frame in frames):
                    return inner.fuse([], world_from_cam[:0], advance)
        model = inner.fuse(frames, world_from_cam, advance)
        match self.how:
            case "random":
                return replace(model, name=f"mesh {counted()}")
            case "grey":
                return replace(model, colours=None)
            case "no notes":
                return replace(model, notes=())
            case "corners":
                assert model.triangles is not None
                return replace(model, triangles=model.triangles + 10)
        return model


# Executors ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Executor:
    how: str

    @contextmanager
    def open(self) -> Iterator[Any]:
        with LocalExecutor(workers=1, retries=10_000 if self.how == "patient" else 2).open() as workers:
            yield Workers(self.how, workers)


@dataclass(frozen=True)
class Workers:
    how: str
    inner: Any

    def map(self, task: Any, blocks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        match self.how:
            case "loses one":
                return self.inner.map(task, blocks[:-1])
            case "swaps":
                found = sorted(InProcess().map(task, blocks))
                return ((row, found[-1 - row][1]) for row in range(len(found)))
            case "swallows":
                return self._without_errors(task, blocks)
            case "gives up":
                return iter(()) if len(blocks) < 2 else self._until_a_worker_dies(task, blocks)
            case "kills silently":
                return self._until_a_worker_dies(task, blocks)
        return self.inner.map(task, blocks)

    def _without_errors(self, task: Any, blocks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        try:
            yield from self.inner.map(task, blocks)
        except ValueError:
            return

    def _until_a_worker_dies(self, task: Any, blocks: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        with LocalExecutor(workers=1, retries=0).open() as workers:
            try:
                yield from workers.map(task, blocks)
            except WorkerError:
                return


@dataclass(frozen=True)
class Once:
    """An executor that opens only once."""

    _opened = itertools.count()

    @contextmanager
    def open(self) -> Iterator[Any]:
        yield InProcess() if next(self._opened) % 2 == 0 else Workers("loses one", InProcess())


# Starts -------------------------------------------------------------------------------------------------------------


class Forgetful:
    """Steps that remember nothing."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def step(self, function: Any, *inputs: Any, title: str, total: int = 1, name: str = "", **resources: Any) -> Any:
        return self.inner.step(function, *inputs, title=title, total=total, name=name, **resources)

    def remember(self, value: object, key: str) -> None:
        self.inner.remember(value, f"{key} {uuid.uuid4().hex}")

    def key(self, value: Any) -> str:
        return str(self.inner.key(value))

    def note(self, *notes: Note) -> None:
        self.inner.note(*notes)


def draw(*, step: Step) -> Floats:
    """Step: numbers that no seed decides."""
    return np.random.default_rng(time.time_ns()).normal(size=6)


@dataclass(frozen=True)
class Start:
    how: str

    def begin(self, source: Source, clouds: Any, steps: Any, workers: Any) -> Any:
        inner = OdometryStart()
        if self.how == "new keys":
            steps = Forgetful(steps)
            steps.remember(source, steps.key(source))
        if self.how == "one frame less":
            less = replace(source, frames=source.frames[1:])
            steps.remember(less, "less")
            return inner.begin(less, clouds, steps, workers)
        if self.how == "needs every frame" and not all(frame.read_depth().any() for frame in source.frames):  # type: ignore[misc]
            raise ValueError("a frame is dark")
        try:
            scene = inner.begin(source, clouds, steps, workers)
        except SourceError:
            if self.how != "takes anything":
                raise
            return None
        first = scene.first
        match self.how:
            case "stands still":
                return replace(
                    scene, first=replace(first, world_from_cam=np.tile(np.eye(4), (len(first.vertex_ids), 1, 1)))
                )
            case "random":
                shaken = first.world_from_cam @ se3.exp(1e-9 * steps.step(draw, title="draw"))
                return replace(scene, first=replace(first, world_from_cam=shaken))
            case "sheared":
                return replace(scene, first=replace(first, world_from_cam=1.1 * first.world_from_cam))
        return scene

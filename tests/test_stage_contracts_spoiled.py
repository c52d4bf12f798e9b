"""The contract checks themselves: each stage here breaks one promise, and the check must say which."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hodge_adapters.colmap.models import ColmapModels
from hodge_adapters.trajectories.readers import TumPosesReader
from hodge_adapters.trajectories.rewriting import TumRewriter
from hodge_adapters.trajectories.text import TumWriter, parse_tum
from hodge_pipeline import se3, testing
from hodge_pipeline.errors import SourceError, WorkerError
from hodge_pipeline.executors.local import InProcess, LocalExecutor
from hodge_pipeline.fusion.tsdf import TsdfFuser
from hodge_pipeline.pairs.sequential import SequentialEdges
from hodge_pipeline.registration.gicp import Gicp
from hodge_pipeline.registration.global_landmarks import LandmarkConsensus
from hodge_pipeline.stages import Step
from hodge_pipeline.start.odometry import OdometryStart
from hodge_pipeline.testing.writers import whole_source
from hodge_pipeline.types import Edges, Floats, PointCloud, Source
from hodge_pipeline.types.notes import Note
from test_readers_colmap import synthetic

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


def by_identity(found: Any, target: Any, source: Any) -> Any:
    seen = id(target) in SEEN
    SEEN.add(id(target))
    return replace(found, matches=found.matches + seen)


SEEN: set[int] = set()


def some_inliers(found: Any, *_: Any) -> Any:
    return replace(found, inliers=max(found.inliers, 1), matches=max(found.matches, 1))


# Fusers and refiners ------------------------------------------------------------------------------------------------


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


@dataclass(frozen=True)
class Refiner:
    how: str

    def refine(self, frames: Any, world_from_cam: Floats, advance: Any = print) -> Floats:
        advance(len(frames) - (self.how == "silent"))
        match self.how:
            case "in place":
                world_from_cam[:, 0, 3] += 1e-9
            case "random":
                return world_from_cam @ se3.exp(np.full(6, 1e-9 * counted()))
            case "worse":
                return world_from_cam @ se3.exp(0.1 * np.random.default_rng(5).normal(size=(len(frames), 6)))
        return world_from_cam.copy()


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

    @contextmanager
    def open(self) -> Iterator[Any]:
        yield InProcess() if counted() % 2 else Workers("loses one", InProcess())


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


# Writers, rewriters, models -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Writer:
    how: str

    def write(self, path: Path, source: Source) -> None:
        match self.how:
            case "nothing":
                return
            case "leftovers":
                (path.parent / "draft").write_text("x")
            case "clock":
                path.write_text(str(counted()))
                return
            case "appends":
                with path.open("a") as out:
                    out.write("a line\n")
                return
            case "raw":
                path.write_text("a line\n")
                return
            case "shifted":
                assert source.trajectory is not None
                poses = OFF @ source.trajectory.world_from_cam
                source = replace(source, trajectory=replace(source.trajectory, world_from_cam=poses))
            case "anonymous" if source.trajectory is None:
                raise SourceError("has no poses")
        TumWriter().write(path, source)


@dataclass(frozen=True)
class Rewriter:
    how: str

    def rewrite(self, folder: Path, original: Path, trajectory: Any) -> Path:
        if self.how == "ignores":
            return self.copy(folder, original)
        if self.how == "in place":
            original.write_text(original.read_text() + "\n")
        path = TumRewriter().rewrite(folder, original, trajectory)
        return path.rename(folder / "new.tum") if self.how == "name" else path

    def copy(self, folder: Path, original: Path) -> Path:
        path = TumRewriter().copy(folder, original)
        if self.how == "converts":
            path.write_text(path.read_text().replace("0", "0 "))
        return path


class Model:
    """A COLMAP model with one method spoiled."""

    def __init__(self, inner: Any, how: str) -> None:
        self._inner, self._how = inner, how

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    @property
    def world_from_body(self) -> Floats:
        poses: Floats = self._inner.world_from_body
        return poses @ OFF if self._how == "carried" else poses

    def scaled(self, factor: float) -> Any:
        return self._inner.scaled(1.0 if self._how == "one scale" else factor)

    def moved(self, poses: Floats) -> Any:
        return self._inner if self._how == "stays" else self._inner.moved(poses)

    def measured(self) -> Any:
        graph, notes = self._inner.measured()
        return (replace(graph, i_from_j=1.1 * graph.i_from_j), notes) if self._how == "sheared" else (graph, notes)

    def seen_points(self) -> Any:
        return list(self._inner.seen_points())[1:] if self._how == "one cloud less" else self._inner.seen_points()

    def read_back(self, folder: Path, notes: tuple[str, ...]) -> Any:
        return self._inner.read_back(folder, () if self._how == "no notes" else notes)


@dataclass(frozen=True)
class Models:
    how: str

    def open_models(self, source: Any) -> Any:
        if self.how == "takes anything" and not source.exists():
            return []
        return [Model(model, self.how) for model in ColmapModels().open_models(source)]

    def join(self, models: Any) -> Any:
        return models


SPOILED = [
    ("edges", Changeable(), "is a stage", "can be changed"),
    ("edges", object(), "is a stage", "lacks a method of EdgeBuilder"),
    ("edges", Unhashable(), "is a stage", "has no hash"),
    ("edges", Builder("a list"), "candidates", "gives a list"),
    ("edges", Builder("no pair"), "candidates", "proposes no pair"),
    ("edges", Builder("backwards"), "candidates", "is not i < j"),
    ("edges", Builder("twice"), "candidates", "is proposed twice"),
    ("edges", Builder("no reason"), "candidates", "without a reason"),
    ("edges", Builder("overlap"), "candidates", r"not in \[0, 1\]"),
    ("edges", Builder("moves"), "candidates", "changes the poses"),
    ("edges", Builder("random"), "the same pairs again", "other pairs when asked again"),
    ("edges", Builder("empty ones"), "frames without points", "a frame without points is in a pair"),
    ("edges", Builder("names"), "rows, not names", "named otherwise"),
    ("edges", Builder("truth"), "no look at the truth", "frames' own poses"),
    ("edges", Builder("itself"), "one frame", "a pair has no frame"),
    ("registration", Changeable(), "is a stage", "can be changed"),
    ("registration", Spoiled(Gicp(), after=as_guessed), "known motion", "off by"),
    ("registration", Spoiled(Gicp(), after=lopsided), "known motion", "not symmetric"),
    ("registration", Spoiled(Gicp(), before=without_guess), "other axes", "guess i_from_j that undoes them: off by"),
    ("registration", Spoiled(Gicp(), after=never_the_same), "the same bits again", "other bits"),
    ("registration", Spoiled(Gicp(), before=mark), "prepared once", "registered before give other bits"),
    ("registration", NeedsFinite(), "points not finite", "off by"),
    ("registration", Spoiled(Gicp(), after=always_converged), "nothing in common", "called converged"),
    ("registration", Spoiled(Gicp(), after=sure), "a bare wall", "held in every direction"),
    ("global_registration", Changeable(), "is a stage", "can be changed"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=unchanged), "known motion", "off by"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=more_inliers), "known motion", "inliers of"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=never_the_same), "the same answer again", "another"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=never_the_same), "stored descriptions", "otherwise"),
    ("global_registration", Spoiled(LandmarkConsensus(), after=some_inliers), "nothing in common", "1 matches agree"),
    ("executors", Changeable(), "is a stage", "can be changed"),
    ("executors", Executor("loses one"), "every block once", "7 blocks give the results of blocks"),
    ("executors", Executor("swaps"), "every block once", "is that of another"),
    ("executors", Executor("swallows"), "errors of tasks", "is lost"),
    ("executors", Once(), "left early", "opened again"),
    ("executors", Executor("gives up"), "a worker that dies", "a worker died once"),
    ("executors", Executor("kills silently"), "a block that kills", "must raise WorkerError"),
    ("refiners", Changeable(), "is a stage", "can be changed"),
    ("refiners", Refiner("in place"), "the same bits again", "changes the poses"),
    ("refiners", Refiner("silent"), "no harm", "heard of 11 of 12"),
    ("refiners", Refiner("random"), "the same bits again", "other bits"),
    ("refiners", Refiner("worse"), "no harm", "off afterwards"),
    ("fusion", Changeable(), "is a stage", "can be changed"),
    ("fusion", Fuser("nowhere"), "surface", "off the wall"),
    ("fusion", Fuser("silent"), "surface", "heard of 0 of 6"),
    ("fusion", Fuser("corners"), "surface", "a corner that is no point"),
    ("fusion", Fuser("random"), "the same bits again", "another model"),
    ("fusion", Fuser("grey"), "colours", "without colours"),
    ("fusion", Fuser("no notes"), "frames left out", "no note tells of a frame without a pose"),
    ("fusion", Fuser("blind"), "no geometry", "must raise SourceError"),
    ("start", Changeable(), "is a stage", "can be changed"),
    ("start", Start("stands still"), "first poses", "m from the first"),
    ("start", Start("one frame less"), "first poses", "has other frames than the source"),
    ("start", Start("sheared"), "first poses", "not a rigid motion"),
    ("start", Start("random"), "the same bits again", "other bits when started again"),
    ("start", Start("new keys"), "computed once", "is computed again"),
    ("start", Start("needs every frame"), "a frame without points", "raises ValueError: a frame is dark"),
    ("start", Start("takes anything"), "no points at all", "begin gives a NoneType"),
]


@pytest.mark.parametrize(("kind", "stage", "what", "why"), SPOILED)
def test_a_stage_that_breaks_its_contract_is_noticed(kind: str, stage: Any, what: str, why: str) -> None:
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.CHECKS[kind](stage, properties=[what])


@pytest.mark.parametrize(
    ("writer", "what", "why"),
    [
        (Changeable(), "is a stage", "can be changed"),
        (Writer("nothing"), "written or refused", "nothing is at the path"),
        (Writer("leftovers"), "written or refused", "are left behind"),
        (Writer("anonymous"), "written or refused", "does not name the source"),
        (Writer("clock"), "the same bytes again", "other bytes"),
        (Writer("appends"), "replaced", "something else than afresh"),
        (Writer("raw"), "no place to write", "raises NotADirectoryError"),
        (Writer("shifted"), "read back", "poses of the trajectory are off by"),
    ],
)
def test_a_writer_that_breaks_its_contract_is_noticed(writer: Any, what: str, why: str) -> None:
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.check_writer(writer, "poses.tum", TumPosesReader(), properties=[what])


@pytest.mark.parametrize(
    ("rewriter", "what", "why"),
    [
        (Changeable(), "is a stage", "can be changed"),
        (Rewriter("ignores"), "new poses", "poses are off by"),
        (Rewriter("name"), "new poses", "the file is called new.tum"),
        (Rewriter("converts"), "copy", "not the original's bytes"),
        (Rewriter("in place"), "original", "changes the original"),
    ],
)
def test_a_rewriter_that_breaks_its_contract_is_noticed(rewriter: Any, what: str, why: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    TumWriter().write(path, whole_source())
    assert len(parse_tum(path).trajectory) == 12
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.check_rewriter(rewriter, path, TumPosesReader(), properties=[what])


@pytest.mark.parametrize(
    ("models", "what", "why"),
    [
        (Changeable(), "is a stage", "can be changed"),
        (Models("takes anything"), "no such path", "must raise SourceError"),
        (Models("carried"), "bodies and frames", "where their bodies carry them"),
        (Models("sheared"), "measured", "an edge is not a rigid motion"),
        (Models("one cloud less"), "seen points", "points of"),
        (Models("one scale"), "another unit", "does not double the positions"),
        (Models("stays"), "moved", "not at the poses that were given"),
        (Models("no notes"), "read back", "the notes are lost"),
    ],
)
def test_a_reader_of_models_that_breaks_its_contract_is_noticed(
    models: Any, what: str, why: str, tmp_path: Path
) -> None:
    synthetic(tmp_path)
    with pytest.raises(AssertionError, match=f"^{what}: .*{why}"):
        testing.check_model_reader(models, tmp_path / "text", properties=[what])


def test_each_property_has_a_stage_that_breaks_it() -> None:
    for kind in ("edges", "registration", "global_registration", "executors", "refiners", "fusion", "start"):
        assert {what for name, _, what, _ in SPOILED if name == kind} == {*testing.CHECKS[kind].properties}, kind


def test_what_is_declared_as_lacking_must_be_lacking() -> None:
    with pytest.raises(AssertionError, match="one frame: declared as lacking, but it holds"):
        testing.check_edge_builder(SequentialEdges(), lacks=["one frame"], properties=["one frame"])
    with pytest.raises(AssertionError, match=r"no such property: \['speed'\]"):
        testing.check_edge_builder(SequentialEdges(), lacks=["speed"])

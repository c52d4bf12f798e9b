"""What a stage must do. A stage is a frozen pydantic dataclass: its fields are its recipe options, its one method does
the work. There is no base class to inherit: whoever has the method is the stage.

A stage is found by name through the entry points `hodge_pipeline.<kind>` (see `registry.KINDS`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from pydantic import ConfigDict

from hodge_pipeline.scene import Scene
from hodge_pipeline.types import (
    CloudSet,
    Edges,
    Floats,
    Frame,
    Match,
    Model,
    PointCloud,
    Registration,
    Solution,
    Source,
    Trajectory,
    ViewGraph,
)
from hodge_pipeline.types.notes import Note
from hodge_pipeline.types.tracked_model import TrackedModel

Task = TypeVar("Task")
Result = TypeVar("Result")
OPTIONS = ConfigDict(extra="forbid", arbitrary_types_allowed=True)
"""Of options some of which are stages: an unknown one is refused."""
Advance = Callable[[int], None]
"""Called with the number of units just finished; a stage's one duty towards a progress bar. Negative where they are
done again."""


def no_progress(done: int) -> None:
    """Where nobody watches."""


class Tell(Protocol):
    """Takes what there is to report."""

    def __call__(self, *notes: Note) -> None:
        """Nothing comes back."""


@dataclass(frozen=True)
class Step:
    """What a step's function is given beside its inputs: where it may write, whom it tells of progress and oddities.

    `folder` survives a kill, so a function may go on from what it left there; a `Path` or `CloudSet` that it returns
    lies in it. What the function writes and does not return it removes.
    """

    folder: Path
    advance: Advance
    note: Tell


class Steps(Protocol):
    """Remembers what was computed in a run folder."""

    def step(
        self,
        function: Callable[..., Result],
        *inputs: Any,
        title: str,
        total: int = 1,
        name: str = "",
        **resources: Any,
    ) -> Result:
        """What `function(*inputs, **resources, step=Step)` returns, computed once for these inputs and read back
        afterwards; its return type is the stored type. `resources`, such as workers, do not decide the result.

        A step's name is its function's, or `name`, with the number of its call. `total` is how far `advance` counts.
        """

    def remember(self, value: object, key: str) -> None:
        """Let `value`, this very object, stand for `key` wherever it is an input."""

    def key(self, value: Any) -> str:
        """The key of an input: of the step that made it, else of its contents."""

    def note(self, *notes: Note) -> None:
        """Tell the user, the log and the report, once."""


@dataclass(frozen=True)
class Sniff:
    """How sure a reader is that a path is its format: `confidence` in [0, 1], and why, in a few words.

    `advice` says what a path is that the reader knows but cannot open, and what to give instead.
    """

    confidence: float
    reason: str
    advice: str = ""


@runtime_checkable
class FrameReader(Protocol):
    """Opens a path of one format."""

    def sniff(self, path: Path) -> Sniff:
        """How sure it is that this path is its format; reads no more than names and a header, never raises."""

    def open(self, path: Path) -> Source:
        """What is there, lazily. Raises `SourceError` that names file, record and remedy."""


@runtime_checkable
class Start(Protocol):
    """Finds first poses."""

    def begin(self, source: Source, clouds: Any, steps: Steps, workers: Workers) -> Scene:
        """The frames to register with their clouds (`clouds`: `registration.clouds.CloudOptions`) and first poses, and
        how all frames follow from them. What costs time is computed by `steps`, so that it is computed once.
        """


@runtime_checkable
class EdgeBuilder(Protocol):
    """Proposes pairs of frames to register."""

    def propose(self, frames: Sequence[Frame], clouds: CloudSet, world_from_cam: Floats) -> Edges:
        """Pairs, given the current poses (N, 4, 4). Frames without points get none."""


@runtime_checkable
class Registrar(Protocol):
    """Registers one pair of clouds."""

    def prepare(self, cloud: PointCloud) -> Any:
        """What it needs of one cloud (trees, covariances): made once in each worker, never pickled."""

    def register(self, target: Any, source: Any, i_from_j: Floats) -> Registration:
        """Moves the prepared cloud j (source) onto i (target), from the guess `i_from_j` (4, 4)."""


@runtime_checkable
class GlobalRegistrar(Protocol):
    """Finds where one cloud lies in another with no guess; what it finds is rough, and may be wrong."""

    def describe(self, cloud: PointCloud) -> Any:
        """What it needs of one cloud (features): arrays, made once and kept in a file."""

    def match(self, target: Any, source: Any) -> Match:
        """Where the described cloud j (source) lies in i (target); the same answer every time."""


class Workers(Protocol):
    """What an executor opens: hands that run the same task on many blocks."""

    def map(self, task: Callable[[Task], Result], blocks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """(index, result) of each block as it finishes, in any order.

        The task is a module-level function or a partial of one. A worker that dies costs its blocks a retry;
        `WorkerError` after several. An error that the task raises is raised here.
        """


def in_order(finished: Iterable[tuple[int, Result]]) -> Iterator[Result]:
    """The results of `Workers.map` in the order of their blocks; one that comes early waits for those before it."""
    early, number = dict[int, Result](), 0
    for index, result in finished:
        early[index] = result
        while number in early:
            yield early.pop(number)
            number += 1


@runtime_checkable
class Executor(Protocol):
    """Opens workers: processes on this machine, or a cluster."""

    def open(self) -> AbstractContextManager[Workers]:
        """Workers that live until the context is left. The same task gives the same result on any executor."""


@runtime_checkable
class ConsistencySolver(Protocol):
    """Makes the poses consistent with all edges at once."""

    def solve(self, graph: ViewGraph, world_from_cam: Floats) -> Solution:
        """Poses from the start (V, 4, 4); each connected component keeps its own gauge.

        The graph's fixed vertices stay at their start and its priors count, or a `GraphError` refuses them. See
        `hodge_pipeline.testing.check_solver`.
        """


@runtime_checkable
class Fuser(Protocol):
    """Fuses the frames into one model."""

    def fuse(self, frames: Sequence[Frame], world_from_cam: Floats, advance: Advance = no_progress) -> Model:
        """The scene in the world frame."""


@runtime_checkable
class Writer(Protocol):
    """Writes what another program reads."""

    def write(self, path: Path, source: Source) -> Sequence[str] | None:
        """One file or folder, written atomically, of what it can hold: a trajectory, a graph.

        Gives what was written, counted, and what the format cannot hold, a line each, or None. `SourceError` where the
        source has nothing of that kind.
        """


@runtime_checkable
class ModelReader(Protocol):
    """Opens models that track points, and joins several of one scene."""

    def open_models(self, source: Path | Sequence[Any]) -> Sequence[TrackedModel]:
        """The models at a path, or those that the format's own library holds in memory. Raises `SourceError`."""

    def join(self, models: Sequence[TrackedModel]) -> Sequence[tuple[TrackedModel, Sequence[int]]]:
        """The models again, those that measurements tie together as one, in the gauge and unit of its largest; with
        each the rows of those it is made of, the largest first. Every row is in one of them.
        """


@runtime_checkable
class PoseRewriter(Protocol):
    """Writes poses back into the form of the file they came from; it has the name of the reader of that form."""

    def rewrite(self, folder: Path, original: Path, trajectory: Trajectory) -> Path:
        """The path of `refined.<suffix>` in the folder: the original with the trajectory's poses in place of its own;
        stamps, as the reader gave them, order, comments and further columns stay as they are.
        """

    def copy(self, folder: Path, original: Path) -> Path:
        """`refined.<suffix>` in the folder, the original byte for byte. Gives the path."""

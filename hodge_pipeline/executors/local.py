"""The executor of this machine: spawned worker processes, or none."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for_end
from types import ModuleType
from typing import Any, TypeVar

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import WorkerError
from hodge_pipeline.interrupts import delayed_interrupts
from hodge_pipeline.stages import Workers
from hodge_pipeline.store.memory import keep_memory

Task = TypeVar("Task")
Result = TypeVar("Result")

SINGLE_THREADED = {
    name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
}


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LocalExecutor:
    """Runs blocks in spawned worker processes, one thread each.

    Spawned, not forked: small_gicp deadlocks in a forked child once its parent has used it.
    """

    workers: int | None = Field(
        None,
        ge=0,
        description="processes, at most one for each core; none: as many; 0: no process, the blocks run in this one",
    )
    retries: int = Field(2, ge=0, description="how often a block is tried again whose worker died")

    @contextmanager
    def open(self) -> Iterator[Workers]:
        """Workers that start with the first task and end at once when the context is left."""
        count = _cores() if self.workers is None else min(self.workers, _cores())
        if count == 0:
            yield InProcess()
            return
        pool = SpawnedWorkers(count, self.retries)
        try:
            yield pool
        finally:
            pool.kill()


class InProcess:
    """Runs blocks one after the other in this process, for debugging."""

    def map(self, task: Callable[[Task], Result], blocks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """(index, result) of each block, in order."""
        return ((row, task(block)) for row, block in enumerate(blocks))


class SpawnedWorkers:
    """A pool of processes that is replaced when one of them dies."""

    def __init__(self, count: int, retries: int) -> None:
        self._count, self._retries = count, retries
        self._pool: ProcessPoolExecutor | None = None

    def map(self, task: Callable[[Task], Result], blocks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """(index, result) of each block as it finishes; blocks of workers that died are retried.

        Raises `WorkerError` for a block that lost too many workers, or a task that workers cannot load.
        """
        _refuse_main(task, blocks)
        tries = [0] * len(blocks)
        waiting = list(range(len(blocks) - 1, -1, -1))
        running: dict[Future[Any], int] = {}
        while waiting or running:
            while waiting and self._may_begin(waiting[-1], list(running.values()), tries):
                try:
                    future = self._submit(task, blocks[waiting[-1]])
                except BrokenProcessPool:  # an idle worker died, or a busy one that is not noticed yet
                    break
                running[future] = waiting.pop()
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            lost = [running[future] for future in finished if isinstance(future.exception(), BrokenProcessPool)]
            for future in finished:
                row = running.pop(future)
                if row not in lost:
                    yield row, future.result()
            if lost or not finished:
                lost += running.values()
                running.clear()
                self._recover(lost, tries)
                waiting += sorted(lost, reverse=True)

    def _may_begin(self, row: int, running: list[int], tries: list[int]) -> bool:
        """Whether to submit a block: up to two for each worker, but a retried one alone, to know which block kills."""
        return not running or (len(running) < 2 * self._count and not any(tries[other] for other in (row, *running)))

    def _recover(self, lost: list[int], tries: list[int]) -> None:
        """Count a try of the lost blocks and drop the pool. Raises `WorkerError` for one that has none left."""
        self.kill()
        for row in lost:
            tries[row] += 1
            if tries[row] > self._retries:
                raise WorkerError(
                    f"block {row} lost its worker process {tries[row]} times (killed, or out of memory?): "
                    "close other programs or use fewer workers (--set executor.workers=1), then run again"
                )

    def _submit(self, task: Callable[[Task], Result], block: Task) -> Future[Result]:
        # may start a process, which inherits the environment, the main module and blocked signals as they are now
        with _environment(SINGLE_THREADED), _hidden_main(), delayed_interrupts(), _blocked_interrupts():
            if self._pool is None:
                spawn = multiprocessing.get_context("spawn")
                self._pool = ProcessPoolExecutor(self._count, mp_context=spawn, initializer=_begin_worker)
            return self._pool.submit(task, block)

    def kill(self) -> None:
        """End every worker at once."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        processes = list((pool._processes or {}).values())  # shutdown alone would wait for what they do
        pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.kill()
        for process in processes:
            process.join()


def _cores() -> int:
    """Cores that this process may use; on macOS and Windows all that there are."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def _begin_worker() -> None:
    keep_memory()
    _end_with_parent()


def _end_with_parent() -> None:
    """End this worker when its parent is killed: workers keep each other's queue open, so they would wait for ever.

    Ctrl-C, which reaches every process of a terminal, is left to the parent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_after, args=(parent.sentinel,), daemon=True).start()


def _exit_after(sentinel: int) -> None:
    wait_for_end([sentinel])
    os._exit(1)


def _refuse_main(task: Callable[[Task], Result], blocks: Sequence[Task]) -> None:
    """Raise `WorkerError` for a task defined in `__main__`, which a worker, not running the script, cannot load."""
    if blocks and b"__main__" in pickle.dumps((task, blocks[0])):
        raise WorkerError(
            "a stage or function is defined in the script or notebook itself, which workers do not load: "
            "move it into a module of its own and import it, or use the executor local with workers: 0"
        )


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables while the body runs."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Spawned children never get the Ctrl-C of their terminal, which would end them with a traceback as they start."""
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # whose start, at the first child, would unblock it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _hidden_main() -> Iterator[None]:
    """Keep spawned children from importing the user's script, which then needs no guard; a notebook works too."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main

"""Executors: the same results everywhere, a dead worker costs a retry, errors and orphans."""

import ctypes
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from hodge_pipeline.errors import WorkerError
from hodge_pipeline.executors import local
from hodge_pipeline.executors.dask import cluster_workers
from hodge_pipeline.executors.local import LocalExecutor
from hodge_pipeline.stages import Workers
from hodge_pipeline.testing import check_executor

PATIENCE_S = 600
"""No result depends on it: it only keeps a child that hangs from holding the tests for ever."""


def square(number: int) -> int:
    return number * number


def thread_limit(_: int) -> str:
    return os.environ["OMP_NUM_THREADS"]


def process_id(_: int) -> int:
    return os.getpid()


class Heap(ctypes.Structure):
    """What glibc's `mallinfo2` gives; `mapped` counts the arrays that are taken from the system each for itself."""

    _fields_ = [(name, ctypes.c_size_t) for name in ("arena", "free", "fast", "mapped", *"abcdef")]


def mapped_arrays(megabytes: int) -> int:
    """How many arrays of so many megabytes, of two, are taken from the system in this process and given back to it."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = Heap
    before = mallinfo2().mapped
    arrays = [np.zeros(megabytes * 1_000_000, np.uint8) for _ in range(2)]
    return int(mallinfo2().mapped - before) if arrays else -1


def has_mallinfo2() -> bool:
    try:
        return hasattr(ctypes.CDLL(None), "mallinfo2")
    except TypeError:
        return False


def die_always(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


@contextmanager
def dask_cluster() -> Iterator[Any]:
    """One of two workers, in which a block may cost one of them and no more."""
    import dask
    from distributed import LocalCluster

    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
    ):
        yield cluster


@contextmanager
def dask_workers() -> Iterator[Workers]:
    """Those of a cluster of their own."""
    with dask_cluster() as cluster, cluster_workers(cluster.scheduler_address) as workers:
        yield workers


Opened = Callable[[str], AbstractContextManager[Workers]]


@pytest.fixture(scope="module")
def opened() -> Iterator[Opened]:
    """Opens workers by their name; Dask's are those of one cluster, in which nannies replace workers that die."""
    with ExitStack() as stack:

        @cache
        def address() -> str:
            return str(stack.enter_context(dask_cluster()).scheduler_address)

        def open_workers(name: str) -> AbstractContextManager[Workers]:
            count = {"in process": 0, "spawned": 2}
            return LocalExecutor(workers=count[name]).open() if name in count else cluster_workers(address())

        yield open_workers


@dataclass(frozen=True)
class Opening:
    """What opens as an executor does."""

    open: Callable[[], AbstractContextManager[Workers]]


@pytest.mark.parametrize("what", check_executor.promises)
@pytest.mark.parametrize("name", ["in process", "spawned", "dask"])
def test_all_workers_keep_the_contract(name: str, what: str, opened: Opened) -> None:
    check_executor(Opening(partial(opened, name)), properties=[what])


@pytest.mark.parametrize(("name", "line"), [("spawned", "block 1 lost its"), ("dask", r"block \d lost its Dask")])
def test_a_block_that_always_kills_ends_in_one_line(name: str, line: str, opened: Opened) -> None:
    with opened(name) as workers, pytest.raises(WorkerError, match=line):
        list(workers.map(die_always, range(8)))


def test_workers_have_one_thread_and_both_work() -> None:
    with LocalExecutor(workers=2).open() as workers:
        assert {value for _, value in workers.map(thread_limit, range(4))} == {"1"}
        assert os.getpid() not in {pid for _, pid in workers.map(process_id, range(4))}


def test_there_are_no_more_workers_than_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "_cores", lambda: 1)
    with LocalExecutor(workers=10**9).open() as workers:
        assert workers._count == 1


def test_a_worker_that_dies_with_nothing_to_do_is_replaced() -> None:
    with LocalExecutor(workers=2).open() as workers:
        victim = next(pid for _, pid in workers.map(process_id, range(4)))
        os.kill(victim, signal.SIGKILL)
        with suppress(ChildProcessError):  # wait, but leave it to the pool to collect, which spins for ever otherwise
            os.waitid(os.P_PID, victim, os.WEXITED | os.WNOWAIT)
        assert sorted(workers.map(square, range(5))) == [(k, k * k) for k in range(5)]


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "killed.py"
    script.write_text(
        textwrap.dedent("""
        import os, signal, psutil
        from hodge_pipeline.executors.local import LocalExecutor
        with LocalExecutor(workers=2).open() as workers:
            list(workers.map(abs, range(8)))
            print(*(child.pid for child in psutil.Process().children(recursive=True)), flush=True)
            os.kill(os.getpid(), signal.SIGKILL)
        """)
    )
    # the pipe is at its end only when every process that inherited it has gone
    done = subprocess.run([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, timeout=PATIENCE_S)
    assert done.returncode == -signal.SIGKILL
    assert len(done.stdout.split()) >= 2


def test_a_task_of_the_script_itself_is_refused_in_one_line(tmp_path: Path) -> None:
    script = tmp_path / "own_task.py"
    script.write_text(
        textwrap.dedent("""
        from hodge_pipeline.errors import WorkerError
        from hodge_pipeline.executors.local import LocalExecutor
        def own(number):
            return number
        with LocalExecutor(workers=2).open() as workers:
            try:
                list(workers.map(own, range(3)))
            except WorkerError as error:
                print(error)
        """)
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    assert "a module of its own" in done.stdout


def test_leaving_early_leaves_no_orphans(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hodge_pipeline.executors.local._cores", lambda: 2)
    before = set(psutil.Process().children(recursive=True))
    with LocalExecutor(workers=2).open() as workers:
        next(workers.map(square, range(100)))
        started = set(psutil.Process().children(recursive=True)) - before
        trackers = {process for process in started if "resource_tracker" in " ".join(process.cmdline())}
        assert len(started - trackers) == 2
    workers_left = [process for process in started if process not in trackers]
    assert not psutil.wait_procs(workers_left, timeout=PATIENCE_S)[1]


def test_a_script_without_a_main_guard_runs(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent("""
        import math
        from hodge_pipeline.executors.local import LocalExecutor
        with LocalExecutor(workers=2).open() as workers:
            print(sorted(workers.map(math.factorial, range(9)))[-1])
        """)
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    assert done.stdout.strip() == "(8, 40320)"


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://x", ""])
def test_a_scheduler_that_is_not_there_is_one_line(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hodge_pipeline.executors.dask.TIMEOUT_S", 0.5)
    with pytest.raises(WorkerError, match=f"no Dask scheduler answers at '{address}'"), cluster_workers(address):
        raise AssertionError


def test_workers_of_tracking_pairs_and_scores_load_no_scipy() -> None:
    tasks = "registration.tracking.tracker, hodge_pipeline.registration.rgbd, hodge_pipeline.evaluation.cloud_distance"
    code = f"import sys, hodge_pipeline.{tasks}\nprint({{'scipy', 'open3d', 'matplotlib', 'rerun'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.skipif(not has_mallinfo2(), reason="not glibc 2.33 or newer")
def test_a_worker_uses_the_memory_of_images_again() -> None:
    with LocalExecutor(workers=1).open() as workers:
        found = dict(workers.map(mapped_arrays, [40, 200]))
    assert found == {0: 0, 1: 2}  # what is larger than any image is given back

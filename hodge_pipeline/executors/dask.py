"""The workers of a Dask cluster (optional extra `dask`).

Whoever answers at a scheduler's address runs code in this process, since Dask pickles: the address comes from the
caller, that is from the command line or the environment, and no recipe can name it. So this is no stage.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, TypeVar

from hodge_pipeline.errors import WorkerError
from hodge_pipeline.stages import Executor, Workers

Task = TypeVar("Task")
Result = TypeVar("Result")

TIMEOUT_S = 30.0
"""Seconds to wait for the scheduler: Dask's own default."""


def open_workers(executor: Executor, dask: str | None) -> AbstractContextManager[Workers]:
    """The workers of the Dask scheduler at an address such as tcp://host:8786, without one the executor's own."""
    return executor.open() if dask is None else cluster_workers(dask)


def describe(address: str) -> str:
    """A cluster's workers, hosts, memory and dashboard, in one line.

    Raises `WorkerError` as `cluster_workers` does.
    """
    with _client(address) as client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        hosts = {worker["host"] for worker in workers}
        memory_gb = sum(worker["memory_limit"] for worker in workers) / 1e9
        threads = sum(worker["nthreads"] for worker in workers)
        return (
            f"Dask at {address}: {len(workers)} workers with {threads} threads on {len(hosts)} "
            f"host{'' if len(hosts) == 1 else 's'}, {memory_gb:.1f} GB; dashboard: {client.dashboard_link}"
        )


@contextmanager
def cluster_workers(address: str) -> Iterator[Workers]:
    """The workers of a running cluster, which see the same files under the same paths; the cluster goes on after it.

    Raises `WorkerError` where the extra is missing, or nothing answers.
    """
    with _client(address) as client:
        yield ClusterWorkers(client)


def _client(address: str) -> Any:
    """A client of the scheduler. Raises `WorkerError` as `cluster_workers` does."""
    try:
        import distributed
    except ImportError as error:
        raise WorkerError("a Dask cluster needs the extra: pip install 'hodge-pipeline[dask]'") from error
    try:
        return distributed.Client(address, timeout=TIMEOUT_S)
    except (OSError, ValueError) as error:
        reason = str(error) or type(error).__name__
        raise WorkerError(
            f"no Dask scheduler answers at '{address}' ({reason}): start one there, or leave out --dask"
        ) from error


class ClusterWorkers:
    """The workers behind a Dask client."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def map(self, task: Callable[[Task], Result], blocks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """(index, result) of each block as it finishes; the scheduler retries blocks of workers that died."""
        import distributed

        futures = [self._client.submit(task, block, pure=False) for block in blocks]
        row_of = {future.key: row for row, future in enumerate(futures)}
        try:
            for future in distributed.as_completed(futures):
                yield row_of[future.key], self._result(future, row_of[future.key])
                future.release()
        finally:
            self._client.cancel(futures)

    def _result(self, future: Any, row: int) -> Any:
        """The result of a block. Raises `WorkerError` where it lost too many workers."""
        import distributed

        try:
            return future.result()
        except distributed.KilledWorker as error:
            raise WorkerError(f"block {row} lost its Dask worker too often (killed, or out of memory?)") from error

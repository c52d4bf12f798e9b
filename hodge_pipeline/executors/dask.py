"""Workers of a Dask cluster: an existing one by address, or a local one (optional extra `dask`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline.errors import WorkerError
from hodge_pipeline.stages import Workers

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class DaskExecutor:
    """Runs blocks on a Dask cluster whose workers see the same files under the same paths."""

    address: str | None = Field(None, description="of an existing scheduler, tcp://host:8786; none: a local cluster")
    workers: int = Field(2, ge=1, description="processes of the local cluster, one thread each")
    retries: int = Field(
        2, ge=0, description="how often a block is tried again whose worker died; an existing scheduler has its own"
    )
    timeout_s: float = Field(30.0, gt=0, description="seconds to wait for the scheduler")

    @contextmanager
    def open(self) -> Iterator[Workers]:
        """The cluster's workers; a local cluster ends when the block is left, another one stays."""
        try:
            import dask
            import distributed
        except ImportError as error:
            raise WorkerError("the executor 'dask' needs the extra: pip install 'hodge-pipeline[dask]'") from error
        local = {"n_workers": self.workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
        options: dict[str, Any] = local if self.address is None else {"address": self.address}
        with dask.config.set({"distributed.scheduler.allowed-failures": self.retries}):
            try:
                client = distributed.Client(timeout=self.timeout_s, **options)
            except (OSError, ValueError) as error:
                raise WorkerError(f"no Dask scheduler answers at {self.address}: {error}") from error
            with client:
                yield ClusterWorkers(client)


class ClusterWorkers:
    """The workers behind a Dask client."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def map(self, task: Callable[[Task], Result], blocks: Sequence[Task]) -> Iterator[tuple[int, Result]]:
        """(index, result) of each block as it finishes; a block of a worker that died is tried again."""
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
        import distributed

        try:
            return future.result()
        except distributed.KilledWorker as error:
            raise WorkerError(f"block {row} lost its Dask worker too often (killed, or out of memory?)") from error

"""The contract of executors, one named property after the other."""

from __future__ import annotations

import os
import tempfile
from functools import partial
from pathlib import Path

from hodge_pipeline.errors import WorkerError
from hodge_pipeline.stages import Executor
from hodge_pipeline.testing.stage import Contract, raises

BLOCKS = tuple(range(7))


def square(block: int) -> int:
    """A task."""
    return block * block


def fail(block: int) -> int:
    """A task that raises for one block."""
    if block == 3:
        raise ValueError("block 3 is wrong")
    return block


def die(folder: Path, own: int, times: int, block: int) -> int:
    """A task that kills its worker on one block, the first `times` times; never the process `own`."""
    if block == 3 and os.getpid() != own:
        tries = len(list(folder.iterdir()))
        if tries < times:
            (folder / str(tries)).touch()
            os._exit(1)
    return block


def _does_every_block_once(executor: Executor) -> None:
    with executor.open() as workers:
        for blocks in (BLOCKS, BLOCKS[:1], ()):
            found = list(workers.map(square, blocks))
            rows = sorted(row for row, _ in found)
            assert rows == list(range(len(blocks))), f"{len(blocks)} blocks give the results of blocks {rows}"
            wrong = [row for row, result in found if result != square(blocks[row])]
            assert not wrong, f"the result of block {wrong[:1]} is that of another"


def _passes_errors_on(executor: Executor) -> None:
    with executor.open() as workers:
        message = raises(ValueError, lambda: list(workers.map(fail, BLOCKS)))
        assert message is not None, "an error that a task raises is lost"
        assert message == "block 3 is wrong", f"the error of a task has another message: {message}"


def _can_be_left_early(executor: Executor) -> None:
    with executor.open() as workers:
        next(iter(workers.map(square, BLOCKS)))
    with executor.open() as workers:
        assert len(list(workers.map(square, BLOCKS))) == len(BLOCKS), "opened again it does not do every block"


def _survives_a_worker(executor: Executor) -> None:
    with tempfile.TemporaryDirectory() as folder, executor.open() as workers:
        found = sorted(workers.map(partial(die, Path(folder), os.getpid(), 1), BLOCKS))
        assert found == [(block, block) for block in BLOCKS], f"a worker died once: the results are {found}"


def _gives_up_on_a_block_that_kills(executor: Executor) -> None:
    with tempfile.TemporaryDirectory() as folder, executor.open() as workers:
        task = partial(die, Path(folder), os.getpid(), 1000)
        lost = raises(WorkerError, lambda: list(workers.map(task, BLOCKS)))
        died = any(Path(folder).iterdir())
        assert lost is not None or not died, "a block that kills every worker must raise WorkerError"


check_executor = Contract(
    Executor,
    {
        "every block once": _does_every_block_once,
        "errors of tasks": _passes_errors_on,
        "left early": _can_be_left_early,
        "a worker that dies": _survives_a_worker,
        "a block that kills": _gives_up_on_a_block_that_kills,
    },
)
"""Checks an executor on seven blocks."""

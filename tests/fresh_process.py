"""A function in a process of its own, which may be killed: a fork of one that has imported everything and run nothing.

A start of Python with all libraries costs 4 s of CPU; a fork of the process of the tests would hang for its threads.
"""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable
from typing import Any

from command import Ended

IMPORTED = [
    "cv2", "matplotlib.backends.backend_agg", "pytest", "rerun", "small_gicp",
    "hodge_adapters.tum.reader", "hodge_pipeline.cli.main", "hodge_pipeline.demo.sequence",
    "hodge_pipeline.fusion.cloud", "hodge_pipeline.lean_open3d", "hodge_pipeline.uses.recipe_run",
]  # fmt: skip


def run_fresh(function: Callable[..., object], *arguments: Any) -> Ended:
    """How the process ended, minus the signal where one ended it, and what it printed."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(IMPORTED)
    with tempfile.NamedTemporaryFile() as out, tempfile.NamedTemporaryFile() as told:
        process = server.Process(target=_redirected, args=(out.name, told.name, function, *arguments))
        process.start()
        process.join()
        assert process.exitcode is not None
        return Ended(process.exitcode, out.read().decode(), told.read().decode())


def _redirected(out: str, told: str, function: Callable[..., object], *arguments: Any) -> None:
    for number, name in ((1, out), (2, told)):
        os.dup2(os.open(name, os.O_WRONLY), number)
    function(*arguments)

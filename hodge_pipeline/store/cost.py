"""What a stage costs: wall and CPU seconds, and peak memory summed over this process and its workers."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from hodge_pipeline.types.input_files import open_input

SAMPLE_SECONDS = 1.0
"""Between two samples of the memory: one costs 6 ms a process, the kernel's sum over its pages."""


@dataclass
class Cost:
    """Cost of one stage; complete once its `measure` block is left. Memory in megabytes."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0


@dataclass
class Monitor:
    """Measures the process tree: workers that come and go are counted while they live, memory once a second at most.

    Memory is the proportional share (PSS) where the system tells it, so that pages mapped by several workers count
    once; elsewhere the resident size.
    """

    _cpu_by_process: dict[tuple[int, float], float] = field(default_factory=dict)
    _memory_mb: float = 0.0
    _memory_at: float = float("-inf")
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @contextmanager
    def measure(self) -> Iterator[Cost]:
        """A `Cost` that is filled when the block ends."""
        cost = Cost()
        stop = threading.Event()
        self._sample(cost)
        start_wall, start_cpu = time.perf_counter(), self._cpu_total()
        sampler = threading.Thread(target=self._watch, args=(cost, stop), daemon=True)
        sampler.start()
        try:
            yield cost
        finally:
            stop.set()
            sampler.join()
            self._sample(cost)
            cost.wall_s = time.perf_counter() - start_wall
            cost.cpu_s = self._cpu_total() - start_cpu

    def _watch(self, cost: Cost, stop: threading.Event) -> None:
        while not stop.wait(SAMPLE_SECONDS):
            self._sample(cost)

    def _cpu_total(self) -> float:
        with self._lock:
            return sum(self._cpu_by_process.values())

    def _sample(self, cost: Cost) -> None:
        """Note the CPU time so far of each process of the tree, and the memory of all of them."""
        memory, now = 0, time.monotonic()
        is_due = now - self._memory_at >= SAMPLE_SECONDS
        me = psutil.Process()
        for process in [me, *me.children(recursive=True)]:
            try:
                times = process.cpu_times()
                with self._lock:
                    self._cpu_by_process[process.pid, process.create_time()] = times.user + times.system
                memory += _memory_bytes(process) if is_due else 0
            except psutil.Error:  # it ended meanwhile: its last sample stands
                continue
        if is_due:
            self._memory_mb, self._memory_at = memory / 1e6, now
        cost.peak_mb = max(cost.peak_mb, self._memory_mb)


def _memory_bytes(process: psutil.Process) -> int:
    try:
        with open_input(Path(f"/proc/{process.pid}/smaps_rollup")) as rollup:
            lines = (line.split() for line in rollup)
            return next(int(words[1]) * 1024 for words in lines if words[0] == b"Pss:")
    except (OSError, StopIteration):
        return int(process.memory_info().rss)

"""What a stage costs: wall and CPU seconds, and peak memory summed over this process and its workers."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from hodge_pipeline.types.input_files import open_input

SAMPLE_SECONDS = 1.0
"""At 30 ms a look, a few per cent of one core."""
GROWTH = 1.02
"""Growth of the total resident size after which the PSS is measured again: the kernel takes 30 ms a process.
"""


@dataclass
class Cost:
    """Cost of one stage; complete once its `measure` block is left. Memory in megabytes."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0


@dataclass
class Monitor:
    """Measures the process tree: workers that come and go are counted while they live.

    Memory of several processes is the sum of their proportional set sizes (PSS), in which shared pages count once; of a
    single one, or where the system has no PSS, the resident size (RSS). The ratio of PSS to RSS is measured when the
    RSS has grown by `GROWTH` and reused in between.
    """

    _processes: list[psutil.Process] = field(default_factory=lambda: [psutil.Process()])
    _cpu_by_process: dict[tuple[int, float], float] = field(default_factory=dict)
    _largest_rss: float = 0.0
    _pss_share: float = 1.0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @contextmanager
    def measure(self) -> Iterator[Cost]:
        """A `Cost` that is filled when the block ends."""
        cost = Cost()
        stop = threading.Event()
        self._sample(cost, self._processes)
        start_wall, start_cpu = time.perf_counter(), self._cpu_total()
        sampler = threading.Thread(target=self._watch, args=(cost, stop), daemon=True)
        sampler.start()
        try:
            yield cost
        finally:
            stop.set()
            sampler.join()
            self._sample(cost, self._tree())
            cost.wall_s = time.perf_counter() - start_wall
            cost.cpu_s = self._cpu_total() - start_cpu

    def _watch(self, cost: Cost, stop: threading.Event) -> None:
        while not stop.wait(SAMPLE_SECONDS):
            self._sample(cost, self._tree())

    def _cpu_total(self) -> float:
        with self._lock:
            return sum(self._cpu_by_process.values())

    def _tree(self) -> list[psutil.Process]:
        """The process and those below it, by a look at all of the machine; a stage begins with those found last."""
        me = psutil.Process()
        self._processes = [me, *me.children(recursive=True)]
        return self._processes

    def _sample(self, cost: Cost, processes: list[psutil.Process]) -> None:
        """Note the CPU time so far of each process of the tree, and the memory of all of them."""
        resident, alive = 0, []
        for process in processes:
            try:
                times = process.cpu_times()
                with self._lock:
                    self._cpu_by_process[process.pid, process.create_time()] = times.user + times.system
                resident += process.memory_info().rss
                alive.append(process)
            except psutil.Error:  # it ended meanwhile: its last sample stands
                continue
        share = 1.0
        if len(alive) > 1:
            if resident > GROWTH * self._largest_rss:
                self._largest_rss, self._pss_share = resident, sum(map(_memory_bytes, alive)) / resident
            share = self._pss_share
        cost.peak_mb = max(cost.peak_mb, share * resident / 1e6)


def _memory_bytes(process: psutil.Process) -> int:
    """The proportional set size of a process, else its resident size, in bytes; 0 where it has ended."""
    try:
        with open_input(Path(f"/proc/{process.pid}/smaps_rollup")) as rollup:
            lines = (line.split() for line in rollup)
            return next(int(words[1]) * 1024 for words in lines if words[0] == b"Pss:")
    except (OSError, StopIteration):
        with suppress(psutil.Error):
            return int(process.memory_info().rss)
        return 0

"""Seconds of CPU and of the wall, the median of several calls."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple


class Times(NamedTuple):
    cpu_s: float
    wall_s: float


def timed(call: Callable[[], Any], repeats: int) -> tuple[Times, Any]:
    """The median seconds of some calls, and what the last one gave."""
    seconds = []
    for _ in range(repeats):
        cpu_s, wall_s = time.process_time(), time.monotonic()
        result = call()
        seconds.append((time.process_time() - cpu_s, time.monotonic() - wall_s))
    cpu, wall = (statistics.median(column) for column in zip(*seconds, strict=True))
    return Times(cpu, wall), result

"""Memory of a process that works through many images: freed memory is reused within a stage and returned to the system
after it, and the garbage collector runs seldom.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
from contextlib import suppress

COLLECT_AFTER = 10_000
"""Objects allocated between two garbage collections, 700 by default: imports alone make and keep hundreds of
thousands, and looking through them takes a twelfth of the time of a run of 60 frames.
"""
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Parameters of glibc's `mallopt`."""
LARGEST_KEPT, MOST_KEPT = 1 << 26, 1 << 28
"""Bytes of the largest array taken from the heap, and free bytes at the heap's end above which they are returned.
Images and what is made of them have 0.3 to 10 MB each, and a frame needs dozens. By default glibc gives them back when
twice the largest of them is free, and takes them anew, cleared, for the next frame: 4 to 6 % of the time of a run.
"""


def keep_memory() -> None:
    """Collect garbage seldom and keep freed memory from now on in this process; the latter with glibc alone.

    At exit no garbage is collected, which would go twice through all objects, most of them those of imports.
    """
    gc.set_threshold(COLLECT_AFTER)
    atexit.register(gc.freeze)
    with suppress(OSError, AttributeError, TypeError):  # another C library; Windows has no library without a name
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, LARGEST_KEPT)
        mallopt(_TRIM_THRESHOLD, MOST_KEPT)


def give_back_memory(cycles: bool) -> None:
    """Return freed memory of the heap to the system, with glibc alone; with `cycles` after a garbage collection."""
    if cycles:
        gc.collect()
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)

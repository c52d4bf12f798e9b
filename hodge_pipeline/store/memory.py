"""How a process that works through many images holds its memory: what was freed is used again within a stage and given
back after it, and cycles of objects are looked for seldom.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
from contextlib import suppress

COLLECT_AFTER = 10_000
"""Objects made and kept before cycles are looked for, 700 by default: imports alone make and keep hundreds of
thousands, and looking through them takes a twelfth of the time of a run of 60 frames.
"""
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1
"""Of glibc's `mallopt`."""
LARGEST_KEPT, MOST_KEPT = 1 << 26, 1 << 28
"""Bytes of an array that is taken from the heap, and bytes free at the heap's end from which on they are given back.
Images and what is made of them have 0.3 to 10 MB each, and a frame needs dozens. By default glibc gives them back when
twice the largest of them is free, and takes them anew, cleared, for the next frame: 4 to 6 % of the time of a run.
"""


def keep_memory() -> None:
    """Do so from now on in this process; freed memory is given back as ever where the C library is not glibc.

    At its end no cycle is looked for: all of its objects, most of them those of imports, would be gone through twice.
    """
    gc.set_threshold(COLLECT_AFTER)
    atexit.register(gc.freeze)
    with suppress(OSError, AttributeError, TypeError):  # another C library; Windows has no library without a name
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, LARGEST_KEPT)
        mallopt(_TRIM_THRESHOLD, MOST_KEPT)


def give_back_memory(cycles: bool) -> None:
    """Give back what was freed, wherever it lies in the heap, after a look for `cycles` of objects; nothing of the heap
    where the C library is not glibc.
    """
    if cycles:
        gc.collect()
    with suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)

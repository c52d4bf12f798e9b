"""RVL: the run-length code for depth images of `compressedDepth` topics (Wilson, "Fast lossless depth image
compression", ISS 2017).

A stream of nibbles, the highest of each little-endian 32-bit word first. A number is as many nibbles as it needs,
three bits each, the lowest first, the fourth bit set on all but the last. Numbers come as: zeros, non-zeros, then the
differences of that many non-zero pixels, again and again.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hodge_adapters.mcap.records import Malformed

_MAX_NIBBLES = 11


def decode_rvl(data: bytes, pixels: int) -> NDArray[np.uint16]:
    """The pixels (pixels,); raises `Malformed` for a code of more or fewer pixels."""
    numbers = _numbers(data)
    is_delta, zeros_before = _runs(numbers, pixels)
    zigzag = numbers[is_delta]
    values = np.cumsum((zigzag >> 1) ^ -(zigzag & 1))
    if len(values) and not 0 <= values.min() <= values.max() <= 0xFFFF:
        raise Malformed("an RVL code with depths that are not 16 bit")
    out = np.zeros(pixels, np.uint16)
    out[np.arange(len(values)) + zeros_before] = values
    return out


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Every number of the stream, whatever it means."""
    words = np.frombuffer(data[: len(data) // 4 * 4], np.uint8).reshape(-1, 4)[:, ::-1].reshape(-1)
    nibbles = np.stack([words >> 4, words & 15], axis=-1).reshape(-1)
    last = np.flatnonzero(nibbles < 8)
    if not len(last):
        return np.zeros(0, np.int64)
    first = np.concatenate([[0], last[:-1] + 1])
    lengths = last - first + 1
    if lengths.max() > _MAX_NIBBLES:
        raise Malformed("an RVL code with a number of more than 32 bits")
    bits = nibbles & 7
    numbers: NDArray[np.int64] = bits[first].astype(np.int64)
    # The n-th nibble of all numbers at once, of those that have one.
    for nth in range(1, int(lengths.max())):
        longer = np.flatnonzero(lengths > nth)
        numbers[longer] |= bits[first[longer] + nth].astype(np.int64) << (3 * nth)
    return numbers


def _runs(numbers: NDArray[np.int64], pixels: int) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which numbers are differences, and how many zero pixels come before each of those."""
    is_delta = np.zeros(len(numbers), bool)
    counts: list[int] = []
    zeros: list[int] = []
    at, done, total_zeros = 0, 0, 0
    while done < pixels:
        if at + 2 > len(numbers):
            raise Malformed("an RVL code that breaks off")
        zero, nonzero = int(numbers[at]), int(numbers[at + 1])
        at += 2
        done += zero + nonzero
        total_zeros += zero
        if done > pixels or at + nonzero > len(numbers):
            raise Malformed("an RVL code that breaks off or goes past the image")
        is_delta[at : at + nonzero] = True
        counts.append(nonzero)
        zeros.append(total_zeros)
        at += nonzero
    return is_delta, np.repeat(np.array(zeros, np.int64), np.array(counts, np.int64))

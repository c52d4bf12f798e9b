"""Names for the types of arrays, rows chosen from them, pixels of another size of image, root mean squares, and keys of
the cells of a lattice.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Floats32: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]
Bytes: TypeAlias = NDArray[np.uint8]
Words: TypeAlias = NDArray[np.str_]

AXIS_BITS = 21
"""Of an index of a cell: three of them fill 63 bits, and the sign stays free."""
REACH = 1 << (AXIS_BITS - 1)
"""Indices from -REACH to REACH - 1 have a key: a million cells to each side."""


def evenly(available: int, most: int) -> Ints:
    """At most so many rows (N,) of `available`, spread evenly, the first and the last among them."""
    kept = max(min(most, available), 0)
    return np.unique(np.linspace(0, available - 1, kept).round().astype(np.int64)) if kept else np.zeros(0, np.int64)


def middles_in(side: int, pixels: Ints, of_side: int) -> Ints:
    """The rows, or columns, of an image with `side` of them in which the middles of an image's `pixels` lie, which has
    `of_side` and shows the same view.
    """
    return (2 * pixels + 1) * side // (2 * of_side)


def rms(values: Floats) -> float:
    """The root mean square of all values; NaN of none."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def groups(labels: Ints) -> list[tuple[int, Ints]]:
    """The rows of each of the labels (N,), labels ascending."""
    if not len(labels):
        return []
    order = np.argsort(labels, kind="stable")
    values, begin = np.unique(labels[order], return_index=True)
    return list(zip(values.tolist(), np.split(order, begin[1:]), strict=True))


def keys_of_cells(cells: Ints) -> Ints:
    """One key (N,) for each of the cells (N, 3), whose indices are within `REACH`: these in 64 bits, in their order."""
    shifted = cells + REACH
    return np.asarray((shifted[:, 0] << 2 * AXIS_BITS) | (shifted[:, 1] << AXIS_BITS) | shifted[:, 2])


def cells_of_keys(keys: Ints) -> Ints:
    """The cells (N, 3) that have these keys (N,)."""
    mask = (1 << AXIS_BITS) - 1
    return np.stack([keys >> 2 * AXIS_BITS, (keys >> AXIS_BITS) & mask, keys & mask], axis=1) - REACH

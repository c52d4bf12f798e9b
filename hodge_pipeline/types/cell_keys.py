"""One key for each cell of a lattice: its three indices in one 64-bit number, in the order of the indices."""

import numpy as np

from hodge_pipeline.types.arrays import Ints

AXIS_BITS = 21
"""Of an index: three of them fill 63 bits, and the sign stays free."""
REACH = 1 << (AXIS_BITS - 1)
"""Indices from -REACH to REACH - 1 have a key: a million cells to each side."""


def keys_of_cells(cells: Ints) -> Ints:
    """The keys (N,) of cells (N, 3), whose indices are within `REACH`."""
    shifted = cells + REACH
    return np.asarray((shifted[:, 0] << 2 * AXIS_BITS) | (shifted[:, 1] << AXIS_BITS) | shifted[:, 2])


def cells_of_keys(keys: Ints) -> Ints:
    """The cells (N, 3) that have these keys (N,)."""
    mask = (1 << AXIS_BITS) - 1
    return np.stack([keys >> 2 * AXIS_BITS, (keys >> AXIS_BITS) & mask, keys & mask], axis=1) - REACH

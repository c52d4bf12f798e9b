"""Registers pairs of clouds in blocks, by any registrar, on any workers: the same code for an edge everywhere."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from hodge_pipeline.registry import plugin_errors
from hodge_pipeline.stages import Advance, Registrar, Workers, no_progress
from hodge_pipeline.types import CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import REGISTERED, USED

PAIRS_IN_BLOCK = 64
"""About half a second: long against sending a block, short enough to share the work and to lose little of it."""
CLOUDS_KEPT = 32
"""Prepared clouds that a worker keeps, 2 to 4 MB each."""


def register_pairs(
    folder: Path,
    registrar: Registrar,
    edges: Edges,
    guesses: Floats,
    workers: Workers,
    advance: Advance = no_progress,
    *,
    finished: Mapping[int, Edges] | None = None,
    on_block: Callable[[int, Edges], None] = lambda block, result: None,
) -> Edges:
    """The table with every pair (P, 2) registered from its guess `i_from_j (P, 4, 4)`.

    `folder` holds the clouds (`CloudSet.save`). The blocks depend on the pairs alone, so `finished` blocks of an
    earlier run can be given; `on_block` is called with each new one, to be kept. `advance` counts pairs.
    """
    order = np.lexsort((edges.pairs[:, 1], edges.pairs[:, 0]))
    pairs, guesses = edges.pairs[order], guesses[order]
    cuts = [slice(start, start + PAIRS_IN_BLOCK) for start in range(0, len(order), PAIRS_IN_BLOCK)]
    results = dict(finished or {})
    advance(sum(map(len, results.values())))
    missing = [block for block in range(len(cuts)) if block not in results]
    task = partial(_register_block, folder, registrar)
    for row, result in workers.map(task, [(pairs[cuts[block]], guesses[cuts[block]]) for block in missing]):
        block = missing[row]
        results[block] = result
        on_block(block, result)
        advance(len(result))
    found = Edges.joined([results.pop(block) for block in range(len(cuts))]).select(np.argsort(order))
    columns = {name: getattr(found, name) for name in REGISTERED}
    return replace(edges, status=np.full(len(edges), USED), **columns)


@plugin_errors()
def _register_block(folder: Path, registrar: Registrar, block: tuple[Ints, Floats]) -> Edges:
    prepared, pairs = prepared_clouds(folder, registrar), block[0]
    found = [registrar.register(prepared[i], prepared[j], guess) for (i, j), guess in zip(*block, strict=True)]
    prepared.clouds.forget()  # they stay open for the next block
    return Edges.of(pairs).with_registrations(found)


def prepared_clouds(folder: Path, registrar: Registrar) -> PreparedClouds:
    """The clouds of a folder as the registrar wants them, kept by this process from block to block."""
    written = (folder / "points.npy").stat()
    return _kept_clouds(folder, (written.st_ino, written.st_mtime_ns), cast(Hashable, registrar))


@lru_cache(maxsize=1)
def _kept_clouds(folder: Path, written: tuple[int, int], registrar: Hashable) -> PreparedClouds:
    """The prepared clouds of a folder; `written` makes the cache miss when its files are written anew."""
    return PreparedClouds(folder, cast(Registrar, registrar))


class PreparedClouds:
    """Clouds prepared when they are asked for; the last `CLOUDS_KEPT` of them are kept."""

    def __init__(self, folder: Path, registrar: Registrar) -> None:
        self.clouds, self._registrar = CloudSet.open(folder), registrar
        self._kept: OrderedDict[int, Any] = OrderedDict()

    def __getitem__(self, row: int) -> Any:
        row = int(row)
        if row not in self._kept:
            self._kept[row] = self._registrar.prepare(self.clouds[row])
            if len(self._kept) > CLOUDS_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(row)
        return self._kept[row]

"""Registers pairs of clouds in blocks, by any registrar, on any workers: the same code for an edge everywhere."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_pipeline import se3
from hodge_pipeline.registry import plugin_errors
from hodge_pipeline.stages import Advance, Registrar, Workers, no_progress
from hodge_pipeline.types import Bools, CloudSet, Edges, Floats, Ints
from hodge_pipeline.types.edges import REGISTERED, USED

PAIRS_IN_BLOCK = 64
"""About half a second: long against sending a block, short enough to share the work and to lose little of it."""
CLOUDS_KEPT = 32
"""Prepared clouds that a worker keeps, 2 to 4 MB each."""

HELD_SPREADS = 2.0
"""Times `Acceptance.min_spread`: below it noise of the normals may feign a constraint. In a bare tunnel at 16 beams,
where GICP slides by whole steps of 1.4 m, the weakest direction has 0.018 to 0.028; 95 % of pairs in a street have
0.04."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class Acceptance:
    """Which registered pairs become edges; the others are counted and listed with the reason."""

    min_fitness: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="share of cloud j with a point of cloud i nearby; below it too little holds the pair",
    )
    max_rmse_m: float | None = Field(
        default=0.06,
        gt=0,
        description="metres: RMS distance of those points; two 3 cm grids of one surface differ by 2 to 4 cm. "
        "null: any",
    )
    min_spread: float = Field(
        default=0.02,
        ge=0,
        le=0.3,
        description="share of a pair's information on translation that its weakest direction has, at most a third; "
        "below it what both see, such as a bare floor or wall, lets them slide on each other wherever the guess is "
        "wrong. 0.02: normals within 8° of each other. Consecutive frames, and all below twice that, "
        "stay at their guess in such a direction",
    )

    def reasons(self, registered: Edges, in_order: bool = True) -> NDArray[np.str_]:
        """Why each pair (P,) is rejected by itself, an empty word where it is accepted.

        Steps of frames that are `in_order` may slide: they stay at their guess.
        """
        out = np.full(len(registered.pairs), "", "U64")
        weak, _ = weak_directions(registered, self.min_spread)
        out[weak.any(axis=1) & ~(in_order & _consecutive(registered))] = "what they share lets them slide"
        if self.max_rmse_m is not None:
            out[~(registered.rmse_m <= self.max_rmse_m)] = "points too far apart"
        out[~(registered.fitness >= self.min_fitness)] = "too little overlap"
        out[registered.correspondences == 0] = "nothing in common"
        return out


def unheld_steps(edges: Edges, min_spread: float) -> Bools:
    """Where (P,) consecutive frames leave a direction of translation unconstrained, as before a bare wall."""
    weak, _ = weak_directions(edges, HELD_SPREADS * min_spread)
    return np.asarray(weak.any(axis=1) & _consecutive(edges))


def held_where_sliding(registered: Edges, guesses: Floats, min_spread: float) -> Edges:
    """The table with translations kept at their guesses `i_from_j (P, 4, 4)` along directions in which the surfaces may
    slide (solution remapping, Zhang et al., ICRA 2016).
    """
    weak, directions = weak_directions(registered, HELD_SPREADS * min_spread)
    rows = np.flatnonzero(weak.any(axis=1))
    if not len(rows):
        return registered
    twist = se3.log(se3.inverse(guesses[rows]) @ registered.i_from_j[rows])
    slid = np.einsum("nik,nk,njk,nj->ni", directions[rows], weak[rows].astype(float), directions[rows], twist[:, 3:])
    twist[:, 3:] -= slid
    iterations = np.maximum(registered.iterations[rows], 1)
    return registered.put(rows, i_from_j=guesses[rows] @ se3.exp(twist), iterations=iterations)


def weak_directions(registered: Edges, min_spread: float) -> tuple[Bools, Floats]:
    """Which directions (P, 3) hardly constrain translation, and the directions as columns (P, 3, 3), in j's axes."""
    values, vectors = np.linalg.eigh(np.nan_to_num(registered.information[:, 3:, 3:]))
    return np.asarray(np.maximum(values, 0.0) < min_spread * values.sum(axis=1, keepdims=True)), vectors


def _consecutive(registered: Edges) -> Bools:
    rank = np.searchsorted(np.unique(registered.pairs), registered.pairs)
    return np.asarray(np.abs(rank[:, 0] - rank[:, 1]) == 1)


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

"""Clouds described and matched in blocks by any global registrar, on any workers."""

from __future__ import annotations

import pickle
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from hodge_pipeline.registry import plugin_errors
from hodge_pipeline.stages import Advance, GlobalRegistrar, Workers, no_progress
from hodge_pipeline.types import Bools, CloudSet, Floats, Ints, Match
from hodge_pipeline.types.input_files import open_input

CLOUDS_IN_BLOCK = 8
PAIRS_IN_BLOCK = 24
"""About three seconds of work."""
DESCRIPTIONS_KEPT = 32
"""Described clouds that a process keeps as long as it lives, about 0.7 MB each: one is read in a hundredth of the time
that a match takes.
"""


@dataclass(frozen=True)
class Matches:
    """Matches in columns, in the order of their pairs (P, 2), each with its `others` behind it; see `Match`."""

    pairs: Ints
    i_from_j: Floats
    inliers: Ints
    rivals: Ints

    @classmethod
    def of(cls, pairs: Ints, found: Sequence[Match]) -> Matches:
        """The columns of these matches, one for each pair."""
        counts = [1 + len(one.others) for one in found]
        found = [each for one in found for each in (one, *one.others)]
        return cls(
            np.repeat(np.asarray(pairs, np.int64).reshape(-1, 2), counts, axis=0),
            np.array([one.i_from_j for one in found], float).reshape(-1, 4, 4),
            np.array([one.inliers for one in found], np.int64),
            np.array([one.rivals for one in found], np.int64),
        )

    @classmethod
    def joined(cls, parts: Sequence[Matches]) -> Matches:
        """These columns one after the other."""
        parts = [cls.of(np.zeros((0, 2), np.int64), []), *parts]
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def select(self, rows: Ints | Bools) -> Matches:
        """These rows only."""
        return Matches(*(getattr(self, field.name)[rows] for field in fields(self)))

    def __len__(self) -> int:
        return len(self.pairs)


def describe_clouds(
    clouds: Path, registrar: GlobalRegistrar, rows: Ints, out: Path, workers: Workers, advance: Advance = no_progress
) -> None:
    """Describe these rows of the clouds in a folder, each into a file of the folder `out`; `advance` counts clouds.

    What lies in `out` goes first: descriptions are pickles, and none is loaded that was not made here and now.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True, exist_ok=True)
    blocks = [rows[start : start + CLOUDS_IN_BLOCK] for start in range(0, len(rows), CLOUDS_IN_BLOCK)]
    for _, count in workers.map(partial(_describe_block, clouds, registrar, out), blocks):
        advance(count)


def match_pairs(described: Path, registrar: GlobalRegistrar, pairs: Ints, workers: Workers) -> Matches:
    """Every pair (P, 2) of the described clouds in a folder matched, in the order given."""
    cuts = [pairs[start : start + PAIRS_IN_BLOCK] for start in range(0, len(pairs), PAIRS_IN_BLOCK)]
    found = dict(workers.map(partial(_match_block, described, registrar), cuts))
    return Matches.joined([found[number] for number in range(len(cuts))])


def load_description(described: Path, row: int) -> Any:
    """The registrar's description of one cloud."""
    path = described / f"{row}.pickle"
    return _load(path, path.stat().st_mtime_ns)


@plugin_errors()
def _describe_block(clouds: Path, registrar: GlobalRegistrar, out: Path, rows: Ints) -> int:
    opened = CloudSet.open(clouds)
    for row in rows.tolist():
        with (out / f"{row}.pickle").open("wb") as file:
            pickle.dump(registrar.describe(opened[row]), file, protocol=5)
    return len(rows)


@plugin_errors()
def _match_block(described: Path, registrar: GlobalRegistrar, pairs: Ints) -> Matches:
    found = [registrar.match(load_description(described, i), load_description(described, j)) for i, j in pairs.tolist()]
    return Matches.of(pairs, found)


@lru_cache(maxsize=DESCRIPTIONS_KEPT)
def _load(path: Path, written_ns: int) -> Any:
    """The description in a file; `written_ns` makes the cache miss when another run has written it anew."""
    with open_input(path) as file:
        return pickle.load(file)

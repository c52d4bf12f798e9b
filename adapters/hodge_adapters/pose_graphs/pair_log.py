"""Pairwise estimates as 3DMatch and Redwood keep them: a `.log` of blocks `i j n` and the 4x4 motion of j into i.

Such a file is the whole input of a global registration: every pair that a matcher found, right or wrong. An information
file beside it (`gt.info`) has the same heads over 6x6 matrices of (translation, q_vec), half an angle, as in g2o.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from hodge_adapters.pose_graphs.g2o import information_of_file
from hodge_adapters.text_rows import listed
from hodge_adapters.trajectories.log import LogFile, read_blocks, read_log_file
from hodge_pipeline.errors import SourceError
from hodge_pipeline.stages import Sniff
from hodge_pipeline.types import Floats, Ints, Source, ViewGraph
from hodge_pipeline.types.input_files import beginning

INFORMATION_ALONE = "the information of pairs alone: give the .log beside it"
MAX_INFORMATION = 1e100
"""Sums of larger ones are no numbers any more."""
SNIFFED_BYTES = 4096
SPARSE = 10
"""A count of vertices beyond so many times those that edges name is no count of them: the named ones are taken."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class PairLogReader:
    """Opens a `.log` of pairwise estimates as a measured graph."""

    information: Path | Literal["beside", "none"] = Field(
        "beside",
        description="a file such as gt.info with the 6x6 information of the pairs, over (t, q_vec); beside: the .info "
        "of the same name where there is one; none: all edges count alike",
    )

    def sniff(self, path: Path) -> Sniff:
        """By the ending, and a first head `i j n` with i ≠ j: a trajectory has i = j."""
        path = Path(path)
        if path.suffix != ".log" or not path.is_file():
            return Sniff(0.0, "not a .log file", INFORMATION_ALONE if path.suffix == ".info" else "")
        lines = beginning(path, SNIFFED_BYTES).split(b"\n")
        head = next((line.split() for line in lines if line.strip()), [])
        numbers = [int(field) for field in head if field.isdigit() and len(field) < 19]
        pair = len(head) == len(numbers) == 3 and numbers[0] != numbers[1]
        return Sniff(0.9, "a .log of pairs i ≠ j") if pair else Sniff(0.0, "its first block is no pair")

    def open(self, path: Path) -> Source:
        """The pairs as a graph; the third number of each head says how many vertices there are."""
        path = Path(path)
        found = read_log_file(path)
        if not len(found.pairs):
            raise SourceError(f"{path}: no pair with i ≠ j in it: a trajectory is opened by the reader 'log'")
        notes = [f"{len(found.poses)} blocks with i = j are no pairs: left out"] if found.poses else []
        ids = _vertex_ids(found, notes)
        edges = np.searchsorted(ids, found.pairs)
        graph = ViewGraph.from_edges(ids, edges, found.i_from_j, source="pair")
        next_to = found.pairs[:, 1] - found.pairs[:, 0] == 1
        graph = replace(graph, source=np.where(next_to, "sequential", "pair"))
        beside = self._information_file(path)
        if beside is not None:
            matrices = read_information(beside)
            graph = replace(graph, information=_matched(beside, found.pairs, matrices, notes))
        files = (path,) if beside is None else (path, beside)
        contents = () if beside is None else (f"information of the pairs: {beside.name}",)
        return Source(path.stem, path, graph=graph, notes=tuple(notes), files=files, of_cameras=True, contents=contents)

    def _information_file(self, path: Path) -> Path | None:
        if isinstance(self.information, Path):
            return self.information
        beside = path.with_suffix(".info")
        return beside if self.information == "beside" and beside.is_file() else None


def read_information(path: Path) -> tuple[Ints, Floats]:
    """The pairs (N, 2) of an information file, and their matrices (N, 6, 6) over (rotation, translation).

    Raises `SourceError` with `file:line` for what is no block of `i j n` and six rows of six numbers.
    """
    heads, body, lines = read_blocks(path, 6)
    symmetric = np.isclose(body, np.swapaxes(body, 1, 2), rtol=1e-4, atol=1e-6).all(axis=(1, 2))
    good = (np.abs(body) < MAX_INFORMATION).all(axis=(1, 2)) & symmetric
    if not good.all():
        line = lines[int(np.argmin(good))]
        raise SourceError(f"{path}:{line}: not a finite symmetric 6x6 matrix: mend or remove the block")
    return heads[:, :2], information_of_file((body + np.swapaxes(body, 1, 2)) / 2)


def _vertex_ids(found: LogFile, notes: list[str]) -> Ints:
    named = np.unique(found.pairs)
    count = int(found.counts.max(initial=0))
    if named[-1] < count <= SPARSE * len(named):
        if count > len(named):
            missing = np.setdiff1d(np.arange(count), named)
            notes.append(f"{len(missing)} of {count} vertices are in no pair: {listed(missing.tolist())}")
        return np.arange(count, dtype=np.int64)
    notes.append(f"the heads tell of {count} vertices, the pairs name {len(named)} up to {named[-1]}: those are taken")
    return named


def _matched(path: Path, pairs: Ints, known: tuple[Ints, Floats], notes: list[str]) -> Floats:
    """The matrix (E, 6, 6) of each pair, whichever way round it is named; the median one where there is none."""
    heads, matrices = known
    if not len(heads):
        raise SourceError(f"{path}: holds no information matrix: name another file, or none")
    size = int(max(pairs.max(initial=0), heads.max(initial=0))) + 1
    keys, first = np.unique(heads[:, 0] * size + heads[:, 1], return_index=True)
    wanted = pairs[:, 0] * size + pairs[:, 1]
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    there = keys[place] == wanted
    usual = matrices[np.argsort(np.trace(matrices, axis1=1, axis2=2))[len(matrices) // 2]]
    if not there.all():
        missing = int((~there).sum())
        notes.append(f"{missing} of {len(pairs)} pairs are not in {path.name}: they get its median matrix")
    return np.asarray(np.where(there[:, None, None], matrices[first[place]], usual))

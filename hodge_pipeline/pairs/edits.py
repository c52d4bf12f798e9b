"""Edges that a person switched off or on or had registered, and the history of it in the run folder: `edits.json`."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.errors import GraphError, WorkspaceError
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.workspace import REFINEMENT
from hodge_pipeline.types import Bools, Ints, ViewGraph

FILE = "edits.json"
EDGES = "edges.csv"
FORMAT_VERSION = 1
ENABLED, DISABLED, REGISTERED, REJECTED = "enabled", "disabled", "registered", "rejected"


@dataclass(frozen=True)
class Edit:
    """One command: the pairs `a-b` of vertex ids that it switched off and on, and those to register; one that was
    `undone` counts no more.
    """

    disable: tuple[str, ...] = ()
    enable: tuple[str, ...] = ()
    register: tuple[str, ...] = ()
    undone: bool = False

    def __str__(self) -> str:
        parts = (("disable", self.disable), ("enable", self.enable), ("register", self.register))
        told = "; ".join(f"{verb} {', '.join(pairs)}" for verb, pairs in parts if pairs)
        return f"{told} (undone)" if self.undone else told


@dataclass(frozen=True)
class History:
    """Every edit of a run, the oldest first, the undone ones too."""

    edits: tuple[Edit, ...] = ()

    @property
    def switches(self) -> dict[str, str]:
        """What the edits come to: disabled, enabled or registered for each pair; the latest edit of a pair counts."""
        out: dict[str, str] = {}
        for edit in self.edits:
            if not edit.undone:
                out |= dict.fromkeys(edit.register, REGISTERED)
                out |= dict.fromkeys(edit.disable, DISABLED) | dict.fromkeys(edit.enable, ENABLED)
        return dict(sorted(out.items()))

    @property
    def disabled(self) -> tuple[str, ...]:
        """The pairs that are off."""
        return tuple(pair for pair, switch in self.switches.items() if switch == DISABLED)

    @property
    def enabled(self) -> tuple[str, ...]:
        """The pairs that are on by hand."""
        return tuple(pair for pair, switch in self.switches.items() if switch == ENABLED)

    @property
    def registered(self) -> tuple[str, ...]:
        """The pairs to register, those that were switched off or on later too."""
        return tuple(sorted({pair for edit in self.edits if not edit.undone for pair in edit.register}))

    def added(self, edit: Edit) -> History:
        """The history with one more edit."""
        return History((*self.edits, edit))

    def undo(self) -> History:
        """The history with the latest edit that counts taken back. Raises `GraphError` where there is none."""
        counting = [row for row, edit in enumerate(self.edits) if not edit.undone]
        if not counting:
            raise GraphError("there is no edit to undo")
        last = counting[-1]
        return History((*self.edits[:last], replace(self.edits[last], undone=True), *self.edits[last + 1 :]))


def read_history(folder: Path) -> History:
    """The edits of a run folder, none where there is no file. Raises `WorkspaceError` where it cannot be read."""
    path = folder / FILE
    if not path.exists():
        return History()
    try:
        data = artifacts.read_json(path)
        edits = tuple(_edit(item) for item in data["edits"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise WorkspaceError(f"{path}: is not a history of edits ({error}): mend it, or remove it") from error
    return History(edits)


def _edit(item: Any) -> Edit:
    if not isinstance(item, dict):
        raise ValueError("expected a mapping for each edit")
    undone = item.get("undone", False)
    names = [item.get(verb, []) for verb in ("disable", "enable", "register")]
    if not isinstance(undone, bool) or not all(
        isinstance(n, list) and all(isinstance(p, str) for p in n) for n in names
    ):
        raise ValueError("expected lists of pairs, and undone true or false")
    return Edit(tuple(names[0]), tuple(names[1]), tuple(names[2]), undone)


def write_history(folder: Path, history: History) -> None:
    """Write the edits into a run folder, atomically."""
    artifacts.write_json(
        folder / FILE, {"format_version": FORMAT_VERSION, "edits": [asdict(edit) for edit in history.edits]}
    )


@dataclass(frozen=True)
class ListedEdge:
    """A row of a run's `edges.csv`: its ends as written there, its status (used, ignored, disabled, rejected), and
    what the diagnosis says.
    """

    i: str
    j: str
    source: str
    status: str
    verdict: str = ""
    probability: str = ""

    @property
    def name(self) -> str:
        """The pair as it is written: `12-87`."""
        return f"{self.i}-{self.j}"


def listed_edges(folder: Path) -> list[ListedEdge]:
    """Every edge and rejected pair of a run. Raises `WorkspaceError` where the folder holds no finished run."""
    path = folder / EDGES
    if (folder / REFINEMENT).is_dir():
        raise WorkspaceError(
            f"{folder}: holds a refined model, of which no edge is switched: hodge diagnose {folder} judges its edges, "
            "hodge refine colmap takes other options"
        )
    if not path.is_file():
        raise WorkspaceError(f"{folder}: holds no finished run ({EDGES} is missing): run the recipe to its end first")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    try:
        return [
            ListedEdge(r["i"], r["j"], r["source"], r["status"], r.get("verdict") or "", r.get("probability") or "")
            for r in rows
        ]
    except KeyError as error:
        raise WorkspaceError(f"{path}: has no column {error}: run the same recipe again") from error


def named_edges(edges: Iterable[ListedEdge], pairs: Sequence[str]) -> list[ListedEdge]:
    """The first listed edge of each pair, given in either direction. Raises `GraphError` for a pair without one."""
    by_name: dict[str, ListedEdge] = {}
    for edge in edges:
        by_name.setdefault(edge.name, edge)
        by_name.setdefault(f"{edge.j}-{edge.i}", edge)
    for pair in pairs:
        if pair not in by_name:
            raise GraphError(f"{pair}: no edge joins these frames: give two ids of {EDGES}, as 12-87")
    return [by_name[pair] for pair in pairs]


def pairs_to_register(folder: Path, edges: Sequence[ListedEdge], pairs: Sequence[str]) -> tuple[str, ...]:
    """The pairs, named as a run's frames are, each once. Raises `GraphError` for a pair that is an edge, or no pair."""
    stored = folder / "stages" / "diagnose" / "graph.npz"
    if not stored.is_file():
        raise WorkspaceError(f"{folder}: is no run of frames: there is nothing to register")
    ids = artifacts.load_arrays(stored)["vertex_ids"]
    names = tuple(dict.fromkeys(f"{ids[i]}-{ids[j]}" for i, j in np.sort(vertex_rows(ids, pairs), axis=1)))
    joined = {frozenset((edge.i, edge.j)): edge for edge in edges if edge.status != REJECTED}
    for i, j in vertex_rows(ids, names):
        if edge := joined.get(frozenset((str(ids[i]), str(ids[j])))):
            raise GraphError(f"{edge.name}: is an edge already ({edge.source}, {edge.status})")
    return names


def joining(graph: ViewGraph, pair: str) -> Bools:
    """Where (E,) an edge joins the vertex ids `a-b`, in either direction; parallel ones all."""
    names = graph.vertex_ids[graph.edges].astype(str)
    hits = [((names == [a, b]) | (names == [b, a])).all(axis=1) for a, b in _cuts(pair)]
    return np.asarray(np.any(hits, axis=0) if hits else np.zeros(graph.edge_count, bool))


def vertex_rows(vertex_ids: NDArray[np.generic], pairs: Sequence[str]) -> Ints:
    """The rows (P, 2) of the vertices that pairs `a-b` name. Raises `GraphError` for a pair that names no two."""
    names = vertex_ids.astype(str).tolist()
    rows = {name: row for row, name in enumerate(names)}
    found = [[(rows[a], rows[b]) for a, b in _cuts(pair) if a in rows and b in rows and a != b] for pair in pairs]
    for pair, ends in zip(pairs, found, strict=True):
        if not ends:
            raise GraphError(f"{pair}: names no two frames: give two ids, as 12-87, of {names[0]} to {names[-1]}")
    return np.array([ends[0] for ends in found], np.int64).reshape(-1, 2)


def _cuts(pair: str) -> list[tuple[str, str]]:
    """Every way to read a pair, since an id may hold a hyphen."""
    return [(pair[:k], pair[k + 1 :]) for k in range(1, len(pair)) if pair[k] == "-"]

"""Edges that a person switched off or on or had registered, and the history of it in the run folder: `edits.json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hodge_pipeline.complex.checks import check_motions
from hodge_pipeline.errors import GraphError, WorkspaceError
from hodge_pipeline.store import artifacts
from hodge_pipeline.store.edge_table import read_edges
from hodge_pipeline.store.workspace import EDGES_FILE, REFINEMENT
from hodge_pipeline.types import Bools, Edges, Floats, Ints
from hodge_pipeline.types.arrays import Words
from hodge_pipeline.types.edges import DISABLED, HELD_OUT
from hodge_pipeline.types.text import command, number_of

FORMAT_VERSION = 1
ENABLED, RIGHT, REGISTERED = "enabled", "right", "registered"
VERBS = ("disable", "enable", "right", "register")
"""The fields of an edit that hold pairs, in the order in which they are told."""
Guess = tuple[str, tuple[float, ...]]
"""A pair to register, and the 16 numbers of the motion `i_from_j`, row by row, to register it from."""


@dataclass(frozen=True)
class Edit:
    """One command: the pairs `a-b` of vertex ids that it switched off and on, those that are right whatever a robust
    solver says, and those to register, some from `guesses`; one that was `undone` counts no more.
    """

    disable: tuple[str, ...] = ()
    enable: tuple[str, ...] = ()
    register: tuple[str, ...] = ()
    undone: bool = False
    right: tuple[str, ...] = ()
    guesses: tuple[Guess, ...] = ()

    def __str__(self) -> str:
        told = "; ".join(f"{verb} {', '.join(pairs)}" for verb in VERBS if (pairs := getattr(self, verb)))
        return f"{told} (undone)" if self.undone else told


@dataclass(frozen=True)
class History:
    """Every edit of a run, the oldest first, the undone ones too."""

    edits: tuple[Edit, ...] = ()

    @property
    def switches(self) -> dict[str, str]:
        """What the edits come to: disabled, enabled, right or registered for each pair; the latest edit of a pair
        counts.
        """
        out: dict[str, str] = {}
        for edit in self.edits:
            if not edit.undone:
                out |= dict.fromkeys(edit.register, REGISTERED) | dict.fromkeys(edit.disable, DISABLED)
                out |= dict.fromkeys(edit.enable, ENABLED) | dict.fromkeys(edit.right, RIGHT)
        return dict(sorted(out.items()))

    @property
    def disabled(self) -> tuple[str, ...]:
        """The pairs that are off."""
        return tuple(pair for pair, switch in self.switches.items() if switch == DISABLED)

    @property
    def enabled(self) -> tuple[str, ...]:
        """The pairs that are on by hand, the right ones among them."""
        return tuple(pair for pair, switch in self.switches.items() if switch in (ENABLED, RIGHT))

    @property
    def right(self) -> tuple[str, ...]:
        """The pairs that a robust solver may not leave out."""
        return tuple(pair for pair, switch in self.switches.items() if switch == RIGHT)

    @property
    def registered(self) -> tuple[str, ...]:
        """The pairs to register, those that were switched off or on later too."""
        return tuple(sorted({pair for edit in self.edits if not edit.undone for pair in edit.register}))

    @property
    def guesses(self) -> dict[str, Floats]:
        """The motions (4, 4) to register pairs from; the latest edit of a pair counts."""
        guesses = [guess for edit in self.edits if not edit.undone for guess in edit.guesses]
        return {pair: np.reshape(numbers, (4, 4)) for pair, numbers in guesses}

    def added(self, edit: Edit) -> History:
        """The history with one more edit."""
        return History((*self.edits, edit))

    def undo(self) -> History:
        """The history with the latest edit that counts taken back. Raises `GraphError` where there is none."""
        if (row := self.latest) is None:
            raise GraphError("there is no edit to undo")
        return self._put(row, undone=True)

    def redo(self, row: int) -> History:
        """The history with this edit, which was taken back, counting again."""
        return self._put(row, undone=False)

    @property
    def latest(self) -> int | None:
        """The row of the latest edit that counts."""
        return max((row for row, edit in enumerate(self.edits) if not edit.undone), default=None)

    def _put(self, row: int, *, undone: bool) -> History:
        return History((*self.edits[:row], replace(self.edits[row], undone=undone), *self.edits[row + 1 :]))


def read_history(path: Path) -> History:
    """The edits in a file, none where there is no file. Raises `WorkspaceError` where it cannot be read."""
    if not path.exists():
        return History()
    try:
        data = artifacts.read_json(path)
        edits = tuple(_edit(item) for item in data["edits"])
    except (OSError, ValueError, KeyError, TypeError, GraphError) as error:
        raise WorkspaceError(f"{path}: is not a history of edits ({error}): mend it, or remove it") from error
    return History(edits)


def _edit(item: Any) -> Edit:
    """One edit as JSON holds it. Raises `ValueError`, `TypeError` or `GraphError` where it is none."""
    if not isinstance(item, dict):
        raise ValueError("expected a mapping for each edit")
    undone = item.get("undone", False)
    pairs = {verb: item.get(verb, []) for verb in VERBS}
    if not isinstance(undone, bool) or not all(
        isinstance(names, list) and all(isinstance(name, str) for name in names) for names in pairs.values()
    ):
        raise ValueError("expected lists of pairs, and undone true or false")
    guesses = tuple(_guess(guess) for guess in item.get("guesses", []))
    return Edit(**{verb: tuple(names) for verb, names in pairs.items()}, undone=undone, guesses=guesses)


def _guess(item: Any) -> Guess:
    """One guess as JSON holds it. Raises `ValueError`, `TypeError` or `GraphError` where it is no rigid motion."""
    pair, numbers = item
    if not isinstance(pair, str) or len(numbers) != 16 or not np.isfinite(np.asarray(numbers, float)).all():
        raise ValueError("expected a pair and 16 finite numbers for each guess")
    check_motions(np.reshape(np.asarray(numbers, float), (1, 4, 4)), "guesses", lambda _: f"the guess of {pair}")
    return pair, tuple(map(float, numbers))


def write_history(path: Path, history: History) -> None:
    """Write the edits into a file, atomically."""
    artifacts.write_json(path, {"format_version": FORMAT_VERSION, "edits": [asdict(edit) for edit in history.edits]})


@dataclass(frozen=True)
class Listed:
    """The edges of a run with the names of its vertices, as `edges.csv` has them."""

    edges: Edges
    vertex_ids: Words

    @property
    def names(self) -> list[str]:
        """The name of each row: `12-87`."""
        return pair_names(self.vertex_ids, self.edges.pairs)

    def named(self, pairs: Sequence[str]) -> tuple[str, ...]:
        """The pairs, given in either direction, as they are listed first, each once. Raises `GraphError` for others."""
        known: dict[str, str] = {}
        for name, backwards in zip(self.names, pair_names(self.vertex_ids, self.edges.pairs[:, ::-1]), strict=True):
            known.setdefault(name, name)
            known.setdefault(backwards, name)
        found = [[known[name] for a, b in _cuts(pair) if (name := f"{a}-{b}") in known] for pair in pairs]
        for pair, names in zip(pairs, found, strict=True):
            if not names:
                raise GraphError(f"{pair}: no edge joins these frames: give two ids of {EDGES_FILE}, as 12-87")
        return tuple(dict.fromkeys(names[0] for names in found))


def listed_edges(folder: Path) -> Listed:
    """Every edge and rejected pair of a run. Raises `WorkspaceError` where the folder holds no finished run."""
    path = folder / EDGES_FILE
    if (folder / REFINEMENT).is_dir():
        raise WorkspaceError(
            f"{folder}: holds a refined model, of which no edge is switched: '{command('hodge', 'diagnose', folder)}' "
            "judges its edges, hodge refine colmap takes other options"
        )
    if not path.is_file():
        raise WorkspaceError(
            f"{folder}: holds no finished run ({EDGES_FILE} is missing): run the recipe to its end first"
        )
    edges, names = read_edges(path)
    return Listed(edges.select(edges.status != HELD_OUT), names)


def pair_names(vertex_ids: NDArray[np.generic], pairs: Ints) -> list[str]:
    """Pairs (P, 2) of rows as they are written: `12-87`."""
    return [f"{i}-{j}" for i, j in vertex_ids[pairs].tolist()]


def pairs_to_register(edges: Edges, vertex_ids: NDArray[np.generic], pairs: Sequence[str]) -> tuple[str, ...]:
    """The pairs, named as a run's frames are, each once. Raises `GraphError` for a pair that is an edge, or no pair."""
    found = np.sort(vertex_rows(vertex_ids, pairs), axis=1)
    joined = {frozenset(edges.pairs[row].tolist()): row for row in np.flatnonzero(edges.in_graph)}
    for pair in found.tolist():
        if (row := joined.get(frozenset(pair))) is not None:
            (name,) = pair_names(vertex_ids, edges.pairs[[row]])
            raise GraphError(f"{name}: is an edge already ({edges.proposed_by[row]}, {edges.status[row]})")
    return tuple(dict.fromkeys(pair_names(vertex_ids, found)))


def joining(vertex_ids: NDArray[np.generic], pairs: Ints, *named: str) -> Bools:
    """Where (P,) pairs of rows are one of those `named` by their vertex ids `a-b`, in either direction; parallel ones
    all.
    """
    names = vertex_ids[pairs].astype(str)
    hits = [((names == [a, b]) | (names == [b, a])).all(axis=1) for name in named for a, b in _cuts(name)]
    return np.asarray(np.any(hits, axis=0) if hits else np.zeros(len(pairs), bool))


def vertex_rows(vertex_ids: NDArray[np.generic], pairs: Sequence[str]) -> Ints:
    """The rows (P, 2) of the vertices that pairs `a-b` name. Raises `GraphError` for a pair that names no two."""
    names = vertex_ids.astype(str).tolist()
    rows = {name: row for row, name in enumerate(names)}
    found = [[(rows[a], rows[b]) for a, b in _cuts(pair) if a in rows and b in rows and a != b] for pair in pairs]
    for pair, ends in zip(pairs, found, strict=True):
        if not ends:
            which = f"{len(names)} from {names[0]} to {names[-1]}, of a video its key frames alone"
            raise GraphError(f"{pair}: names no two frames of the graph ({which}): give two ids, as 12-87")
    return np.array([ends[0] for ends in found], np.int64).reshape(-1, 2)


def _cuts(pair: str) -> list[tuple[str, str]]:
    """Every way to read a pair, since an id may hold a hyphen, or be named as gtsam prints it."""
    cuts = [(pair[:k], pair[k + 1 :]) for k in range(1, len(pair)) if pair[k] == "-"]
    return [*cuts, *((number_of(a), number_of(b)) for a, b in cuts)]

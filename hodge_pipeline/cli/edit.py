"""`hodge edit`: edges of a run switched off and on by hand, and what `hodge solve` does with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hodge_pipeline.diagnosis.result import SUSPECT, WRONG
from hodge_pipeline.errors import GraphError
from hodge_pipeline.pairs.edits import (
    DISABLED,
    REGISTERED,
    Edit,
    History,
    ListedEdge,
    listed_edges,
    named_edges,
    pairs_to_register,
    read_history,
    write_history,
)
from hodge_pipeline.store.workspace import holding


@dataclass(frozen=True)
class Pairs:
    """The pairs to disable, enable and register, as they were typed."""

    disable: Sequence[str]
    enable: Sequence[str]
    register: Sequence[str]

    def __bool__(self) -> bool:
        return bool(self.disable or self.enable or self.register)


def edit(folder: Path, pairs: Pairs, *, undo: bool, listing: bool, quiet: bool, as_json: bool) -> None:
    """Add to the history of edits, or take the last back, and print what the edits now come to."""
    if undo and pairs:
        raise GraphError("--undo takes the last edit back: give it alone")
    edges = listed_edges(folder)
    changed = bool(undo or pairs)
    with holding(folder):
        history = read_history(folder)
        if changed:
            history = history.undo() if undo else history.added(_checked(folder, edges, pairs))
            write_history(folder, history)
    if as_json:
        _print_json(folder, history)
    elif not quiet:
        _print(folder, history, edges, changed=changed, listing=listing or not changed)


def _checked(folder: Path, edges: Sequence[ListedEdge], pairs: Pairs) -> Edit:
    """The edit with its pairs as they are written in `edges.csv`, each once."""
    off = _named(edges, _verdicts_spelt_out(edges, _words(pairs.disable)))
    on = _named(edges, _words(pairs.enable))
    if both := set(off) & set(on):
        raise GraphError(f"{', '.join(sorted(both))}: is to be disabled and enabled at once: say one of them")
    new = pairs_to_register(folder, edges, _words(pairs.register)) if pairs.register else ()
    return Edit(off, on, new)


def _named(edges: Sequence[ListedEdge], words: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(edge.name for edge in named_edges(edges, words)))


def _verdicts_spelt_out(edges: Sequence[ListedEdge], words: Sequence[str]) -> list[str]:
    """The pairs with the word `wrong` or `suspect` as all edges of that verdict that the solver has."""
    out: list[str] = []
    for word in words:
        if word in (SUSPECT, WRONG):
            named = [edge.name for edge in edges if edge.verdict == word and edge.status != DISABLED]
            if not named:
                raise GraphError(f"{word}: no edge that counts is {word}: hodge diagnose shows the verdicts")
            out += named
        else:
            out.append(word)
    return out


def _words(pairs: Sequence[str]) -> list[str]:
    """The pairs, those of `12-87,3-40` apart."""
    return [word.strip() for pair in pairs for word in pair.split(",") if word.strip()]


def _print(folder: Path, history: History, edges: Sequence[ListedEdge], *, changed: bool, listing: bool) -> None:
    if listing:
        for number, one in enumerate(history.edits, start=1):
            print(f"{number:>3}  {one}")
        if not history.edits:
            print("no edits")
    by_name = {edge.name: edge for edge in reversed(edges)}
    for pair, switch in history.switches.items():
        print(f"{switch:<10} {pair}{_facts(by_name.get(pair), switch)}")
    if changed:
        registers = "registers, " if history.registered else ""
        print(f"next       hodge solve {folder}     ({registers}solves and fuses again)")


def _facts(edge: ListedEdge | None, switch: str) -> str:
    if edge is None:
        return "  (no edge yet)" if switch == REGISTERED else "  (not an edge of the last round)"
    words = [edge.source, edge.verdict, f"probability {float(edge.probability):.2f}" if edge.probability else ""]
    return "  (" + ", ".join(word for word in words if word) + ")"


def _print_json(folder: Path, history: History) -> None:
    from dataclasses import asdict

    from hodge_pipeline.store.artifacts import json_text

    edits = [asdict(one) for one in history.edits]
    print(json_text({"run": str(folder), "switches": history.switches, "edits": edits}), end="")

"""`hodge edit`: edges of a run switched off and on by hand, and what `hodge solve` does with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hodge_pipeline.cli.console import print_json
from hodge_pipeline.cli.options import Shown
from hodge_pipeline.diagnosis.result import SUSPECT, WRONG
from hodge_pipeline.errors import GraphError
from hodge_pipeline.pairs.edits import (
    REGISTERED,
    Edit,
    History,
    Listed,
    listed_edges,
    pair_names,
    pairs_to_register,
    read_history,
    write_history,
)
from hodge_pipeline.store.workspace import EDITS_FILE, holding
from hodge_pipeline.types import Edges
from hodge_pipeline.types.edges import DISABLED, REJECTED
from hodge_pipeline.types.text import command, with_symbols


@dataclass(frozen=True)
class Pairs:
    """The pairs to disable, enable, register and mark right, as they were typed."""

    disable: Sequence[str]
    enable: Sequence[str]
    register: Sequence[str]
    right: Sequence[str]

    def __bool__(self) -> bool:
        return bool(self.disable or self.enable or self.register or self.right)


def edit(folder: Path, pairs: Pairs, shown: Shown, *, undo: bool, listing: bool) -> None:
    """Add to the history of edits, or undo the last, and print the edits that are in force."""
    if undo and pairs:
        raise GraphError("--undo takes the last edit back: give it alone")
    listed = listed_edges(folder)
    changed = bool(undo or pairs)
    with holding(folder):
        history = read_history(folder / EDITS_FILE)
        taken_back = history.edits[history.latest] if undo and history.latest is not None else None
        if changed:
            history = history.undo() if undo else history.added(_checked(folder, listed, pairs))
            write_history(folder / EDITS_FILE, history)
    if shown.as_json:
        edits = [asdict(one) for one in history.edits]
        print_json({"run": str(folder), "switches": history.switches, "edits": edits})
    elif not shown.quiet:
        if taken_back is not None:
            print(with_symbols(f"undone     {taken_back}"))
        _print(folder, history, listed, changed=changed, listing=listing or not changed)


def _checked(folder: Path, listed: Listed, pairs: Pairs) -> Edit:
    """The edit with its pairs as they are written in `edges.csv`, each once."""
    off = listed.named(_verdicts_spelt_out(listed, _words(pairs.disable)))
    on = listed.named(_words(pairs.enable))
    right = listed.named(_words(pairs.right))
    if both := set(off) & {*on, *right}:
        raise GraphError(f"{', '.join(sorted(both))}: is to be disabled and enabled at once: say one of them")
    if not pairs.register:
        return Edit(off, on, right=right)
    from hodge_pipeline.run_folder import Run

    last = Run.load(folder).result
    return Edit(off, on, pairs_to_register(last.edges, last.vertex_ids, _words(pairs.register)), right=right)


def _verdicts_spelt_out(listed: Listed, words: Sequence[str]) -> list[str]:
    """The pairs with the word `wrong` or `suspect` as all edges of that verdict that the solver has."""
    out: list[str] = []
    for word in words:
        if word in (SUSPECT, WRONG):
            rows = np.flatnonzero((listed.edges.verdict == word) & (listed.edges.status != DISABLED))
            if not len(rows):
                raise GraphError(f"{word}: no edge that counts is {word}: hodge diagnose shows the verdicts")
            out += pair_names(listed.vertex_ids, listed.edges.pairs[rows])
        else:
            out.append(word)
    return out


def _words(pairs: Sequence[str]) -> list[str]:
    """The pairs one by one, those of `12-87,3-40` split."""
    return [word.strip() for pair in pairs for word in pair.split(",") if word.strip()]


def _print(folder: Path, history: History, listed: Listed, *, changed: bool, listing: bool) -> None:
    if listing:
        for number, one in enumerate(history.edits, start=1):
            print(with_symbols(f"{number:>3}  {one}"))
        if not history.edits:
            print("no edits")
    by_name = {name: row for row, name in reversed(list(enumerate(listed.names)))}
    for pair, switch in history.switches.items():
        print(with_symbols(f"{switch:<10} {pair}{_facts(listed.edges, by_name.get(pair), switch)}"))
    if changed:
        registers = "registers, " if history.registered else ""
        print(f"next       {command('hodge', 'solve', folder)}     ({registers}solves and fuses again)")


def _facts(edges: Edges, row: int | None, switch: str) -> str:
    """What is known of an edge, in brackets; None: a pair without one."""
    if row is None:
        return "  (no edge yet)" if switch == REGISTERED else "  (not an edge of the last round)"
    probability = float(edges.probability[row])
    right = f"probability {probability:.2f}" if np.isfinite(probability) else ""
    why = edges.why[row] if edges.status[row] == REJECTED else ""
    return "  (" + ", ".join(word for word in (edges.proposed_by[row], why, edges.verdict[row], right) if word) + ")"

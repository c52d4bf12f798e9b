"""`hodge edit`: edges of a run switched off and on by hand, and what `hodge solve` does with it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from hodge_pipeline.edits import Edit, History, ListedEdge, listed_edges, named_edges, read_history, write_history
from hodge_pipeline.errors import GraphError
from hodge_pipeline.workspace import holding


def edit(
    folder: Path,
    disable: Sequence[str],
    enable: Sequence[str],
    *,
    undo: bool,
    listing: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Add to the history of edits, or take the last back, and print what the edits now come to."""
    if undo and (disable or enable):
        raise GraphError("--undo takes the last edit back: give it alone")
    edges = listed_edges(folder)
    changed = bool(undo or disable or enable)
    with holding(folder):
        history = read_history(folder)
        if changed:
            history = history.undo() if undo else history.added(_checked(edges, disable, enable))
            write_history(folder, history)
    if as_json:
        _print_json(folder, history)
    elif not quiet:
        _print(folder, history, edges, changed=changed, listing=listing or not changed)


def _checked(edges: Sequence[ListedEdge], disable: Sequence[str], enable: Sequence[str]) -> Edit:
    """The edit with its pairs as they are written in `edges.csv`, each once."""
    off, on = (
        tuple(dict.fromkeys(edge.name for edge in named_edges(edges, _words(pairs)))) for pairs in (disable, enable)
    )
    if both := set(off) & set(on):
        raise GraphError(f"{', '.join(sorted(both))}: is to be disabled and enabled at once: say one of them")
    return Edit(off, on)


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
        print(f"{switch:<9} {pair}{_facts(by_name.get(pair))}")
    if changed:
        print(f"next      hodge solve {folder}     (solves and fuses again)")


def _facts(edge: ListedEdge | None) -> str:
    if edge is None:
        return "  (not an edge of the last round)"
    words = [edge.source, edge.verdict, f"probability {float(edge.probability):.2f}" if edge.probability else ""]
    return "  (" + ", ".join(word for word in words if word) + ")"


def _print_json(folder: Path, history: History) -> None:
    from dataclasses import asdict

    from hodge_pipeline.artifacts import json_text

    edits = [asdict(one) for one in history.edits]
    print(json_text({"run": str(folder), "switches": history.switches, "edits": edits}), end="")

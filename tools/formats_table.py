"""Writes the table of `docs/formats.md` by opening every file of a folder: `python tools/formats_table.py DATA`."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from hodge_pipeline.errors import HodgeError
from hodge_pipeline.sources import inspect as inspection
from hodge_pipeline.types.text import counted

OPENED_WHOLE = 0.6
"""A folder that a reader is so sure of is opened as one; its files are its own."""

TEXT_FOR_PEOPLE = (".md", ".rtf")
OTHER = {
    ".txt": "lists, stamps, landmarks or splits, read with what they belong to or of another kind",
    ".jpg": "images on their own",
    ".JPG": "images on their own",
    ".png": "images on their own",
    ".info": "information of pairs: read with the `.log` of the same name",
    ".npy": "Open3D's control grid",
    ".mat": "MATLAB; the model beside it is read",
    ".xz": "packed: unpack it, then give the folder",
    ".yaml": "read with the recording or images that it belongs to",
}


def rows(data: Path) -> list[tuple[str, str, str]]:
    """(path, reader, what came out) for every folder that is a format, and every other file."""
    found: list[tuple[str, str, str]] = []
    _visit(data, data, found)
    return found


def _visit(data: Path, folder: Path, found: list[tuple[str, str, str]]) -> None:
    taken: set[Path] = set()
    best = inspection.guesses(folder) if folder != data else []
    if best and best[0].sniff.confidence >= OPENED_WHOLE:
        name, result, files = _open(data, folder, best[0].name)
        found.append((f"{folder.relative_to(data)}/", name, result))
        taken = files
    loose: Counter[str] = Counter()
    for path in sorted(folder.iterdir()):
        if path.suffix in TEXT_FOR_PEOPLE:
            continue
        if path.is_dir():
            if not any(file.is_relative_to(path) for file in taken):
                _visit(data, path, found)
            else:
                for file in sorted(path.rglob("*")):
                    if file.is_file() and file.resolve() not in taken:
                        _file(data, file, found, loose)
        elif path.resolve() not in taken:
            _file(data, path, found, loose)
    for ending, count in sorted(loose.items()):
        found.append(
            (
                f"{folder.relative_to(data)}/*{ending}",
                "none",
                f"{count} file{'s' if count > 1 else ''}: {OTHER.get(ending, 'no reader')}",
            )
        )


def _file(data: Path, path: Path, found: list[tuple[str, str, str]], loose: Counter[str]) -> None:
    best = inspection.guesses(path)
    if not best:
        loose[path.suffix] += 1
        return
    name, result, _ = _open(data, path, best[0].name)
    found.append((str(path.relative_to(data)), name, result))


def _open(data: Path, path: Path, name: str) -> tuple[str, str, set[Path]]:
    try:
        source = inspection.guess_reader(path).open(path)
    except HodgeError as error:
        reason = str(error).replace(f"{data}/", "").removeprefix(f"{path.relative_to(data)}: ")
        own = {file.resolve() for file in path.rglob("*") if file.is_file()} if path.is_dir() else {path.resolve()}
        return name, f"refused: {reason}", own
    parts = []
    if source.frames:
        parts.append(counted(len(source.frames), "frame"))
    if source.trajectory is not None:
        parts.append(counted(len(source.trajectory), "pose"))
    if source.graph is not None:
        edges = counted(source.graph.edge_count, "edge")
        parts.append(f"{counted(source.graph.vertex_count, 'vertex|vertices')}, {edges}")
    return name, ", ".join(parts), {file.resolve() for file in source.files}


def main() -> None:
    """Print the table."""
    data = Path(sys.argv[1])
    print("| path | reader | what came out |\n|---|---|---|")
    for path, name, result in rows(data):
        print(f"| {path} | {name} | {result.replace('|', '/')} |")


if __name__ == "__main__":
    main()

"""Lines of the pose-graph text formats: a tag, integer keys, numbers. Parsed in columns, a million lines in seconds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from hodge_adapters.text_rows import reading
from hodge_pipeline import se3
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types import Bools, Floats, Ints
from hodge_pipeline.types.input_files import beginning, read_input

SNIFFED_LINES, SNIFFED_BYTES = 20, 1 << 16
Columns = Mapping[str, tuple[int, ...] | None]
"""How many numbers may follow the keys of a tag; None: those that follow are more keys."""


@dataclass(frozen=True)
class Records:
    """All lines of one tag: `keys (N, k)`, `values (N, c)`, and where they stood, for messages."""

    path: Path
    line_numbers: Ints
    keys: Ints
    values: Floats

    def __len__(self) -> int:
        return len(self.keys)

    def refuse(self, wrong: Bools, why: str) -> None:
        """Raise `SourceError` for the first line that is wrong."""
        if wrong.any():
            raise SourceError(f"{self.path}:{self.line_numbers[np.argmax(wrong)]}: {why}")

    def refuse_repeated(self, what: str) -> None:
        """Raise `SourceError` for the first line whose first key an earlier line has."""
        repeated = np.ones(len(self), bool)
        repeated[np.unique(self.keys[:, 0], return_index=True)[1]] = False
        if repeated.any():
            self.refuse(repeated, f"{what} {self.keys[np.argmax(repeated), 0]} is given twice: remove one of its lines")


LANDMARK_TAGS = frozenset(
    ("LANDMARK", "POINT2", "POINT3", "VERTEX_XY", "VERTEX_TRACKXYZ", "VERTEX_POINT_XYZ")
    + ("EDGE_SE2_XY", "EDGE_BEARING_SE2_XY", "EDGE_SE3_TRACKXYZ", "EDGE_SE3_XYZ", "EDGE_SE2_POINT_XY")
)
"""Landmarks and their measurements, of iSAM, TORO and g2o: known, but only edges between poses are solved."""


def count_tags(path: Path) -> Counter[str]:
    """How often each first word occurs in the first lines; empty where the path is no readable text."""
    try:
        lines = _text(beginning(Path(path), SNIFFED_BYTES)).split("\n")[:SNIFFED_LINES]
    except ValueError:
        return Counter()
    return Counter(line.split(None, 1)[0] for line in lines if line.strip() and not line.startswith("#"))


def read_records(
    path: Path, keys: Mapping[str, int], columns: Columns, other_names: Mapping[str, str] = MappingProxyType({})
) -> tuple[dict[str, Records], dict[str, int]]:
    """The records of each known tag (all tags present, empty where the file has none) and counts of other tags.

    A tag that is among the `other_names` is read as the one it stands for.
    """
    with reading(path):
        contents = read_input(path)
    try:
        text = _text(contents)
    except ValueError as error:
        raise SourceError(f"{path}: cannot be read as text ({error}): expected a pose-graph file") from error
    numbers: dict[str, list[int]] = {tag: [] for tag in keys}
    rests: dict[str, list[str]] = {tag: [] for tag in keys}
    other: Counter[str] = Counter()
    has_comments = "#" in text
    for number, line in enumerate(text.split("\n"), 1):
        parts = (line.partition("#")[0] if has_comments else line).split(None, 1)
        if not parts:
            continue
        tag = other_names.get(parts[0], parts[0])
        if tag in numbers:
            numbers[tag].append(number)
            rests[tag].append(parts[1] if len(parts) > 1 else "")
        else:
            other[tag] += 1
    records = {tag: _parse(path, tag, numbers[tag], rests[tag], keys[tag], columns[tag]) for tag in keys}
    return records, dict(other)


def _text(contents: bytes) -> str:
    """The text, whatever its comments are encoded in and its lines end in; raises `ValueError` for what is none."""
    if b"\0" in contents:
        raise ValueError("it has zero bytes")
    return contents.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n").decode("latin-1")


def _parse(
    path: Path, tag: str, numbers: list[int], rests: list[str], keys: int, columns: tuple[int, ...] | None
) -> Records:
    if columns is None:
        fixed = [(number, key) for number, rest in zip(numbers, rests, strict=True) for key in rest.split()]
        lines = np.array([number for number, _ in fixed], np.int64)
        ints = _integers(path, tag, [number for number, _ in fixed], [[key] for _, key in fixed])
        return Records(path, lines, ints, np.zeros((len(fixed), 0)))
    split = [rest.split(None, keys) for rest in rests]
    for number, parts in zip(numbers, split, strict=True):
        if len(parts) != keys + (columns[0] > 0):
            raise SourceError(f"{path}:{number}: {tag} needs {keys} ids and {columns[0]} numbers")
    ints = _integers(path, tag, numbers, [parts[:keys] for parts in split], keys)
    if columns == (0,):
        return Records(path, np.array(numbers, np.int64), ints, np.zeros((len(numbers), 0)))
    values = _numbers(path, tag, numbers, [parts[keys] for parts in split], columns)
    records = Records(path, np.array(numbers, np.int64), ints, values)
    with np.errstate(invalid="ignore"):
        absurd = np.asarray(~(np.abs(values[:, : columns[0]]) < se3.MAX_NUMBER).all(axis=1))
    records.refuse(absurd, f"{tag} holds a nan, or a number past {se3.MAX_NUMBER:g}: remove or mend that line")
    return records


def _integers(path: Path, tag: str, numbers: Sequence[int], keys: list[list[str]], width: int = 1) -> Ints:
    try:
        flat = np.fromiter((int(key) for row in keys for key in row), np.int64, count=width * len(keys))
    except (ValueError, OverflowError):
        words = ((number, key) for number, row in zip(numbers, keys, strict=True) for key in row)
        number, key = next(word for word in words if not _is(np.int64, word[1]))
        raise SourceError(f"{path}:{number}: {key!r} is no id of {tag}: give a whole number of 64 bits") from None
    return flat.reshape(-1, width)


def _is(kind: type[np.int64] | type[float], word: str) -> bool:
    try:
        kind(word)
    except (ValueError, OverflowError):
        return False
    return True


def _numbers(path: Path, tag: str, numbers: list[int], rests: list[str], columns: tuple[int, ...]) -> Floats:
    if not rests:
        return np.zeros((0, columns[0]))
    try:
        values = np.loadtxt(rests, ndmin=2, comments=None)
    except ValueError:
        values = None
    if values is None or values.shape[1] not in columns:
        raise _first_malformed(path, tag, numbers, rests, columns)
    return values


def _first_malformed(
    path: Path, tag: str, numbers: list[int], rests: list[str], columns: tuple[int, ...]
) -> SourceError:
    """The error of the first line whose numbers are too few, too many, or no numbers."""
    wanted = len(rests[0].split()) if len(rests[0].split()) in columns else columns[0]
    for number, rest in zip(numbers, rests, strict=True):
        words = rest.split()
        if len(words) != wanted:
            return SourceError(f"{path}:{number}: {tag} needs {wanted} numbers after its ids, has {len(words)}")
        for word in words:
            if not _is(float, word):
                return SourceError(f"{path}:{number}: {word!r} is no number")
    return SourceError(f"{path}: the {tag} lines cannot be parsed")


def write_lines(lines: list[str], tag: str, keys: Ints, values: Floats) -> None:
    """Append one line for each row: the tag, its keys, its numbers in the fewest digits that give the same float64."""
    for row_keys, row in zip(keys.tolist(), values.tolist(), strict=True):
        lines.append(" ".join([tag, *map(str, row_keys), *map(repr, row)]))

"""Text of unknown origin made safe for terminals, logs, shells and spreadsheets; counts, tables and file names."""

from __future__ import annotations

import csv
import io
import re
import shlex
from collections.abc import Iterable, Sequence

_UNSEEN = "\x00-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u2069\ud800-\udfff\ufeff\ufff9-\ufffb"
_ONE_LINE, _LINES = re.compile(f"[{_UNSEEN}]"), re.compile(f"(?![\n\t])[{_UNSEEN}]")
_FORMULA = re.compile(r"['=+\-@\t\r]")
_NO_STEM = re.compile(r"[^\w.+-]+")
_NUMBER = re.compile(r"[4-8][0-9]{18}(?<![\d.][0-9]{19})(?!\d)")  # looks back last: a page has a million characters
_SYMBOL = re.compile(r"[A-Za-z](0|[1-9]\d{0,8})")
SYMBOLS = 1 << 56
"""Symbols of one letter."""
UNKNOWN_UNIT = "units"
"""The unit of lengths where nothing tells the scale."""
MAX_STEM = 100
"""Characters: with a beginning and an ending they stay below the 255 bytes that file systems allow."""


def visible(text: object, *, lines: bool = False) -> str:
    r"""The text on one line, with each control, hiding or direction character as an escape such as `\x1b`.

    With `lines` line ends and tabs stay.
    """
    return (_LINES if lines else _ONE_LINE).sub(lambda found: ascii(found[0])[1:-1], str(text))


def in_unit(sentence: str, has_metres: bool) -> str:
    """A sentence of a diagnosis, with its metres renamed where the unit of lengths is unknown."""
    return sentence if has_metres else re.sub(r"(?<=\d) m\b", f" {UNKNOWN_UNIT}", sentence)


def with_symbols(text: str) -> str:
    """The text with each number that is one of gtsam's Symbols written as gtsam prints it: `a12`.

    A Symbol has a letter in the upper 8 of 64 bits and an index in the others.
    """
    return _NUMBER.sub(_symbol, text)


def _symbol(found: re.Match[str]) -> str:
    letter, index = divmod(int(found[0]), SYMBOLS)
    return f"{chr(letter)}{index}" if _SYMBOL.fullmatch(f"{chr(letter)}{index}") else found[0]


def number_of(name: str) -> str:
    """The number of a vertex that is named as `with_symbols` does; any other name as it is."""
    return str(ord(name[0]) * SYMBOLS + int(name[1:])) if _SYMBOL.fullmatch(name) else name


def counted(count: int, words: str) -> str:
    """A count with its noun: `1 image`, `2 images`; of `frame has|frames have` the side that suits the count."""
    return f"{count} {suiting(count, words)}"


def suiting(count: int, words: str) -> str:
    """The side of `is|are` that suits the count; of a noun alone its singular, or its plural with an s."""
    one, _, many = words.partition("|")
    return one if count == 1 else many or f"{one}s"


def command(*words: object) -> str:
    """The words as a shell takes them, to be copied from a page."""
    return shlex.join(map(str, words))


def cell(text: str) -> str:
    """The text as a cell of a spreadsheet: one that it would take for a formula gets a leading `'`."""
    return f"'{text}" if _FORMULA.match(text) else text


def cell_text(text: str) -> str:
    """The text that `cell` was given."""
    return text[1:] if _FORMULA.match(text[1:2]) and text.startswith("'") else text


def csv_text(rows: Iterable[Iterable[object]], *, quoted: bool = False) -> str:
    """The rows as CSV; `quoted`: every cell is. Words of unknown origin must come from `cell`."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n", quoting=csv.QUOTE_ALL if quoted else csv.QUOTE_MINIMAL).writerows(rows)
    return text.getvalue()


def markdown_table(header: Sequence[str], rows: Iterable[Iterable[object]], names: int | None = None) -> str:
    """The rows as a Markdown table; the first `names` columns (None: all) hold words, the others numbers."""
    words = len(header) if names is None else names
    align = ["---" if column < words else "---:" for column in range(len(header))]
    cells = ([str(cell).replace("|", "\\|") for cell in row] for row in (header, align, *rows))
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def file_stems(names: list[str]) -> list[str]:
    """A file name without folders for each name, all different even where case does not count."""
    stems: list[str] = []
    for name in names:
        stem = wanted = _NO_STEM.sub("_", name)[:MAX_STEM]
        number = 2
        while stem.casefold() in {other.casefold() for other in stems}:
            stem, number = f"{wanted}-{number}", number + 1
        stems.append(stem)
    return stems

"""Streams that escape control characters: names of unknown origin must not move the cursor, colour or hide text."""

from __future__ import annotations

import sys
from typing import Any, TextIO

LONGEST_ERROR = 1000
"""Characters: longer errors quote a name or a value that no person wrote."""


class Guarded:
    """A stream that shows control characters instead of sending them."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write the text, `visible`."""
        return self.stream.write(shown(text, lines=True))

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def guard_streams() -> None:
    """Guard stdout and stderr from now on; what draws colours and bars takes the `unguarded` stream."""
    sys.stdout, sys.stderr = Guarded(sys.stdout), Guarded(sys.stderr)


def unguarded(stream: TextIO) -> TextIO:
    """The stream itself, for code that draws and escapes texts by itself."""
    return stream.stream if isinstance(stream, Guarded) else stream


def shown_error(error: object) -> str:
    """An error in one line; of a long one the beginning and the end."""
    from hodge_pipeline.types.text import with_symbols

    text = with_symbols(str(error))
    cut = text if len(text) <= LONGEST_ERROR else f"{text[: LONGEST_ERROR // 2]} … {text[-LONGEST_ERROR // 2 :]}"
    return shown(cut)


def shown(text: str, *, lines: bool = False) -> str:
    """The text as `visible` escapes it, whose import is avoided for plain text: most commands print nothing else."""
    if text.replace("\n", "").isprintable() and (lines or "\n" not in text):
        return text
    from hodge_pipeline.types.text import visible

    return visible(text, lines=lines)

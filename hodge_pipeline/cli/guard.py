"""What is printed is shown: names that strangers wrote move no cursor, colour nothing and hide nothing."""

from __future__ import annotations

import sys
from typing import Any, TextIO

LONGEST_ERROR = 1000
"""Characters: longer ones quote a name or a value that no person wrote."""


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
    """Let what is printed from now on be shown; what draws colours and bars takes the `unguarded` stream."""
    sys.stdout, sys.stderr = Guarded(sys.stdout), Guarded(sys.stderr)


def unguarded(stream: TextIO) -> TextIO:
    """The stream for what moves the cursor by right, and shows its own texts."""
    return stream.stream if isinstance(stream, Guarded) else stream


def shown_error(error: object) -> str:
    """An error in one line that can be read: of what it quotes at length the beginning and the end."""
    from hodge_pipeline.types.text import with_symbols

    text = with_symbols(str(error))
    cut = text if len(text) <= LONGEST_ERROR else f"{text[: LONGEST_ERROR // 2]} … {text[-LONGEST_ERROR // 2 :]}"
    return shown(cut)


def shown(text: str, *, lines: bool = False) -> str:
    """The text as `visible` has it, which is imported where it is needed alone: most commands print plain words."""
    if text.replace("\n", "").isprintable() and (lines or "\n" not in text):
        return text
    from hodge_pipeline.types.text import visible

    return visible(text, lines=lines)

"""A file of logged messages, whatever its format: which messages are wanted, how many there are of each topic."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, NamedTuple

from mcap.records import Channel, Schema

from hodge_adapters.mcap.records import (
    MAX_CHUNK_BYTES,
    MAX_MESSAGE_BYTES,
    Chunk,
    Malformed,
    Place,
    ReadAt,
    expand,
    read_at,
)
from hodge_adapters.text_rows import reading
from hodge_pipeline.errors import SourceError
from hodge_pipeline.types.input_files import open_input
from hodge_pipeline.types.text import counted

MAX_EXPANSION, ALWAYS_EXPANDED_BYTES = 200, 1 << 31
"""Images and scans shrink to a half or a tenth: the chunks of a file together expand to no more, and 2 GiB."""

MAX_KINDS = 30
"""How many kinds of fault have a line of their own: damage can make up as many as there are messages."""


class Complaints:
    """Counts faults while a recording is read, so that a million bad messages make one line of `notes`."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lines: list[str] = []
        self._others = 0
        self.damaged: set[Path] = set()
        """The files that are cut off or damaged, so that messages are lost."""

    def loses(self, path: Path, line: str) -> None:
        """Report that a file lost messages."""
        self.damaged.add(path)
        self.say(line)

    def count(self, where: str, what: str) -> None:
        """Count one fault `what` ("a message that …") of a topic or file."""
        if (where, what) in self._counts or len(self._counts) < MAX_KINDS:
            self._counts[where, what] += 1
        else:
            self._others += 1

    def say(self, line: str) -> None:
        """Report something once."""
        if line in self._lines:
            return
        if len(self._lines) < MAX_KINDS:
            self._lines.append(line)
        else:
            self._others += 1

    def counted(self, fault: str | None = None) -> list[str]:
        """The counts in the order of their first fault, those of one `fault` alone where it is given."""
        kinds = [(kind, count) for kind, count in self._counts.items() if fault in (None, kind[1])]
        return [f"{where}: {count} left out: {what}" for (where, what), count in kinds]

    def notes(self) -> list[str]:
        """All that was said, then the counts."""
        others = [f"{self._others} other faults of many kinds"] if self._others else []
        return [*self._lines, *self.counted(), *others]


class Logged(NamedTuple):
    """One message as logged: `place` is where `data` lies, to read it again."""

    channel: Channel
    schema: Schema | None
    log_time_ns: int
    data: bytes
    place: Place


@dataclass
class Tally:
    """How many messages of a topic were logged, wanted or not, and when the first and the last."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def add(self, log_time_ns: int) -> None:
        """One message more."""
        self.first_ns = min(self.first_ns, log_time_ns) if self.count else log_time_ns
        self.last_ns = max(self.last_ns, log_time_ns)
        self.count += 1

    def __str__(self) -> str:
        span_s = (self.last_ns - self.first_ns) * 1e-9
        return counted(self.count, "message") + (f", {(self.count - 1) / span_s:.3g} a second" if span_s > 0 else "")


Wanted = Callable[[Channel, Schema | None], bool]


@dataclass
class MessageFile(ABC):
    """One file while it is read. Iterate `messages` once."""

    path: Path
    wanted: Wanted
    complaints: Complaints
    tallies: dict[str, Tally] = field(default_factory=dict)
    _is_wanted: dict[int, bool] = field(default_factory=dict)
    _of_use: Tally = field(default_factory=Tally)
    _expansion_left: int = 0

    def messages(self) -> Iterator[Logged]:
        """The wanted messages. Raises `SourceError` for a file of another format; all else is complained of."""
        with reading(self.path), open_input(self.path) as file:
            yield from self._messages(file)

    @abstractmethod
    def _messages(self, file: IO[bytes]) -> Iterator[Logged]:
        """The wanted messages of the file."""

    def begun(self, file: IO[bytes], magic: bytes, kind: str) -> tuple[ReadAt, int]:
        """A function that reads from the file, and the file's size. Raises `SourceError` where `magic` is missing."""
        read, size = read_at(file), os.fstat(file.fileno()).st_size
        if read(0, len(magic)) != magic:
            raise SourceError(f"{self.path}: does not start as {kind}: record or copy it again")
        self._expansion_left = ALWAYS_EXPANDED_BYTES + MAX_EXPANSION * size
        return read, size

    def expanded(self, read: ReadAt, chunk: Chunk) -> bytes:
        """The contents of a compressed chunk. Raises `Malformed`, also where all chunks together expand to too much."""
        size = chunk.uncompressed_bytes
        if max(size, chunk.length) > MAX_CHUNK_BYTES or size > self._expansion_left:
            raise Malformed("a chunk past what a file of this size may expand to")
        self._expansion_left -= size
        return expand(read, chunk, size)

    def read_so_far(self) -> str:
        """In words, how many wanted messages were read so far, for the note on a file that ends too early."""
        used = self._of_use
        if not used.count:
            return "no message of use"
        return f"{counted(used.count, 'message')} of use, logged within {(used.last_ns - used.first_ns) * 1e-9:.3f} s"

    def offered(
        self, channel: Channel, schema: Schema | None, log_time_ns: int, place: Place, read: Callable[[], bytes]
    ) -> Iterator[Logged]:
        """The message at a place, if its channel is wanted; `read` gives its bytes."""
        self.tallies.setdefault(channel.topic, Tally()).add(log_time_ns)
        if channel.id not in self._is_wanted:
            self._is_wanted[channel.id] = self.wanted(channel, schema)
        if not self._is_wanted[channel.id]:
            return
        if place.length > MAX_MESSAGE_BYTES:
            self.complaints.count(channel.topic, f"a message of more than {MAX_MESSAGE_BYTES} bytes")
            return
        self._of_use.add(log_time_ns)
        yield Logged(channel, schema, log_time_ns, read(), place)

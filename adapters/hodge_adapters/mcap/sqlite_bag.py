"""ROS 2 bags in SQLite (`.db3`): the messages in the order of recording."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO

from mcap.records import Channel, Schema

from hodge_adapters.mcap.message_file import Logged, MessageFile
from hodge_adapters.mcap.records import MAX_MESSAGE_BYTES, Malformed, Place
from hodge_adapters.mcap.ros_definitions import definition
from hodge_adapters.sqlite_file import DAMAGED, opened_database
from hodge_pipeline.errors import SourceError

TABLES = ("topics", "messages", "message_definitions")


@dataclass
class SqliteBag(MessageFile):
    """One `.db3` file while it is read. Definitions are the standard ones where the file, as those of before ROS 2
    Iron, has none.
    """

    def _messages(self, file: IO[bytes]) -> Iterator[Logged]:
        wal = Path(f"{self.path}-wal")
        if wal.is_file() and wal.stat().st_size:
            self.complaints.say(f"{wal.name}: messages in it left out: `ros2 bag info` of the folder takes them over")
        try:
            with opened_database(self.path, TABLES, MAX_MESSAGE_BYTES) as database:
                yield from self._rows(database)
        except DAMAGED as error:
            if not self.tallies:
                raise SourceError(f"{self.path}: not a whole SQLite bag ({error}): record or copy it again") from error
            self.complaints.loses(self.path, f"{self.path.name}: damaged ({error}): {self.read_so_far()}")

    def _rows(self, database: sqlite3.Connection) -> Iterator[Logged]:
        channels = self._channels(database)
        for row, topic_id, time_ns, length in database.execute(
            "SELECT id, topic_id, timestamp, length(data) FROM messages ORDER BY id"
        ):
            if topic_id not in channels or not all(isinstance(value, int) for value in (row, time_ns, length)):
                self.complaints.count(self.path.name, "a message of a topic that the file does not define")
                continue
            channel, schema = channels[topic_id]
            place = Place(0, length, row=row)
            try:
                yield from self.offered(channel, schema, time_ns, place, partial(_bytes, database, row))
            except Malformed as error:
                self.complaints.count(channel.topic, str(error))

    def _channels(self, database: sqlite3.Connection) -> dict[int, tuple[Channel, Schema | None]]:
        texts = self._definitions(database)
        found: dict[int, tuple[Channel, Schema | None]] = {}
        for number, topic, name, encoding in database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            text = texts.get(name) or definition(str(name))
            schema = Schema(int(number), text.encode(), "ros2msg" if text else "", str(name))
            found[int(number)] = Channel(int(number), str(topic), str(encoding), {}, int(number)), schema
        return found

    def _definitions(self, database: sqlite3.Connection) -> dict[str, str]:
        """The definitions in the file by type: text that describes bytes; nothing of them is executed."""
        if not database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchall():
            return {}
        query = "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
        return {str(name): str(text) for name, text in database.execute(query)}


def _bytes(database: sqlite3.Connection, row: int) -> bytes:
    found = database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
    if found is None or not isinstance(found[0], bytes):
        raise Malformed("a message that is no bytes")
    return found[0]

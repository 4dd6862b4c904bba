"""Copies of ROS 2 bags with other messages."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys.store import Typestore


@dataclass
class BagCopy:
    """A bag that is read, and one that is written.

    Attributes:
        store: types of the messages that are added.
    """

    store: Typestore
    _reader: Reader
    _writer: Writer
    _kept: list[Connection]
    _to: dict[str, Connection] = field(default_factory=dict)

    def messages(self) -> Iterator[tuple[Connection, int, bytes]]:
        """Connection, stamp of the recording (ns) and content of each message of the old bag."""
        return self._reader.messages(connections=self._kept)

    def topic(self, name: str, kind: str) -> None:
        """Opens a topic of the new bag."""
        if name not in self._to:
            self._to[name] = self._writer.add_connection(name, kind, typestore=self.store)

    def write(self, topic: str, stamp_ns: int, content: Any) -> None:
        """Writes a message of a topic that is open."""
        self._writer.write(self._to[topic], stamp_ns, content)


@contextmanager
def copied(
    source: Path, target: Path, store: Typestore, without: Collection[str] = ()
) -> Iterator[BagCopy]:
    """A copy of a bag, its topics open but for those `without`, its messages to be written."""
    with (
        Reader(source) as reader,
        Writer(target, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        kept = [c for c in reader.connections if c.topic not in without]
        copy = BagCopy(store, reader, writer, kept)
        for connection in kept:
            copy.topic(connection.topic, connection.msgtype)
        yield copy

"""Readers of bags: the package rosbags, and an own reader for RealSense's newer recordings, a single database."""

from __future__ import annotations

import os
import sqlite3
import weakref
from collections.abc import Collection, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import FileFormatError

_REPAIRS = {
    ".bag": "rosbag reindex {0}",
    ".mcap": "mcap recover {0} --output repaired.mcap",
    ".db3": "sqlite3 {0} .recover | sqlite3 repaired.db3",
}  # commands that repair a truncated bag, by suffix


@dataclass(frozen=True)
class Topic:
    """A topic of a database."""

    number: int
    topic: str
    msgtype: str


class Database:
    """A ROS 2 bag's database without its ``metadata.yaml``, with the interface of rosbags' reader that is used here."""

    def __init__(self, connection: sqlite3.Connection):
        from rosbags.typesys import Stores, get_typestore

        self._connection = connection
        self._types = get_typestore(Stores.ROS2_HUMBLE)
        found = connection.execute("SELECT id, name, type FROM topics ORDER BY id").fetchall()
        self.connections = [Topic(*row) for row in found]

    def messages(
        self, connections: Collection[Topic] = (), start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield topic, time and content of messages from ``start`` to before ``stop``, in the order of time."""
        wanted = {topic.number: topic for topic in connections or self.connections}
        marks = ",".join("?" * len(wanted))
        rows = self._connection.execute(
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) "
            "AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, id",
            [*wanted, start or 0, 2**63 - 1 if stop is None else stop],
        )
        for number, at, content in rows:
            yield wanted[number], at, content

    def deserialize(self, content: bytes, kind: str) -> Any:
        """Decode a message."""
        return self._types.deserialize_cdr(content, kind)


@contextmanager
def open_bag(bag: Path) -> Iterator[Any]:
    """Open a reader of a bag: the file of a ROS 1 bag, the folder of a ROS 2 bag, or a single database.

    Raises:
        FileFormatError: It is damaged.
        MissingDependencyError: The extra ``bags`` is not installed.
    """
    with needs("bags"):
        from rosbags.highlevel import AnyReader
    for file in (bag, *(bag.iterdir() if bag.is_dir() else ())):
        if file.exists() and not (file.is_file() or file.is_dir()):  # opening a pipe would wait forever
            raise FileFormatError(file, "cannot be read (not a regular file)")
    with ExitStack() as opening:
        try:
            if bag.suffix.lower() == ".db3":
                source = f"file:{bag.resolve()}?mode=ro"
                reader: Any = Database(
                    opening.enter_context(closing(sqlite3.connect(source, uri=True, check_same_thread=False)))
                )
            else:
                reader = opening.enter_context(AnyReader([bag]))
        except MemoryError as error:
            raise FileFormatError(bag, "more memory than there is would be needed to read this bag") from error
        except Exception as error:  # damage has any form
            raise FileFormatError(bag, f"not a valid bag ({error}); {_repair(bag)}") from error
        yield reader


def _repair(bag: Path) -> str:
    """Return advice on a bag whose recording was interrupted."""
    files = [bag] if bag.is_file() else [file for file in bag.iterdir() if file.suffix in _REPAIRS]
    named = [_REPAIRS[file.suffix.lower()].format(file.name) for file in files if file.suffix.lower() in _REPAIRS]
    return f"if its recording was interrupted, repair it: {named[0]}" if named else "is it a bag?"


class OpenBag:
    """A bag that stays open between reads, since its index is long; used by one thread at a time.

    It is closed with the last reference to it. Another process, which gets it pickled or by a fork, opens it again.
    """

    def __init__(self, bag: Path):
        self.bag = bag
        self._lock = Lock()
        self._reader: Any = None
        self._process = 0

    def __reduce__(self) -> tuple[type[OpenBag], tuple[Path]]:
        return OpenBag, (self.bag,)

    @contextmanager
    def reader(self) -> Iterator[Any]:
        """Yield the reader of `open_bag`."""
        with self._lock:
            if self._process != os.getpid():
                kept = ExitStack()
                self._reader = kept.enter_context(open_bag(self.bag))
                self._process = os.getpid()
                weakref.finalize(self, kept.close)
            yield self._reader

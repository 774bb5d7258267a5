"""ROS 2 bags in SQLite, `.db3`, and what the RealSense SDK writes in the same tables.

A file that was cut off, which SQLite refuses, is read as far as its pages are there.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from .chunked_bag import BagTopic

# Python decodes SQLite's messages, in which names stand as they are in the file
DAMAGED = sqlite3.Error, UnicodeDecodeError
BLOCK = 1 << 30  # bytes of a message; more means a damaged file
STEPS = 10_000  # of SQLite's program between two looks at how long it searches
LONGEST_SEARCH = 1_000  # of these from one message to the next; more means a damaged file


class SqliteBag:
    """A `.db3`, opened; `topics` by name, `damage` says that it was cut off."""

    def __init__(self, path: Path) -> None:
        self.path, self.damage = path, ""
        self._lock = threading.Lock()
        try:
            self._connection = _connect(path)
            rows = self._connection.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            ).fetchall()
        except DAMAGED as error:
            raise DatasetError(f"{path}: not a readable bag of ROS 2 ({error})") from error
        self.topics: dict[str, BagTopic] = {}
        numbers: dict[int, str] = {}
        for number, name, kind, encoding in rows:
            if encoding in ("cdr", "") and isinstance(name, str) and isinstance(kind, str):
                self.topics[name] = BagTopic(name, kind)
                numbers[number] = name
        found: dict[str, list[tuple[int, int]]] = {name: [] for name in self.topics}
        for row, number, time in self._rows():
            if number in numbers and isinstance(time, int):
                found[numbers[number]].append((time, row))
        self._entries = {
            name: np.array(sorted(entries), np.int64) for name, entries in found.items() if entries
        }
        self.topics = {name: self.topics[name] for name in self._entries}

    def close(self) -> None:
        """Give the file back."""
        self._connection.close()

    def times(self, topic: str) -> NDArray[np.int64]:
        """When the messages of a topic were received [ns], ascending."""
        return self._entries[topic][:, 0]

    def places(self, topic: str) -> NDArray[np.int64]:
        """Rows (N, 2) of the messages of a topic, for reading them as they lie."""
        rows = self._entries[topic][:, 1:]
        return np.hstack([np.zeros_like(rows), rows])

    def read(self, topic: str, index: int, count: int | None = None) -> bytes:
        """The bytes of a message, or the first `count`; FrameError where the file is damaged there."""
        row = int(self._entries[topic][index, 1])
        try:
            with (
                self._lock,
                self._connection.blobopen("messages", "data", row, readonly=True) as blob,
            ):
                if len(blob) > BLOCK:
                    raise sqlite3.DatabaseError("too large")
                return blob.read(len(blob) if count is None else min(count, len(blob)))
        except DAMAGED as error:
            raise FrameError(
                f"{self.path}: message {index} of {topic} is damaged or cut off ({error})"
            ) from error

    def _rows(self) -> Iterator[tuple[int, int, int]]:
        """Row, topic and time of every message; behind a damaged page it goes on where it can."""
        last, step, work = -1, 0, 0

        def too_much() -> bool:
            nonlocal work
            work += 1
            return work > LONGEST_SEARCH

        self._connection.set_progress_handler(too_much, STEPS)
        query = "SELECT id, topic_id, timestamp FROM messages WHERE id > ?"
        while step < 1 << 20:
            try:
                for row in self._connection.execute(query, (last + step,)):
                    if row[0] <= last:  # pages that follow each other in a circle
                        raise sqlite3.DatabaseError
                    last, step, work = row[0], 0, 0
                    yield row
                break
            except DAMAGED:
                self.damage = (
                    f"{self.path}: the recording is cut off or damaged; it is read up to there"
                )
                step, work = max(2 * step, 1), 0
        self._connection.set_progress_handler(None, 0)


def _connect(path: Path) -> sqlite3.Connection:
    """The file for reading; with what a recorder that died has left in its journal."""
    journal = path.with_name(f"{path.name}-wal")
    mode = "mode=ro" if journal.exists() and journal.stat().st_size else "mode=ro&immutable=1"
    uri = f"file:{quote(str(path.absolute()))}?{mode}"
    connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
    connection.text_factory = lambda data: data.decode("utf-8", "replace")
    connection.execute("PRAGMA writable_schema=ON")  # else a cut file is refused as a whole
    return connection

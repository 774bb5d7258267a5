"""Recordings of messages in chunks, which ROS 1 bags and MCAP files are: where each message lies, and its
bytes when asked for.

Opening walks from record to record without reading the chunks, by the index that follows each of them; a
chunk without one, as the last of a recording that was cut off, is walked itself, as far as it goes. So a
bag of any size takes a few numbers a message and the chunks that were read last.
"""

from __future__ import annotations

import bz2
import os
import threading
from abc import ABC, abstractmethod
from array import array
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, MissingDependency
from .atomic import file_error

MAX_CHUNK = 1 << 30  # bytes of a chunk; more means a damaged or hostile size
KEPT_CHUNKS = 4  # that were decompressed last: depth, colour and what lies between
KEPT_BYTES = 128 << 20  # of them together
PIECE = 1 << 16  # bytes that are decompressed at once
LOOK_AHEAD = 512  # bytes of a record's head, read at once


class Cut(Exception):
    """The records end here: the file does, or it is damaged."""


@dataclass(frozen=True)
class BagTopic:
    """A topic of a recording and how its messages are written."""

    name: str
    type: str  # as ROS 2 writes it: sensor_msgs/msg/Image
    ros1: bool = False  # serialised by ROS 1; else CDR


@dataclass(frozen=True)
class Chunk:
    """Where the bytes of a chunk lie in the file, and what they are."""

    start: int
    stored: int  # bytes in the file
    size: int  # bytes once decompressed
    compression: str = "none"


class Span:
    """Bytes to be read by their place: of a file, of a part of it, or of memory."""

    def __init__(self, read: Callable[[int, int], bytes], start: int, size: int) -> None:
        self._read, self.start, self.size = read, start, max(size, 0)

    def read(self, at: int, count: int) -> bytes:
        """Up to `count` bytes; Cut where not one is left."""
        count = min(count, self.size - at)
        if count <= 0 or at < 0:
            raise Cut
        return self._read(self.start + at, count)

    def exactly(self, at: int, count: int) -> bytes:
        """`count` bytes; Cut where there are fewer."""
        if count == 0:
            return b""
        data = self.read(at, count)
        if len(data) < count:
            raise Cut
        return data


class ChunkedBag(ABC):
    """A recording in chunks, opened; `topics` by name, `damage` says where it was cut off."""

    def __init__(self, path: Path) -> None:
        self.path, self.damage = path, ""
        try:
            self._stream = open(path, "rb", buffering=0)  # noqa: SIM115 - for as long as the bag is open
            self.size = os.fstat(self._stream.fileno()).st_size
        except OSError as error:
            raise DatasetError(str(file_error("read", path, error))) from error
        stream = self._stream
        self.file = Span(lambda at, count: os.pread(stream.fileno(), count, at), 0, self.size)
        self.chunks: list[Chunk] = []
        self.topics: dict[str, BagTopic] = {}
        self.channels: dict[int, BagTopic] = {}
        self._found: dict[int, array] = {}  # channel -> time, chunk, offset, one after the other
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._lock = threading.Lock()
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Give the file back."""
        self._stream.close()

    def times(self, topic: str) -> NDArray[np.int64]:
        """When the messages of a topic were received [ns], ascending."""
        return self._entries[topic][:, 0]

    def places(self, topic: str) -> NDArray[np.int64]:
        """Chunk and offset (N, 2) of the messages of a topic, for reading them as they lie."""
        return self._entries[topic][:, 1:]

    def read(self, topic: str, index: int, count: int | None = None) -> bytes:
        """The bytes of a message, or the first `count`; FrameError where the file is damaged there."""
        _, chunk, offset = (int(value) for value in self._entries[topic][index])
        try:
            with self._lock:
                span = self.file if chunk < 0 else self._span(chunk)
            at, size = self.message_at(span, offset)
            return span.exactly(at, size if count is None else min(size, count))
        except Cut:
            raise FrameError(
                f"{self.path}: message {index} of {topic} is damaged or cut off"
            ) from None

    @abstractmethod
    def scan(self) -> None:
        """Walk the records of the file: `add_chunk`, `add_message`, `add_channel`; Cut at its end."""

    @abstractmethod
    def walk(self, span: Span, chunk: int, messages: bool) -> None:
        """Walk the records of a chunk: its channels, and its messages if asked for; Cut at its end."""

    @abstractmethod
    def message_at(self, span: Span, offset: int) -> tuple[int, int]:
        """Where the bytes of the message lie whose record begins there, and how many they are."""

    def add_chunk(self, chunk: Chunk) -> None:
        self.chunks.append(chunk)

    def add_message(self, channel: int, time: int, chunk: int, offset: int) -> None:
        if 0 <= time < 2**63 and 0 <= offset < 2**62:
            self._found.setdefault(channel, array("q")).extend((time, chunk, offset))

    def add_messages(self, channel: int, times: NDArray, chunk: int, offsets: NDArray) -> None:
        """What the index of a chunk says of one channel."""
        rows = np.empty((len(times), 3), np.int64)
        rows[:, 0], rows[:, 1], rows[:, 2] = times, chunk, offsets
        rows = rows[(rows[:, 0] >= 0) & (rows[:, 2] >= 0)]
        self._found.setdefault(channel, array("q")).frombytes(rows.tobytes())

    def add_channel(self, channel: int, topic: BagTopic) -> None:
        self.channels.setdefault(channel, topic)

    def _open(self) -> None:
        try:
            self.scan()
        except Cut:
            self.damage = (
                f"{self.path}: the recording is cut off or damaged; it is read up to there"
            )
            if self.chunks:  # its index may be incomplete
                self._drop(len(self.chunks) - 1)
        indexed = {int(i) for rows in self._found.values() for i in set(rows[1::3])}
        for i in range(len(self.chunks)):
            if i not in indexed:
                self._walk(i, messages=True)
        for i in range(len(self.chunks)):  # of a recording that was cut off: no list at its end
            if not set(self._found) - set(self.channels):
                break
            self._walk(i, messages=False)
        found: dict[str, list[NDArray[np.int64]]] = {}
        for channel, rows in self._found.items():
            if channel in self.channels:
                topic = self.channels[channel]
                self.topics[topic.name] = topic
                found.setdefault(topic.name, []).append(np.array(rows, np.int64).reshape(-1, 3))
        self._entries = {}
        for name, parts in found.items():
            entries = np.concatenate(parts)
            self._entries[name] = entries[np.argsort(entries[:, 0], kind="stable")]

    def _drop(self, chunk: int) -> None:
        for channel, values in self._found.items():
            rows = np.array(values, np.int64).reshape(-1, 3)
            self._found[channel] = array("q", rows[rows[:, 1] != chunk].tobytes())

    def _walk(self, chunk: int, messages: bool) -> None:
        try:
            self.walk(self._span(chunk), chunk, messages)
        except (Cut, FrameError):  # what lies before counts
            return

    def _span(self, chunk: int) -> Span:
        where = self.chunks[chunk]
        if where.compression in ("", "none"):
            return Span(self.file.read, where.start, min(where.stored, self.size - where.start))
        if chunk not in self._kept:
            self._kept[chunk] = self._decompressed(where)
            while len(self._kept) > 1 and (
                len(self._kept) > KEPT_CHUNKS or sum(map(len, self._kept.values())) > KEPT_BYTES
            ):
                self._kept.popitem(last=False)
        self._kept.move_to_end(chunk)
        data = self._kept[chunk]
        return Span(lambda at, count: data[at : at + count], 0, len(data))

    def _decompressed(self, chunk: Chunk) -> bytes:
        if not 0 <= chunk.size <= MAX_CHUNK or chunk.stored > MAX_CHUNK:
            raise Cut
        return decompress(self.file.read(chunk.start, chunk.stored), chunk.compression, chunk.size)


def decompress(data: bytes, kind: str, size: int) -> bytes:
    """At most `size` bytes of a stream by its kind, bz2, lz4 or zstd; of one that is cut off, what can be
    had. DatasetError for another kind.
    """
    unpack, done = _decompressor(kind), bytearray()
    try:  # in pieces: what comes before damage is worth having
        for at in range(0, len(data), PIECE):
            if len(done) >= size:
                break
            done += unpack(data[at : at + PIECE], size - len(done))
    except Exception:  # noqa: BLE001 each of the three raises errors of its own
        return bytes(done)
    return bytes(done)


def _decompressor(kind: str) -> Callable[[bytes, int], bytes]:
    if kind == "bz2":
        return bz2.BZ2Decompressor().decompress
    if kind == "lz4":
        try:
            from lz4.frame import LZ4FrameDecompressor
        except ImportError:
            raise missing_rosbags() from None
        return LZ4FrameDecompressor().decompress
    if kind == "zstd":
        return zstd().ZstdDecompressor().decompress
    raise DatasetError(f"its chunks are compressed by '{kind[:20]}', which cannot be read")


def zstd():
    """The module of Zstandard that comes with rosbags."""
    try:
        from backports import zstd as module
    except ImportError:
        raise missing_rosbags() from None
    return module


def missing_rosbags() -> MissingDependency:
    """What is said where rosbags is not installed."""
    return MissingDependency("bags are read with rosbags: pip install 'taichi-unifusion[ros]'")

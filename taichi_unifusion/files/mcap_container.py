"""MCAP files: chunks of messages, each followed by an index of every channel in it, or messages alone."""

from __future__ import annotations

import struct

import numpy as np

from ..errors import DatasetError
from .chunked_bag import BagTopic, Chunk, ChunkedBag, Cut, Span

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX = 2, 3, 4, 5, 6, 7  # kinds of records
HEAD = 9  # bytes before a record's content: kind, length
ENCODINGS = {"cdr": False, "ros1": True}  # of messages; whether that is ROS 1
LARGEST = 1 << 24  # bytes of a record that describes a channel or a type


class Mcap(ChunkedBag):
    """A `.mcap` with messages of ROS."""

    def scan(self) -> None:
        self.schemas: dict[int, str] = {}  # names of types
        self.refused: set[str] = set()  # encodings of messages that we do not read
        if self.size < len(MAGIC) or self.file.read(0, len(MAGIC)) != MAGIC:
            raise DatasetError(f"{self.path}: not an MCAP file")
        at = len(MAGIC)
        while at < self.size:
            kind, data, length = record(self.file, at)
            if kind == CHUNK:
                self._add_chunk(data, length)
            elif kind == INDEX and self.chunks:
                self._add_index(self.file.exactly(data, length))
            else:
                self._take(self.file, kind, at, data, length, -1, True)
            at = data + length
            if at > self.size:
                raise Cut
            if kind == FOOTER:
                break
        else:
            raise Cut

    def walk(self, span: Span, chunk: int, messages: bool) -> None:
        at = 0
        while at < span.size:
            kind, data, length = record(span, at)
            if data + length > span.size:
                raise Cut
            self._take(span, kind, at, data, length, chunk, messages)
            at = data + length

    def message_at(self, span: Span, offset: int) -> tuple[int, int]:
        kind, data, length = record(span, offset)
        if kind != MESSAGE or length < 22:
            raise Cut
        return data + 22, length - 22

    def _take(
        self, span: Span, kind: int, at: int, data: int, length: int, chunk: int, messages: bool
    ) -> None:
        """One record that is no chunk and no index."""
        if kind == MESSAGE and messages:
            if data + length > span.size:
                raise Cut
            channel, _, time = struct.unpack("<HIQ", span.exactly(data, 14))
            self.add_message(channel, time, chunk, at)
        elif kind == SCHEMA:
            content = _Content(self._small(span, data, length))
            number = content.number("<H")
            self.schemas[number] = content.text()
        elif kind == CHANNEL:
            content = _Content(self._small(span, data, length))
            number, schema, name, encoding = (
                content.number("<H"),
                content.number("<H"),
                content.text(),
                content.text(),
            )
            if encoding not in ENCODINGS:
                self.refused.add(encoding)
                return
            type_name = self.schemas.get(schema, "")
            if type_name.count("/") == 1:
                type_name = type_name.replace("/", "/msg/")
            self.add_channel(number, BagTopic(name, type_name, ENCODINGS[encoding]))

    def _small(self, span: Span, data: int, length: int) -> bytes:
        if length > LARGEST:
            raise Cut
        return span.exactly(data, length)

    def _add_chunk(self, data: int, length: int) -> None:
        head = _Content(self.file.read(data, min(length, 256)))
        head.at = 16  # times of the first and last message
        size, _, compression, stored = (
            head.number("<Q"),
            head.number("<I"),
            head.text(),
            head.number("<Q"),
        )
        start = data + head.at
        self.add_chunk(Chunk(start, min(stored, self.size - start), size, compression))

    def _add_index(self, data: bytes) -> None:
        channel, size = struct.unpack_from("<HI", data) if len(data) >= 6 else (0, -1)
        if size % 16 or len(data) < 6 + size:
            raise Cut
        rows = np.frombuffer(data, "<i8", size // 8, 6).reshape(-1, 2)
        self.add_messages(channel, rows[:, 0], len(self.chunks) - 1, rows[:, 1])


def record(span: Span, at: int) -> tuple[int, int, int]:
    """Kind of the record that begins there, and where its content lies and how long it is."""
    kind, length = struct.unpack("<BQ", span.exactly(at, HEAD))
    if kind == 0 or length > 1 << 50:
        raise Cut
    return kind, at + HEAD, length


class _Content:
    """The fields of a record, one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def number(self, kind: str) -> int:
        size = struct.calcsize(kind)
        if self.at + size > len(self.data):
            raise Cut
        value = struct.unpack_from(kind, self.data, self.at)[0]
        self.at += size
        return value

    def text(self) -> str:
        size = self.number("<I")
        if self.at + size > len(self.data):
            raise Cut
        self.at += size
        return self.data[self.at - size : self.at].decode("utf-8", "replace")

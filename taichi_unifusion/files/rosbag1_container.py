"""ROS 1 bags (version 2.0): chunks of messages, each followed by an index of every connection in it."""

from __future__ import annotations

import struct

import numpy as np

from ..errors import DatasetError
from .chunked_bag import LOOK_AHEAD, BagTopic, Chunk, ChunkedBag, Cut, Span

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, INDEX, CHUNK, CONNECTION = 2, 4, 5, 7  # kinds of records
MAX_HEAD = 1 << 20  # bytes of a record's head; a definition lies in its data
Fields = dict[bytes, bytes]


class Rosbag1(ChunkedBag):
    """A `.bag` of ROS 1."""

    def scan(self) -> None:
        if self.size < len(MAGIC) or self.file.read(0, len(MAGIC)) != MAGIC:
            begins = self.file.read(0, 13) if self.size else b""
            advice = "; rosbag's `fix` and `migrate` bring old bags up to date" * (
                begins[:8] == b"#ROSBAG "
            )
            raise DatasetError(f"{self.path}: not a bag of ROS 1, version 2.0{advice}")
        at = len(MAGIC)
        while at < self.size:
            fields, data, length = record(self.file, at)
            kind = _number(fields, b"op", "<B")
            if kind == CHUNK:
                compression = fields.get(b"compression", b"none").decode("ascii", "replace")
                size = _number(fields, b"size", "<I")
                self.add_chunk(Chunk(data, min(length, self.size - data), size, compression))
            elif kind == INDEX and self.chunks:
                self._add_index(fields, data, length)
            elif kind == CONNECTION:
                self._add_connection(fields, self.file.exactly(data, length))
            at = data + length
            if at > self.size:
                raise Cut

    def walk(self, span: Span, chunk: int, messages: bool) -> None:
        at = 0
        while at < span.size:
            fields, data, length = record(span, at)
            kind = _number(fields, b"op", "<B")
            if data + length > span.size:
                raise Cut
            if kind == CONNECTION:
                self._add_connection(fields, span.exactly(data, length))
            elif kind == MESSAGE and messages:
                seconds, rest = struct.unpack("<II", _field(fields, b"time", 8))
                channel = _number(fields, b"conn", "<I")
                self.add_message(channel, seconds * 10**9 + rest, chunk, at)
            at = data + length

    def message_at(self, span: Span, offset: int) -> tuple[int, int]:
        while True:
            fields, data, length = record(span, offset)
            kind = _number(fields, b"op", "<B")
            if kind == MESSAGE:
                return data, length
            if kind != CONNECTION:
                raise Cut
            offset = data + length

    def _add_index(self, fields: Fields, data: int, length: int) -> None:
        channel, count = _number(fields, b"conn", "<I"), _number(fields, b"count", "<I")
        if length != 12 * count:
            raise Cut
        rows = np.frombuffer(self.file.exactly(data, length), "<u4").reshape(-1, 3).astype(np.int64)
        times = rows[:, 0] * 10**9 + rows[:, 1]
        self.add_messages(channel, times, len(self.chunks) - 1, rows[:, 2])

    def _add_connection(self, fields: Fields, data: bytes) -> None:
        more = _parse(data)
        topic = fields.get(b"topic") or more.get(b"topic", b"")
        kind = more.get(b"type", b"").decode("utf-8", "replace")
        package, _, name = kind.rpartition("/")
        self.add_channel(
            _number(fields, b"conn", "<I"),
            BagTopic(
                topic.decode("utf-8", "replace"),
                f"{package}/msg/{name}" if "/" not in package else kind,
                ros1=True,
            ),
        )


def record(span: Span, at: int) -> tuple[Fields, int, int]:
    """The head of the record that begins there, and where its data lie and how long they are."""
    head = span.read(at, LOOK_AHEAD)
    if len(head) < 4:
        raise Cut
    size = int.from_bytes(head[:4], "little")
    if size > MAX_HEAD:
        raise Cut
    if len(head) < size + 8:
        head = span.exactly(at, size + 8)
    length = int.from_bytes(head[size + 4 : size + 8], "little")
    return _parse(head[4 : size + 4]), at + size + 8, length


def _parse(data: bytes) -> Fields:
    """name=value pairs, each after its length."""
    fields, at = {}, 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
        if not equals or at + 4 + size > len(data):
            raise Cut
        fields[name] = value
        at += 4 + size
    return fields


def _field(fields: Fields, name: bytes, size: int) -> bytes:
    value = fields.get(name, b"")
    if len(value) != size:
        raise Cut
    return value


def _number(fields: Fields, name: bytes, kind: str) -> int:
    return struct.unpack(kind, _field(fields, name, struct.calcsize(kind)))[0]

"""Depth images of one size that are compressed one after the other in one file, as ScanNet++ has them
from iPhones.

Either all of them as one stream of raw deflate, float32 metres; or each with its size in 4 bytes before
it, as a block of LZ4, 16-bit millimetres, or of raw deflate, float32 metres.
"""

from __future__ import annotations

import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, MissingDependency

CHUNK = 1 << 16  # [bytes] read at a time
EVERY = 32  # images between places from which reading can begin
MILLIMETRE = np.float32(1e-3)


@dataclass(frozen=True)
class _Place:
    """Where image `number` of the one stream begins, and the state of who reads it."""

    number: int
    offset: int  # [bytes] of what was not fed yet
    unpacker: Any
    rest: bytes  # fed, and not unpacked


class DepthStream:
    """Depth images 0, 1, 2 ... of `size` (width, height); raises DatasetError for no such file."""

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self.path, self.size, self._lock = path, size, Lock()
        try:
            self.offsets = _blocks(path)
        except OSError as error:
            raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
        start = _Place(0, 0, zlib.decompressobj(-zlib.MAX_WBITS), b"")
        self._places = [start]  # at every EVERY-th image as far as was read
        self._now = start

    def read(self, number: int) -> NDArray[np.float32]:
        """Image `number`, (H, W) [m], 0 no reading; FrameError where it cannot be read."""
        where = f"{self.path} image {number}"
        try:
            with self._lock:
                depth = self._block(number, where) if self.offsets else self._streamed(number)
        except (OSError, zlib.error, ValueError) as error:
            raise FrameError(f"{where}: is missing or damaged ({str(error)[:80]})") from None
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def _block(self, number: int, where: str) -> NDArray[np.float32]:
        if not 0 <= number < len(self.offsets):
            raise ValueError(f"there are {len(self.offsets)} images")
        offset, count = self.offsets[number]
        with open(self.path, "rb") as file:
            file.seek(offset)
            data = file.read(count)
        pixels = self.size[0] * self.size[1]
        units = _unpack_lz4(data, 2 * pixels, where)
        if units is not None:
            return self._image(np.frombuffer(units, "<u2") * MILLIMETRE)
        metres = zlib.decompressobj(-zlib.MAX_WBITS).decompress(data, 4 * pixels + 1)
        return self._image(np.frombuffer(metres, "<f4"))

    def _streamed(self, number: int) -> NDArray[np.float32]:
        image, before = b"", [place for place in self._places if place.number <= number]
        if not before[-1].number <= self._now.number <= number:
            self._now = before[-1]
        while self._now.number <= number:
            image, self._now = self._next(self._now)
            if self._now.number % EVERY == 0 and self._places[-1].number < self._now.number:
                self._places.append(self._now)
        return self._image(np.frombuffer(image, "<f4"))

    def _next(self, place: _Place) -> tuple[bytes, _Place]:
        """The image of the one stream that begins at a place, and the place behind it."""
        count, image = 4 * self.size[0] * self.size[1], bytearray()
        unpacker, rest, offset = place.unpacker.copy(), place.rest, place.offset
        with open(self.path, "rb") as file:
            file.seek(offset)
            while len(image) < count:
                fresh = b"" if rest else file.read(CHUNK)
                offset += len(fresh)
                part = unpacker.decompress(rest or fresh, count - len(image))
                if not (part or rest or fresh):
                    raise ValueError(f"there are {place.number} images")
                image += part
                rest = unpacker.unconsumed_tail
        return bytes(image), _Place(place.number + 1, offset, unpacker.copy(), rest)

    def _image(self, values: NDArray) -> NDArray[np.float32]:
        width, height = self.size
        if len(values) != width * height:
            raise ValueError(f"it has {len(values)} pixels, expected {width}x{height}")
        return values.reshape(height, width).astype(np.float32)


def _blocks(path: Path) -> list[tuple[int, int]]:
    """Offset and size of every image's block; none if the sizes do not lead to the file's end."""
    end, at, found = os.path.getsize(path), 0, []
    with open(path, "rb") as file:
        while at < end:
            file.seek(at)
            count = int.from_bytes(file.read(4), "little")
            at += 4
            if not count or at + count > end:
                return []
            found.append((at, count))
            at += count
    return found


def _unpack_lz4(data: bytes, count: int, where: str) -> bytes | None:
    """The block of LZ4, or None if it is none that gives so many bytes."""
    try:
        import lz4.block
    except ImportError:
        raise MissingDependency(
            f"{where}: depth is unpacked with lz4; run: pip install 'taichi-unifusion[phone]'"
        ) from None
    try:
        found = lz4.block.decompress(data, uncompressed_size=count)
    except (lz4.block.LZ4BlockError, ValueError, MemoryError):
        return None
    return found if len(found) == count else None

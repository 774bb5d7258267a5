"""Files that grow: records of JSON values and arrays, appended one by one, each with checksums, read
without trust.

Layout: 16 bytes that name format and version; then for every record 4 bytes "REC1", lengths of its
header (u32) and body (u64), CRC-32 of either (u32 each), the header as JSON, and the arrays, each
compressed by itself. A record that was not written to its end, as after a power cut, is not there:
whoever appends next begins where it began.
"""

from __future__ import annotations

import json
import math
import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError
from .atomic import file_error

MAGIC = b"unifusion log 1\n"
_HEAD = struct.Struct("<4sIQII")  # mark, bytes of header and body, their checksums
_MARK = b"REC1"
MAX_HEADER, MAX_BODY = 64 << 20, 1 << 34  # [bytes]
MAX_ELEMENTS = 1 << 34
DTYPES = ("bool", "int8", "uint8", "int16", "uint16", "int32", "int64", "float32", "float64")
PNG_DTYPES = ("uint8", "uint16")  # of stacks of images
ZLIB_LEVEL = 1  # 6 takes four times as long and saves a tenth
Coder = tuple[Callable[[NDArray], bytes], Callable[[bytes, np.dtype, tuple[int, ...]], NDArray]]


@dataclass(frozen=True)
class Record:
    """Where a record lies, and its values; the arrays are read when they are asked for."""

    path: Path
    values: Mapping[str, Any]
    arrays: tuple[Mapping[str, Any], ...]  # name, dtype, shape, coding and bytes of each
    offset: int  # of the body
    size: int  # of the body
    checksum: int  # of the body

    def read(self, names: Collection[str] | None = None) -> dict[str, NDArray]:
        """The arrays by name, or those of `names`; raises FileError where the file is damaged or gone."""
        try:
            with self.path.open("rb") as file:
                file.seek(self.offset)
                body = file.read(self.size)
        except OSError as error:
            raise file_error("read", self.path, error) from error
        if len(body) != self.size or zlib.crc32(body) != self.checksum:
            raise damaged(self.path, "a checksum does not fit")
        return unpack(self.path, self.arrays, body, names)


def damaged(path: Path, why: str) -> FileError:
    """The error of a file that is not as it was written."""
    return FileError(f"{path}: damaged ({why}); make the results again")


def pack(values: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> bytes:
    """A record as bytes. Compresses, which takes milliseconds, and may run on any thread."""
    entries, parts = [], []
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        image = array.dtype.name in PNG_DTYPES and array.ndim == 3 and array.size
        coding = "png" if image else "zlib"
        parts.append(_CODERS[coding][0](array))
        entries.append(
            {
                "name": name,
                "dtype": array.dtype.name,
                "shape": list(array.shape),
                "coding": coding,
                "bytes": len(parts[-1]),
            }
        )
    body = b"".join(parts)
    header = json.dumps({"values": dict(values), "arrays": entries}).encode()
    head = _HEAD.pack(_MARK, len(header), len(body), zlib.crc32(header), zlib.crc32(body))
    return head + header + body


def unpack_record(
    packed: bytes, names: Collection[str] | None = None
) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """Values and arrays that `pack` was given, or those arrays of `names`."""
    _, length, _, _, _ = _HEAD.unpack_from(packed)
    content = json.loads(packed[_HEAD.size : _HEAD.size + length])
    body = packed[_HEAD.size + length :]
    return content["values"], unpack(Path("memory"), tuple(content["arrays"]), body, names)


def unpack(
    path: Path,
    entries: tuple[Mapping[str, Any], ...],
    body: bytes,
    names: Collection[str] | None = None,
) -> dict[str, NDArray]:
    """The arrays of a body, or those of `names`; raises FileError where an entry does not fit it."""
    arrays, at = {}, 0
    for entry in entries:
        size = int(entry["bytes"])
        shape = tuple(int(n) for n in entry["shape"])
        if entry["dtype"] not in DTYPES or entry["coding"] not in _CODERS:
            raise damaged(path, f"array '{str(entry.get('name'))[:40]}' of an unknown kind")
        if size < 0 or min(shape, default=0) < 0 or math.prod(shape) > MAX_ELEMENTS:
            raise damaged(path, "an array of no possible size")
        if names is not None and entry["name"] not in names:
            at += size
            continue
        try:
            decode = _CODERS[entry["coding"]][1]
            arrays[str(entry["name"])] = decode(
                body[at : at + size], np.dtype(entry["dtype"]), shape
            )
        except (ValueError, zlib.error, cv2.error) as error:
            raise damaged(path, str(error)[:80]) from None
        at += size
    return arrays


def scan(path: Path) -> Iterator[Record]:
    """The records of a file in order, up to the first that was not written to its end. Bodies are not
    read.

    Raises FileError where the file is missing or another one.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise FileError(f"{path}: not a file of records of this version")
            end = os.fstat(file.fileno()).st_size
            while record := _next(path, file, end):
                yield record
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise file_error("read", path, error) from error


def _next(path: Path, file: IO[bytes], end: int) -> Record | None:
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    mark, length, size, header_sum, body_sum = _HEAD.unpack(head)
    if mark != _MARK or length > MAX_HEADER or size > MAX_BODY:
        return None
    header = file.read(length)
    if len(header) < length or zlib.crc32(header) != header_sum or file.tell() + size > end:
        return None
    content = json.loads(header)
    record = Record(path, content["values"], tuple(content["arrays"]), file.tell(), size, body_sum)
    file.seek(size, os.SEEK_CUR)
    return record


class RecordLog:
    """A file of records that is open to append to; it is made where it does not exist.

    What stands there already is kept, but for a last record that was cut off.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.kept = tuple(scan(path)) if path.exists() and path.stat().st_size else ()
            end = self.kept[-1].offset + self.kept[-1].size if self.kept else 0
            self._file = path.open("r+b" if path.exists() else "w+b")
            self._file.truncate(end)
            self._file.seek(end)
            if not end:
                self._file.write(MAGIC)
        except OSError as error:
            if isinstance(error, FileError):
                raise
            raise file_error("write", path, error) from error

    def append(self, packed: bytes) -> Record:
        """Write a record that `pack` made; raises FileError, and the file is as it was before."""
        start = self._file.tell()
        try:
            self._file.write(packed)
            self._file.flush()
        except OSError as error:
            self._file.seek(start)
            self._file.truncate(start)
            raise file_error("write", self.path, error) from error
        _, length, size, _, body_sum = _HEAD.unpack_from(packed)
        content = json.loads(packed[_HEAD.size : _HEAD.size + length])
        at = start + _HEAD.size + length
        return Record(self.path, content["values"], tuple(content["arrays"]), at, size, body_sum)

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._file.tell()

    def sync(self) -> None:
        """Wait until all that was appended is on the disk."""
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise file_error("write", self.path, error) from error

    def close(self) -> None:
        self._file.close()


def _deflate(array: NDArray) -> bytes:
    """Bytes of equal weight side by side: they are alike."""
    planes = array.reshape(-1).view(np.uint8).reshape(-1, array.dtype.itemsize).T
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), ZLIB_LEVEL)


def _inflate(data: bytes, dtype: np.dtype, shape: tuple[int, ...]) -> NDArray:
    size = math.prod(shape) * dtype.itemsize
    raw = zlib.decompressobj().decompress(data, size + 1)
    if len(raw) != size:
        raise ValueError("an array is cut off")
    planes = np.frombuffer(raw, np.uint8).reshape(dtype.itemsize, -1)
    return np.ascontiguousarray(planes.T).view(dtype).reshape(shape)


def _to_png(images: NDArray) -> bytes:
    """Images (K, h, w), one below the other; quickly."""
    stacked = images.reshape(-1, images.shape[2])
    return cv2.imencode(".png", stacked, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


def _from_png(data: bytes, dtype: np.dtype, shape: tuple[int, ...]) -> NDArray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype != dtype or image.size != math.prod(shape):
        raise ValueError("an image is damaged")
    return image.reshape(shape)


_CODERS: dict[str, Coder] = {"zlib": (_deflate, _inflate), "png": (_to_png, _from_png)}

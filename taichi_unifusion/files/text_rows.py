"""Text files of rows: lines of columns, separated by blanks or commas."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..errors import DatasetError

LONGEST_STAMP = 1e25


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """`parse_lines` of a file; whatever is wrong with it is a DatasetError."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise DatasetError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})"
        ) from error
    yield from parse_lines(data, str(path))


def parse_lines(data: bytes, name: str) -> Iterator[tuple[int, str]]:
    """(line number from 1, text) of every line that is neither empty nor a # comment.

    A byte-order mark and any line end are accepted; DatasetError if this is no UTF-8 text.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{name}: not a text file") from None
    for number, line in enumerate(io.StringIO(text, newline=None), 1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def split_row(line: str) -> list[str]:
    """The columns of a row, separated by blanks or commas."""
    return line.replace(",", " ").split()


def parse_numbers(words: Sequence[str], where: str) -> list[float]:
    """The words as numbers (NaN and infinity included), or DatasetError."""
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DatasetError(f"{where}: {str(error).rpartition(': ')[2]} is not a number") from None


def is_stamp(word: str) -> bool:
    """Whether the word is a number that may be a time stamp, in whatever unit."""
    value = finite_or_none(word)
    return value is not None and abs(value) < LONGEST_STAMP


def finite_or_none(word: str) -> float | None:
    """The word as a finite number, or None."""
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None

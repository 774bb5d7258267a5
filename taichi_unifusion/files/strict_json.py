"""JSON files and what is expected in them: every surprise is a DatasetError that names the file and
the key.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FileError, shortened
from .atomic import read_bytes


def read_object(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The object in the file at `path`."""
    try:
        return parse_object(read_bytes(path), str(path))
    except FileError as error:
        raise DatasetError(str(error)) from None


def parse_object(data: bytes, where: str) -> dict[str, Any]:
    """The object that the bytes of a JSON file hold; `where` names them in messages."""
    try:
        value = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{where}: not a JSON file ({str(error)[:80]})") from None
    if not isinstance(value, dict):
        raise DatasetError(f"{where}: expected an object in braces, found {shortened(value)}")
    return value


def list_of(values: Mapping[str, Any], key: str, where: str) -> list[Any]:
    """The list under `key`."""
    value = values.get(key)
    if not isinstance(value, list):
        raise DatasetError(f"{where}: '{key}' must be a list, found {shortened(value)}")
    return value


def number(values: Mapping[str, Any], key: str, where: str, default: float | None = None) -> float:
    """The finite number under `key`, or the default where there is no such key."""
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise DatasetError(f"{where}: '{key}' must be a number, found {shortened(value)}")
    return float(value)


def numbers(value: Any, shape: tuple[int, ...], where: str) -> NDArray[np.float64]:
    """Nested lists of numbers, NaN and infinity among them, as an array of that shape."""
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        array = None
    if array is None or array.shape != shape:
        size = " x ".join(map(str, shape))
        raise DatasetError(f"{where}: expected {size} numbers, found {shortened(value)}")
    return array

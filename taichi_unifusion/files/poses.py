"""Camera poses as text: one matrix a file, one matrix a row, or TUM rows `timestamp tx ty tz qx qy
qz qw`.

A pose that cannot be used (missing, wrong count of numbers, quaternion far from unit length) is
kept with the reason, so that it costs its own frame only; a file that cannot be read as what it
should be is a DatasetError with the line.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, PoseError
from ..types import check_rigid

UNIT_TOLERANCE = 1e-3  # of a quaternion's length: files of four digits pass


@dataclass(frozen=True)
class Pose:
    """A pose as found in a file: the matrix, not yet known to be rigid, or why there is none."""

    source: str  # file and line, for messages
    T_world_camera: NDArray[np.float64] | None = None  # (4, 4)
    problem: str = ""  # why T_world_camera is None

    def checked(self) -> NDArray[np.float64]:
        """T_world_camera as a rigid transform, or PoseError naming the source."""
        if self.T_world_camera is None:
            raise PoseError(f"{self.source}: {self.problem}")
        return check_rigid(self.T_world_camera, self.source)


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """(line number from 1, text) of every line that is neither empty nor a # comment; BOM and CRLF
    are accepted.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a text file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise DatasetError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})"
        ) from error
    for number, line in enumerate(text.split("\n"), 1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def parse_numbers(words: list[str], where: str) -> list[float]:
    """The words as numbers (NaN and infinity included), or DatasetError."""
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise DatasetError(f"{where}: {str(error).rpartition(': ')[2]} is not a number") from None


def split_row(line: str) -> list[str]:
    """The columns of a row, separated by blanks or commas."""
    return line.replace(",", " ").split()


def read_matrix_file(path: Path) -> Pose:
    """The 4x4 row-major matrix that fills the file; whatever is wrong with it stays with this pose."""
    try:
        with open(path, "rb") as file:
            numbers = [float(word) for word in file.read().split()]
    except FileNotFoundError:
        return Pose(str(path), problem="no such file, this frame has no pose")
    except (OSError, ValueError) as error:
        return Pose(str(path), problem=f"not a pose file ({error})")
    if len(numbers) != 16:
        return Pose(str(path), problem=f"expected a 4x4 matrix, found {len(numbers)} numbers")
    return Pose(str(path), np.array(numbers).reshape(4, 4))


def read_matrix_rows(path: Path) -> list[Pose]:
    """One row-major 4x4 matrix a row."""
    return [
        matrix_from_row(split_row(line), f"{path} line {number}")
        for number, line in read_lines(path)
    ]


def matrix_from_row(words: list[str], where: str) -> Pose:
    """A row-major 4x4 matrix from the words of one row."""
    if len(words) != 16:
        raise DatasetError(f"{where}: expected the 16 numbers of a 4x4 matrix, found {len(words)}")
    return Pose(where, np.array(parse_numbers(words, where)).reshape(4, 4))


@dataclass(frozen=True)
class TumRow:
    """A row `name tx ty tz qx qy qz qw`; a name that is a finite number is its time stamp [s]."""

    source: str
    name: str
    timestamp: float | None
    numbers: tuple[float, ...]  # tx ty tz [m], qx qy qz qw

    def pose(self) -> Pose:
        """The pose, or why the quaternion is none."""
        x, y, z, *quaternion = self.numbers
        length = math.hypot(*quaternion)
        if not abs(length - 1) <= UNIT_TOLERANCE:
            return Pose(
                self.source,
                problem=f"the quaternion's length is {length:.4f}, not 1; are the columns "
                "tx ty tz qx qy qz qw?",
            )
        T = np.eye(4)
        T[:3, :3] = rotation_from_quaternion(np.array(quaternion) / length)
        T[:3, 3] = x, y, z
        return Pose(self.source, T)


def read_tum_rows(path: Path) -> list[TumRow]:
    """Rows `timestamp tx ty tz qx qy qz qw` in the order of the file."""
    rows = [tum_row(split_row(line), f"{path} line {number}") for number, line in read_lines(path)]
    for row in rows:
        if row.timestamp is None:
            raise DatasetError(f"{row.source}: '{row.name}' is not a time stamp")
    return rows


def tum_row(words: list[str], where: str) -> TumRow:
    """The row from its words, or DatasetError if they are not 8 or not numbers."""
    if len(words) != 8:
        raise DatasetError(
            f"{where}: expected 8 columns (timestamp tx ty tz qx qy qz qw), found {len(words)}"
        )
    return TumRow(where, words[0], finite_or_none(words[0]), tuple(parse_numbers(words[1:], where)))


def finite_or_none(word: str) -> float | None:
    """The word as a finite number, or None."""
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def rotation_from_quaternion(q: NDArray) -> NDArray[np.float64]:
    """Unit quaternion (x, y, z, w) -> (3, 3) rotation."""
    v, w = q[:3], q[3]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross

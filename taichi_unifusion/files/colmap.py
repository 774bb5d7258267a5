"""Poses of COLMAP: `images.txt` and `images.bin`, world to camera, which are inverted; their unit is
COLMAP's own unless the model was scaled.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..geometry import se3
from ..geometry.quaternions import quaternion_to_rotation
from .frame_files import stem_of
from .text_rows import finite_or_none, read_lines
from .trajectories import UNIT_TOLERANCE, Pose, PoseRow

COLUMNS = 10  # id qw qx qy qz tx ty tz camera name
IMAGE = struct.Struct("<I7dI")  # the same, before the name
POINT_BYTES = 24  # of a point seen in an image
LONGEST_NAME = 4096


def is_colmap_text(path: Path) -> bool:
    """Whether the first row of a file is that of an image in COLMAP's list."""
    return _words(next(iter(read_lines(path)), (0, ""))[1]) is not None


def read_colmap(path: Path) -> list[PoseRow]:
    """The pose of every image, by its name without folder and suffix; DatasetError for another file."""
    rows = _read_binary(path) if path.suffix.lower() == ".bin" else _read_text(path)
    if not rows:
        raise DatasetError(f"{path}: holds no image of COLMAP")
    return rows


def _words(line: str) -> list[str] | None:
    """The columns of an image's row; None for one of points, which holds numbers alone."""
    words = line.split(maxsplit=COLUMNS - 1)
    numbers = [finite_or_none(word) is not None for word in words]
    whole = len(words) == COLUMNS and words[0].isdecimal() and words[8].isdecimal()
    return words if whole and all(numbers[:9]) and not _all_numbers(words[9]) else None


def _all_numbers(text: str) -> bool:
    return all(finite_or_none(word) is not None for word in text.split())


def _read_text(path: Path) -> list[PoseRow]:
    return [
        _row(words[9], [float(word) for word in words[1:8]], f"{path}, line {number}")
        for number, line in read_lines(path)
        if (words := _words(line)) is not None
    ]


def _read_binary(path: Path) -> list[PoseRow]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from None
    rows, at = [], 8
    count = int.from_bytes(data[:8], "little")
    for i in range(min(count, len(data) // IMAGE.size + 1)):
        try:
            _, *numbers, _ = IMAGE.unpack_from(data, at)
            end = data.index(b"\0", at + IMAGE.size, at + IMAGE.size + LONGEST_NAME)
            name = data[at + IMAGE.size : end].decode()
            points = int.from_bytes(data[end + 1 : end + 9], "little")
        except (struct.error, ValueError, OverflowError):
            raise DatasetError(f"{path}: not a list of images of COLMAP, or cut off") from None
        at = end + 9 + POINT_BYTES * points
        rows.append(_row(name, numbers, f"{path}, image {i}"))
    if len(rows) != count or at != len(data):
        raise DatasetError(f"{path}: not a list of images of COLMAP, or cut off")
    return rows


def _row(name: str, numbers: list[float], source: str) -> PoseRow:
    """The pose of qw qx qy qz tx ty tz, world to camera."""
    w, *xyz = numbers[:4]
    q = np.array([*xyz, w])
    if not np.isfinite(numbers).all():
        pose = Pose(source, problem="holds NaN or infinite numbers")
    elif abs(np.linalg.norm(q) - 1) > UNIT_TOLERANCE:
        pose = Pose(source, problem=f"the quaternion's length is {np.linalg.norm(q):.4f}, not 1")
    else:
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3] = quaternion_to_rotation(q[None])[0]
        T_camera_world[:3, 3] = numbers[4:]
        pose = Pose(source, se3.inverse(T_camera_world))
    return PoseRow(pose, stem_of(name))

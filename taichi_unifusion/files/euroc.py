"""Poses of EuRoC: a `data.csv` of a body's poses, and the `sensor.yaml` that says where a camera sits on
the body.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FileError, InputError, PoseError
from ..types import check_rigid
from .strict_json import numbers
from .strict_yaml import read_yaml
from .text_rows import parse_numbers, read_lines
from .trajectories import PoseRow, poses_from_quaternions

LEAST_COLUMNS = 8  # time [ns], p x y z, q w x y z; velocity and biases may follow
LEAST_STAMP = 10**15  # [ns] eleven days; smaller ones are no nanoseconds
NANOSECONDS = 10**9


def is_euroc(path: Path) -> bool:
    """Whether the first row of a file is EuRoC's: commas, and nanoseconds before all else."""
    words = next(iter(read_lines(path)), (0, ""))[1].split(",")
    return (
        len(words) >= LEAST_COLUMNS
        and words[0].strip().isdecimal()
        and int(words[0]) >= LEAST_STAMP
    )


def read_euroc(path: Path, T_body_camera: NDArray[np.float64] | None = None) -> list[PoseRow]:
    """The pose of every row, by its time [s]: of the camera where its place on the body is given, else
    of the body. DatasetError, with its line, for a row that cannot be read.
    """
    names, values, sources = [], [], []
    for number, line in read_lines(path):
        where, words = f"{path}, line {number}", [word.strip() for word in line.split(",")]
        if len(words) < LEAST_COLUMNS or not words[0].isdecimal():
            raise DatasetError(
                f"{where}: expected nanoseconds, p x y z, q w x y z with commas, found '{line[:60]}'"
            )
        stamp = int(words[0][:19])
        names.append(f"{stamp // NANOSECONDS}.{stamp % NANOSECONDS:09}")
        values.append(parse_numbers(words[1:LEAST_COLUMNS], where))
        sources.append(where)
    if not values:
        raise DatasetError(f"{path}: holds no poses")
    poses = poses_from_quaternions(np.array(values)[:, [0, 1, 2, 4, 5, 6, 3]], sources)
    if T_body_camera is not None:
        poses = [pose.turned(T_body_camera) for pose in poses]
    return [PoseRow(pose, name) for pose, name in zip(poses, names, strict=True)]


def read_body_camera(path: Path) -> NDArray[np.float64]:
    """T_body_camera (4, 4) of a `sensor.yaml`, under T_BS, or of a file with 4 rows of 4 numbers."""
    if path.suffix.lower() not in (".yaml", ".yml"):
        rows = [parse_numbers(line.split(), str(path)) for _, line in read_lines(path)]
        return _rigid(numbers(rows, (4, 4), str(path)), path)
    try:
        values = read_yaml(path)
    except (FileError, InputError) as error:
        raise DatasetError(str(error)) from None
    found = values.get("T_BS", values.get("T_body_camera")) if isinstance(values, dict) else None
    data = found.get("data") if isinstance(found, dict) else found
    flat = isinstance(data, list) and len(data) == 16
    T = numbers(data, (16,) if flat else (4, 4), f"{path}: T_BS").reshape(4, 4)
    return _rigid(T, path)


def _rigid(T: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    try:
        return check_rigid(T, f"{path}: T_BS")
    except PoseError as error:
        raise DatasetError(str(error)) from None

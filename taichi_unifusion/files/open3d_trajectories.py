"""Trajectories as Open3D writes them: `.log` (also Redwood's), and `.json` of camera parameters."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, FileError
from ..geometry import se3
from .atomic import read_bytes
from .text_rows import parse_numbers, read_lines, split_row
from .trajectories import Pose

MAX_BYTES = 256 << 20  # of a file of poses; a million of them have 200 MB
LOG_ROWS = 5  # lines of a pose: three whole numbers, then a 4x4 matrix


def is_log(path: Path) -> bool:
    """Whether a file's first row is that of a `.log`: three numbers."""
    first = next(iter(read_lines(path)), (0, ""))[1]
    return len(split_row(first)) == 3


def read_log(path: Path) -> list[tuple[int, Pose]]:
    """Frame number and camera-to-world pose of every entry; DatasetError names the line where it is none."""
    lines = list(read_lines(path))
    if not lines or len(lines) % LOG_ROWS:
        raise DatasetError(
            f"{path}: {len(lines)} lines are no trajectory; every pose has {LOG_ROWS}: three numbers, then 4 rows "
            "of its matrix"
        )
    poses = []
    for at in range(0, len(lines), LOG_ROWS):
        source = f"{path}, line {lines[at][0]}"
        head = split_row(lines[at][1])
        if len(head) != 3 or not head[0].lstrip("-").isdigit():
            raise DatasetError(f"{source}: expected three numbers, found '{lines[at][1][:60]}'")
        rows = [split_row(line) for _, line in lines[at + 1 : at + LOG_ROWS]]
        if any(len(row) != 4 for row in rows):
            raise DatasetError(f"{source}: expected 4 rows of 4 numbers after it")
        numbers = [parse_numbers(row, source) for row in rows]
        poses.append((int(head[0][:18]), Pose(source, np.array(numbers))))
    return poses


def read_json(path: Path) -> Any:
    """What a JSON file holds; DatasetError where it cannot be read."""
    try:
        data = read_bytes(path)
    except FileError as error:
        raise DatasetError(str(error)) from None
    if len(data) > MAX_BYTES:
        raise DatasetError(f"{path}: {len(data)} bytes are more than any trajectory has")
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: not valid JSON ({str(error)[:100]})") from None


def read_json_trajectory(path: Path) -> list[Pose]:
    """Camera-to-world poses from a PinholeCameraTrajectory, which holds world-to-camera, column by column."""
    values = read_json(path)
    entries = values.get("parameters") if isinstance(values, dict) else None
    if not isinstance(entries, list) or not entries:
        raise DatasetError(f"{path}: not a trajectory of Open3D (no list 'parameters' in it)")
    return [_pose(entry, f"{path} entry {i}") for i, entry in enumerate(entries)]


def _pose(entry: Any, source: str) -> Pose:
    numbers = entry.get("extrinsic") if isinstance(entry, dict) else None
    try:
        T_camera_world = np.array(numbers, np.float64).reshape(4, 4).T
    except (ValueError, TypeError):
        return Pose(source, problem="'extrinsic' is not 16 numbers")
    if not np.isfinite(T_camera_world).all():
        return Pose(source, problem="holds NaN or infinite numbers")
    if not np.allclose(T_camera_world[3], (0, 0, 0, 1), atol=1e-6):
        return Pose(source, problem="'extrinsic' is no rigid motion in columns")
    return Pose(source, se3.inverse(T_camera_world))

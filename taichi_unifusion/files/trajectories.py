"""Trajectories in TUM's format, written and read."""

from __future__ import annotations

import math
import os

import numpy as np

from ..errors import DatasetError
from ..geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion
from ..types import Trajectory, check_rigid
from .atomic import atomic_write, read_bytes

# | |q| - 1 | of a quaternion in a file: 4 printed digits pass, a wrong column does not
UNIT_TOLERANCE = 1e-3


def write_trajectory(path: str | os.PathLike, trajectory: Trajectory) -> None:
    """Write camera-to-world poses atomically in TUM's format: `timestamp tx ty tz qx qy qz qw`,
    seconds and metres.

    Raises PoseError for a matrix that is no rigid transform, FileError where the file cannot be
    written.
    """
    poses = np.empty((len(trajectory), 4, 4))
    for i, T_world_camera in enumerate(trajectory.T_world_camera):
        poses[i] = check_rigid(T_world_camera, f"{path}: pose {i}")
    rows = np.hstack([poses[:, :3, 3], rotation_to_quaternion(poses[:, :3, :3])])
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    # 9 digits: a nanometre; time stamps without loss
    for timestamp, row in zip(trajectory.timestamps, rows, strict=True):
        lines.append(" ".join([repr(float(timestamp)), *(f"{value:.9f}" for value in row)]))
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_trajectory(path: str | os.PathLike) -> Trajectory:
    """Read camera-to-world poses in TUM's format, in time order; comments, BOM and CRLF are fine.

    Raises FileError where the file is missing, DatasetError, with the line, where it does not hold
    poses.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(
            f"{path}: not a text file; expected lines 'timestamp tx ty tz qx qy qz qw'"
        ) from None
    rows = [
        _parse_pose(line, f"{path}, line {number}")
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise DatasetError(
            f"{path}: holds no poses; expected lines 'timestamp tx ty tz qx qy qz qw'"
        )
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    T_world_camera = np.tile(np.eye(4), (len(table), 1, 1))
    T_world_camera[:, :3, :3] = quaternion_to_rotation(table[:, 4:])
    T_world_camera[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0].copy(), T_world_camera)


def _parse_pose(line: str, at: str) -> list[float]:
    """The 8 numbers of one line, or DatasetError."""
    words = line.split()
    try:
        row = [float(word) for word in words]
    except ValueError:
        raise DatasetError(f"{at}: expected 8 numbers, got '{line.strip()[:80]}'") from None
    if len(row) != 8 or not all(map(math.isfinite, row)):
        raise DatasetError(
            f"{at}: expected 8 finite numbers 'timestamp tx ty tz qx qy qz qw', got '{line.strip()[:80]}'"
        )
    length = math.hypot(*row[4:])
    if abs(length - 1) > UNIT_TOLERANCE:
        raise DatasetError(
            f"{at}: the quaternion has length {length:.4f}, not 1; are the columns qx qy qz qw?"
        )
    return row

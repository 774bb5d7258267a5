"""Poses in a `transforms.json`: `frames`, with `file_path` and `transform_matrix`, camera to world with
OpenGL's axes; `applied_transform` and `applied_scale` are undone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..geometry.se3 import FLIP_YZ
from .frame_files import stem_of
from .strict_json import list_of, number, numbers
from .trajectories import Pose, PoseRow


class Applied:
    """The motion and the scale that somebody has applied to all poses of a file."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self.scale = number(values, "applied_scale", where, 1.0)
        self.T_world_applied = np.eye(4)
        if "applied_transform" in values:
            T = _matrix(values["applied_transform"], f"{where}: applied_transform")
            if not np.isfinite(T).all() or abs(np.linalg.det(T)) < 1e-6:
                raise DatasetError(f"{where}: applied_transform cannot be undone")
            self.T_world_applied = np.linalg.inv(T)
        if not self.scale > 0:
            raise DatasetError(f"{where}: applied_scale must be above 0, found {self.scale:g}")

    def pose_of(self, frame: Mapping[str, Any], where: str) -> Pose:
        """The pose of a frame in the world before, with our axes."""
        try:
            T = _matrix(frame.get("transform_matrix"), f"{where}: transform_matrix")
        except DatasetError as error:
            return Pose(where, problem=str(error).removeprefix(f"{where}: "))
        T[:3, 3] /= self.scale
        return Pose(where, self.T_world_applied @ T @ FLIP_YZ)


def pose_rows(values: Mapping[str, Any], path: Path) -> list[PoseRow]:
    """The poses of all frames, by the names of their images without folder and suffix."""
    applied = Applied(values, str(path))
    frames = [each for each in list_of(values, "frames", str(path)) if isinstance(each, dict)]
    if not frames:
        raise DatasetError(f"{path}: holds no frames")
    return [
        PoseRow(applied.pose_of(frame, f"{path}: {name}"), stem_of(name))
        for frame in frames
        if (name := str(frame.get("file_path", "")))
    ]


def _matrix(rows: Any, where: str) -> NDArray[np.float64]:
    """4x4, of which the last row may be missing."""
    count = 3 if isinstance(rows, list) and len(rows) == 3 else 4
    T = np.eye(4)
    T[:count] = numbers(rows, (count, 4), where)
    return T

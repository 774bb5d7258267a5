"""Trajectories that other programs wrote: TUM, KITTI, Replica, or a folder of one matrix a frame
(ScanNet, 7-Scenes).

All camera to world in metres. TUM rows carry time stamps; the rows of KITTI (12 numbers) and
Replica (16) belong to frames 0, 1, 2 ... of the recording, the files of a folder to the number in
their names.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..datasets.listing import list_names
from ..errors import DatasetError, PoseError
from ..files.poses import Pose, matrix_from_row, read_lines, read_matrix_file, split_row, tum_row

FORMATS = {
    8: "TUM (timestamp tx ty tz qx qy qz qw)",
    12: "KITTI (the first 3 rows of a 4x4 matrix)",
    16: "Replica (a 4x4 matrix)",
}  # by the number of columns


@dataclass(frozen=True)
class ExternalPoses:
    """Poses by time stamp [s] or, where a format has none, by frame number, in order; and what was
    wrong with others.
    """

    source: str
    by_time: bool
    keys: NDArray[np.float64]  # (N,) ascending
    T_world_camera: NDArray[np.float64]  # (N, 4, 4)
    warnings: tuple[str, ...] = ()
    # frame numbers are those in the names of files, not places in the recording
    by_name: bool = False


def read_poses(path: str | Path) -> ExternalPoses:
    """Read a trajectory; the number of columns tells its format.

    Raises DatasetError, with the line, where it holds no poses; a single pose that is not rigid is
    left out and said.
    """
    path = Path(path).expanduser()
    if path.is_dir():
        poses = _checked(
            path, False, [(number, read_matrix_file(file)) for number, file in _numbered(path)]
        )
        return replace(poses, by_name=True)
    rows = [(split_row(line), f"{path} line {number}") for number, line in read_lines(path)]
    if not rows:
        raise DatasetError(f"{path}: holds no poses")
    columns, where = len(rows[0][0]), rows[0][1]
    if columns == 8:
        stamped = [tum_row(*row) for row in rows]
        for row in stamped:
            if row.timestamp is None:
                raise DatasetError(f"{row.source}: '{row.name}' is not a time stamp")
        return _checked(path, True, [(row.timestamp, row.pose()) for row in stamped])
    if columns not in FORMATS:
        known = ", ".join(f"{count}: {name}" for count, name in FORMATS.items())
        raise DatasetError(f"{where}: a row has {columns} numbers; known are {known}")
    last = ["0", "0", "0", "1"] if columns == 12 else []
    return _checked(
        path,
        False,
        [
            (number, matrix_from_row(_of_length(words, columns, at) + last, at))
            for number, (words, at) in enumerate(rows)
        ],
    )


def _of_length(words: list[str], columns: int, where: str) -> list[str]:
    if len(words) != columns:
        raise DatasetError(
            f"{where}: expected {columns} numbers as in the first row, found {len(words)}"
        )
    return words


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    """Pose files of a folder with the number in their name: 12.txt, frame-000012.pose.txt."""
    found = [
        (int(match[1]), folder / name)
        for name in list_names(folder)
        if (match := re.fullmatch(r"(?:[A-Za-z_-]*?)(\d+)(?:\.pose)?\.txt", name))
    ]
    if not found:
        raise DatasetError(f"{folder}: no N.txt or frame-N.pose.txt here")
    return sorted(found)


def _checked(path: Path, by_time: bool, poses: Sequence[tuple[float, Pose]]) -> ExternalPoses:
    keys, matrices, problems = [], [], []
    for key, pose in sorted(poses, key=lambda item: item[0]):
        try:
            T_world_camera = pose.checked()
        except PoseError as error:
            problems.append(str(error))
            continue
        if keys and key == keys[-1]:
            problems.append(f"{pose.source}: {key!r} appears again; the first counts")
            continue
        keys.append(float(key))
        matrices.append(T_world_camera)
    if not keys:
        raise DatasetError(f"{path}: holds no usable pose (first: {problems[0]})")
    warnings = [f"{len(problems)} poses left out (first: {problems[0]})"] if problems else []
    return ExternalPoses(str(path), by_time, np.array(keys), np.array(matrices), tuple(warnings))

"""Trajectories that other programs wrote: TUM, KITTI, Replica, COLMAP, EuRoC, Redwood and Open3D,
`transforms.json`, or a folder of one matrix a frame (ScanNet, 7-Scenes).

All camera to world in metres. Rows of TUM and EuRoC carry time stamps; those of KITTI (12 numbers),
Replica (16) and Redwood belong to frames 0, 1, 2 ... of the recording, the files of a folder and the
images of COLMAP and of a `transforms.json` to the frame with the number in their names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..datasets.pose_rows import say_unit
from ..errors import DatasetError, PoseError
from ..files.frame_files import list_names, number_of
from ..files.pose_files import colmap_file, read_pose_list
from ..files.trajectories import Pose, PoseRow, read_pose_file, stamped


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


def read_poses(path: str | Path, body_camera: Path | None = None) -> ExternalPoses:
    """Read a trajectory in any of the formats of `files.pose_files`; `body_camera` is the file that
    says where the camera sits on the body of EuRoC's poses.

    Raises DatasetError, with the line, where it holds no poses; a single pose that is not rigid is
    left out, which a warning says.
    """
    path = Path(path).expanduser()
    model = colmap_file(path) if path.is_dir() else None
    if path.is_dir() and model is None:
        poses = _checked(
            path, False, [(number, read_pose_file(file)) for number, file in _numbered(path)]
        )
        return replace(poses, by_name=True)
    path = model or path
    listed = read_pose_list(path, body_camera)
    rows, warnings = listed.rows, [*listed.warnings]
    if listed.key == "place":
        poses = _checked(path, False, [(number, row.pose) for number, row in enumerate(rows)])
    elif listed.key == "name":
        poses = replace(_checked(path, False, _by_number(rows, path)), by_name=True)
    else:
        timed = stamped(rows)
        poses = _checked(path, True, [(row.timestamp, row.pose) for row in timed])
        say_unit(path, timed[0].unit, warnings)
    return replace(poses, warnings=(*warnings, *poses.warnings))


def _by_number(rows: Sequence[PoseRow], path: Path) -> list[tuple[int, Pose]]:
    """Poses that images are named for, by the numbers in those names."""
    numbered = [(number_of(row.name), row) for row in rows]
    found: dict[int, PoseRow] = {}
    for number, row in numbered:
        if number is None:
            raise DatasetError(
                f"{row.pose.source}: there is no number in the name '{row.name[:60]}'"
            )
        if found.setdefault(number, row) is not row:
            raise DatasetError(
                f"{path}: the images '{found[number].name[:60]}' and '{row.name[:60]}' have one number; rename them"
            )
    return [(number, row.pose) for number, row in found.items()]


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    """Pose files of a folder with the number in their name: 12.txt, frame-000012.pose.txt."""
    found = [
        (number, folder / name)
        for name in list_names(folder)
        if name.endswith(".txt") and (number := number_of(name)) is not None
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
    warnings = ()
    if problems:
        warnings = (
            f"{path}: {len(problems)} of {len(poses)} poses left out (first: {problems[0]})",
        )
    return ExternalPoses(str(path), by_time, np.array(keys), np.array(matrices), warnings)

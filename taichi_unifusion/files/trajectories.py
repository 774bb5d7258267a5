"""Camera poses as text, camera to world in metres: TUM, KITTI, Replica, or one matrix a file.

One reader for all of them. Columns are separated by blanks or commas; comments, empty lines, a
byte-order mark and any line end are accepted; the first row decides how many columns all have.
What is not a row of numbers is a DatasetError with its line. A pose that cannot be used (not
finite, not rigid, a quaternion whose length is not 1 within UNIT_TOLERANCE) is kept with the
reason, so that it costs its own frame only. Rows keep the order of the file: who joins them to
frames by time stamp takes the first of equal stamps.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, PoseError
from ..geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion
from ..geometry.time_stamps import SECONDS, to_nanoseconds, unit_of
from ..types import Trajectory, check_rigid
from .atomic import atomic_write, read_bytes
from .text_rows import finite_or_none, is_stamp, parse_lines, parse_numbers, read_lines, split_row

# of a quaternion's length: four printed digits pass, a wrong column does not
UNIT_TOLERANCE = 1e-3
TUM, KITTI, REPLICA = 8, 12, 16  # columns
ROWS = {
    TUM: "timestamp tx ty tz qx qy qz qw",
    KITTI: "the first 3 rows of a 4x4 matrix",
    REPLICA: "a 4x4 matrix",
}


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

    def turned(self, T: NDArray[np.float64]) -> Pose:
        """The pose of a camera whose axes are those of this one times T."""
        if self.T_world_camera is None:
            return self
        return Pose(self.source, self.T_world_camera @ T)

    @property
    def usable(self) -> NDArray[np.float64] | None:
        """T_world_camera as a rigid transform, None where it cannot be used."""
        try:
            return self.checked()
        except PoseError:
            return None


@dataclass(frozen=True)
class PoseRow:
    """A row of a trajectory file: its pose and, in TUM's format, whose it is."""

    pose: Pose
    name: str = ""  # first column of a TUM row: a time stamp, or the name of a frame

    @property
    def timestamp(self) -> float | None:
        """The name as a time stamp [s], if it is a finite number."""
        return finite_or_none(self.name)


@dataclass(frozen=True)
class StampedPose:
    """A pose and its time stamp."""

    nanoseconds: int
    pose: Pose
    unit: str = SECONDS  # that the file has its stamps in

    @property
    def timestamp(self) -> float:
        """The time stamp [s]."""
        return self.nanoseconds / 10**9


def read_pose_rows(path: Path, columns: Collection[int] = tuple(ROWS)) -> list[PoseRow]:
    """The rows of a trajectory file with one of these numbers of columns.

    Raises DatasetError where the file cannot be read, holds no rows, or a row has another number
    of columns.
    """
    return _parse_pose_rows(list(read_lines(path)), str(path), columns)


def read_stamped_poses(path: Path) -> list[StampedPose]:
    """TUM rows, as `read_pose_rows`; DatasetError too where a first column is no time stamp."""
    return stamped(read_pose_rows(path, (TUM,)))


def stamped(rows: Sequence[PoseRow]) -> list[StampedPose]:
    """The rows with their time stamps, whatever their unit; DatasetError for the first that has
    none.
    """
    for row in rows:
        if not is_stamp(row.name):
            raise DatasetError(f"{row.pose.source}: '{row.name}' is not a time stamp")
    unit = unit_of([row.name for row in rows])
    return [StampedPose(to_nanoseconds(row.name, unit), row.pose, unit) for row in rows]


def read_pose_file(path: Path) -> Pose:
    """The row-major 4x4 matrix that fills the file; whatever is wrong with it stays with this pose."""
    if not os.path.exists(path):  # unlike Path.exists it answers for any name
        return Pose(str(path), problem="no such file, this frame has no pose")
    try:
        words = [word for _, line in read_lines(path) for word in split_row(line)]
        numbers = parse_numbers(words, str(path))
    except DatasetError as error:
        return Pose(str(path), problem=f"not a pose file ({str(error).removeprefix(f'{path}: ')})")
    if len(numbers) != REPLICA:
        return Pose(str(path), problem=f"expected a 4x4 matrix, found {len(numbers)} numbers")
    return Pose(str(path), np.array(numbers).reshape(4, 4))


def read_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Read camera-to-world poses in TUM's format, in time order; every pose must be usable.

    Raises FileError where the file is missing, DatasetError, with the line, where it does not hold
    poses, PoseError for one that is not rigid.
    """
    lines = list(parse_lines(read_bytes(path), str(path)))
    rows = stamped(_parse_pose_rows(lines, str(path), (TUM,)))
    rows.sort(key=lambda row: row.nanoseconds)
    return Trajectory(
        np.array([row.timestamp for row in rows]), np.array([row.pose.checked() for row in rows])
    )


def write_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Write camera-to-world poses atomically in TUM's format: `timestamp tx ty tz qx qy qz qw`,
    seconds and metres.

    Raises PoseError for a matrix that is no rigid transform, FileError where the file cannot be
    written.
    """
    poses = np.empty((len(trajectory), 4, 4))
    for i, T_world_camera in enumerate(trajectory.T_world_camera):
        poses[i] = check_rigid(T_world_camera, f"{path}: pose {i}")
    rows = np.hstack([poses[:, :3, 3], rotation_to_quaternion(poses[:, :3, :3])])
    lines = [f"# {ROWS[TUM]}"]
    # 9 digits: a nanometre; time stamps without loss
    for timestamp, row in zip(trajectory.timestamps, rows, strict=True):
        lines.append(" ".join([repr(float(timestamp)), *(f"{value:.9f}" for value in row)]))
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _parse_pose_rows(
    lines: Sequence[tuple[int, str]], path: str, columns: Collection[int]
) -> list[PoseRow]:
    """The rows of the numbered lines, which all have as many columns as the first."""
    if not lines:
        raise DatasetError(f"{path}: holds no poses; expected rows of {_expected(columns)}")
    sources = [f"{path}, line {number}" for number, _ in lines]
    words = [split_row(line) for _, line in lines]
    allowed = columns
    for row, source in zip(words, sources, strict=True):
        if len(row) not in allowed:
            raise DatasetError(f"{source}: expected {_expected(allowed)}, found {len(row)}")
        allowed = (len(row),)
    named = len(words[0]) == TUM
    names = [row[0] if named else "" for row in words]
    numbers = np.array(
        [parse_numbers(row[named:], source) for row, source in zip(words, sources, strict=True)]
    )
    poses = poses_from_quaternions(numbers, sources) if named else _from_matrices(numbers, sources)
    return [PoseRow(pose, name) for pose, name in zip(poses, names, strict=True)]


def _expected(columns: Collection[int]) -> str:
    return " or ".join(f"{count} columns ({ROWS[count]})" for count in columns)


def poses_from_quaternions(numbers: NDArray[np.float64], sources: Sequence[str]) -> list[Pose]:
    """Poses of rows tx ty tz qx qy qz qw, (N, 7), and where each of them stands."""
    lengths = np.linalg.norm(numbers[:, 3:], axis=1)
    usable = np.isfinite(numbers).all(axis=1) & (np.abs(lengths - 1) <= UNIT_TOLERANCE)
    T_world_camera = np.tile(np.eye(4), (len(numbers), 1, 1))
    T_world_camera[usable, :3, :3] = quaternion_to_rotation(numbers[usable, 3:])
    T_world_camera[:, :3, 3] = numbers[:, :3]
    poses = []
    for T, length, good, source in zip(T_world_camera, lengths, usable, sources, strict=True):
        if good:
            poses.append(Pose(source, T))
        elif not np.isfinite(length) or not np.isfinite(T).all():
            poses.append(Pose(source, problem="holds NaN or infinite numbers"))
        else:
            poses.append(
                Pose(
                    source,
                    problem=f"the quaternion's length is {length:.4f}, not 1; are the columns "
                    "tx ty tz qx qy qz qw?",
                )
            )
    return poses


def _from_matrices(numbers: NDArray[np.float64], sources: Sequence[str]) -> list[Pose]:
    """Poses of row-major 4x4 matrices, (N, 16), or of their first three rows, (N, 12)."""
    T_world_camera = np.tile(np.eye(4), (len(numbers), 1, 1))
    T_world_camera[:, : numbers.shape[1] // 4] = numbers.reshape(len(numbers), -1, 4)
    return [Pose(source, T) for T, source in zip(T_world_camera, sources, strict=True)]

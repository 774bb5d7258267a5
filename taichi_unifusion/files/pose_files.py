"""Poses from whatever wrote them: the file's name and its first row tell.

TUM, KITTI, Replica (trajectories.py), COLMAP's `images.txt` and `images.bin`, EuRoC's `data.csv`,
`transforms.json`, Redwood's and Open3D's `.log` and `.json`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

from ..errors import DatasetError
from .colmap import is_colmap_text, read_colmap
from .euroc import is_euroc, read_body_camera, read_euroc
from .open3d_trajectories import is_log, read_json_trajectory, read_log
from .strict_json import read_object
from .text_rows import read_lines, split_row
from .trajectories import PoseRow, read_pose_rows
from .transforms import pose_rows

COLMAP = ("images.bin", "images.txt")  # in a folder of a model
# by what a row belongs to a frame: its time stamp, the name of an image, or the row's place among all
Key = Literal["time", "name", "place"]


@dataclass(frozen=True)
class PoseFile:
    """The rows of a file, camera to world in metres."""

    key: Key
    rows: list[PoseRow]
    warnings: tuple[str, ...] = ()


def colmap_file(folder: Path) -> Path | None:
    """The poses of a folder that is a model of COLMAP; None for another folder."""
    return next((folder / name for name in COLMAP if (folder / name).is_file()), None)


def read_pose_list(path: Path, body_camera: Path | None = None) -> PoseFile:
    """The poses in a file of any of the formats; `body_camera` is the file that says where the camera
    sits on the body of EuRoC's poses. Raises DatasetError, with the line, where it holds none.
    """
    euroc = path.suffix.lower() == ".csv" and is_euroc(path)
    if body_camera is not None and not euroc:
        raise DatasetError(
            f"{path}: its poses are a camera's; where one sits on a body is for EuRoC's data.csv alone"
        )
    if euroc:
        return _euroc(path, body_camera)
    if path.suffix.lower() == ".json":
        values = read_object(path)
        if "parameters" in values:
            return PoseFile("place", [PoseRow(pose) for pose in read_json_trajectory(path)])
        return PoseFile("name", pose_rows(values, path))
    if path.suffix.lower() == ".bin" or is_colmap_text(path):
        return PoseFile(
            "name",
            read_colmap(path),
            (f"{path}: COLMAP's unit is taken as a metre, which holds for a scaled model only",),
        )
    if path.suffix.lower() == ".log" or (is_log(path) and _has_blocks(path)):
        return _log(path)
    rows = read_pose_rows(path)
    return PoseFile("time" if rows[0].name else "place", rows)


def _has_blocks(path: Path) -> bool:
    """Whether a row of three numbers is followed by one of four."""
    rows = [split_row(line) for _, line in islice(read_lines(path), 2)]
    return [len(row) for row in rows] == [3, 4]


def _euroc(path: Path, body_camera: Path | None) -> PoseFile:
    T_body_camera = None if body_camera is None else read_body_camera(body_camera)
    warnings = (
        f"{path}: its poses are a body's and are taken as the camera's; the camera's sensor.yaml says where it "
        "sits on the body",
    )
    rows = read_euroc(path, T_body_camera)
    return PoseFile("time", rows, warnings if T_body_camera is None else ())


def _log(path: Path) -> PoseFile:
    """A `.log`, whose entries say the numbers of their frames."""
    entries = read_log(path)
    if [number for number, _ in entries] != list(range(len(entries))):
        first = next(i for i, (number, _) in enumerate(entries) if i != number)
        raise DatasetError(
            f"{path}: entry {first} is for frame {entries[first][0]}; its entries must be for frames 0, 1, 2 ..."
        )
    return PoseFile("place", [PoseRow(pose) for _, pose in entries])

"""Stray Scanner (iPhone and iPad with LiDAR): a folder with `rgb.mp4`, `depth/`, `odometry.csv` and
`camera_matrix.csv`.

`rgb.mp4` is HEVC, `depth/NNNNNN.png` 16 bits, millimetres, smaller, of the same view (old versions:
`.npy` of such integers), `confidence/NNNNNN.png` 0, 1 or 2. `odometry.csv` has the columns
`timestamp, frame, x, y, z, qx, qy, qz, qw`, or in old versions `x` to `qw` alone, a row for every
frame: camera to world in metres, camera x right, y down, z forward. Frame N is picture N of the video
and depth image N. `camera_matrix.csv` is K of the video's pictures, for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..files.frame_files import list_names, numbered_files
from ..files.images import read_depth, read_levels
from ..files.text_rows import parse_numbers, read_lines, split_row
from ..files.trajectories import Pose, poses_from_quaternions
from ..files.video_reading import VideoPictures
from .depth_camera import read_matrix_camera
from .depth_registration import LensCamera
from .file_recording import check_depth_scale
from .shared_view import ARKIT_UP, Confidence, SharedView, Shot

DEPTH_SCALE = 1000.0
VIDEO, ODOMETRY, MATRIX = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
PICTURE = (1920, 1440)  # of a recording whose video is missing
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
COLUMNS = {7: POSE_COLUMNS, 9: ("timestamp", "frame", *POSE_COLUMNS)}  # without a header


def open_strayscanner(
    path: Path,
    *,
    depth_scale: float | None = None,
    min_confidence: int = 1,
    weigh_confidence: bool = False,
    color_detail: int = 1,
) -> SharedView:
    """The frames of a scan's folder; a frame is a row of odometry.csv that has a depth image."""
    confidence = Confidence(min_confidence, weigh_confidence)
    names = list_names(path)
    missing = [name for name in (MATRIX, "depth") if name not in names]
    if missing:
        raise DatasetError(
            f"{path}: no {' and no '.join(missing)} here; a scan has rgb.mp4, depth/, odometry.csv and "
            "camera_matrix.csv"
        )
    scale = DEPTH_SCALE if depth_scale is None else check_depth_scale(depth_scale, str(path))
    depth = numbered_files(path / "depth", r"(\d{1,9})\.(?:png|npy)")
    if not depth:
        raise DatasetError(f"{path / 'depth'}: no NNNNNN.png and no NNNNNN.npy here")
    sure = numbered_files(path / "confidence", r"(\d{1,9})\.png") if "confidence" in names else {}
    warnings, no_poses = [], ""
    if ODOMETRY in names:
        rows = _odometry(path / ODOMETRY)
        kept = [row for row in rows if row.frame in depth]
        if not kept:
            raise DatasetError(f"{path}: none of {len(rows)} rows of {ODOMETRY} has a depth image")
        if len(kept) < max(len(rows), len(depth)):
            warnings.append(
                f"{len(rows)} poses and {len(depth)} depth images; the {len(kept)} frames that have both are used"
            )
    else:
        kept = [Row(frame, None, None) for frame in sorted(depth)]
        no_poses = f"{path / ODOMETRY}: no such file"
    video = VideoPictures(path / VIDEO) if VIDEO in names else None
    if video is None:
        warnings.append(f"no {VIDEO} here, so the frames have no colour")
    lens = LensCamera(read_matrix_camera(path / MATRIX, video.size if video else PICTURE), ())
    shots = [
        Shot(
            f"{path / 'depth'}/{depth[row.frame].name}",
            lambda: lens,
            partial(read_depth, depth[row.frame], scale),
            partial(video.read, row.frame) if video else None,
            partial(read_levels, sure[row.frame]) if row.frame in sure else None,
            row.pose,
            row.timestamp,
        )
        for row in kept
    ]
    return SharedView(
        f"strayscanner {path}",
        shots,
        confidence=confidence,
        detail=color_detail,
        up=ARKIT_UP,
        warnings=warnings,
        no_poses=no_poses,
    )


@dataclass(frozen=True)
class Row:
    """A row of odometry.csv: which frame, when [s], and from where."""

    frame: int
    timestamp: float | None
    pose: Pose | None


def _odometry(file: Path) -> list[Row]:
    """The rows, the first of each frame."""
    lines = list(read_lines(file))
    if not lines:
        raise DatasetError(f"{file}: holds no poses")
    first = split_row(lines[0][1])
    named = "qw" in first
    columns = tuple(first) if named else COLUMNS.get(len(first), ())
    lines = lines[1:] if named else lines
    if not set(POSE_COLUMNS) <= set(columns):
        raise DatasetError(
            f"{file}: expected columns {', '.join(COLUMNS[9])}, found '{lines[0][1][:60] if lines else ''}'"
        )
    sources = [f"{file}, line {number}" for number, _ in lines]
    values = np.empty((len(lines), len(columns)))
    for i, (_, line) in enumerate(lines):
        words = split_row(line)
        if len(words) != len(columns):
            raise DatasetError(f"{sources[i]}: expected {len(columns)} columns, found {len(words)}")
        values[i] = parse_numbers(words, sources[i])
    at = {name: i for i, name in enumerate(columns)}
    poses = poses_from_quaternions(values[:, [at[name] for name in POSE_COLUMNS]], sources)
    return _numbered(values, at, poses)


def _numbered(values: NDArray[np.float64], at: dict[str, int], poses: list[Pose]) -> list[Row]:
    """Rows with the frame that each belongs to: by its column, else by its place."""
    rows: dict[int, Row] = {}
    for i, pose in enumerate(poses):
        frame = values[i, at["frame"]] if "frame" in at else i
        stamp = values[i, at["timestamp"]] if "timestamp" in at else np.nan
        if not 0 <= frame < 1e9:
            continue
        row = Row(int(frame), float(stamp) if np.isfinite(stamp) else None, pose)
        rows.setdefault(row.frame, row)
    return [rows[frame] for frame in sorted(rows)]

"""ARKitScenes: the folder of a video, `lowres_wide/`, `lowres_depth/`, `confidence/`,
`lowres_wide_intrinsics/` and `lowres_wide.traj`.

Images are `VIDEO_T.png` with T in seconds: colour and depth of one view (256x192), depth in 16 bits,
millimetres, confidence 0, 1 or 2. `VIDEO_T.pincam` holds `w h fx fy cx cy` of an image, whose T may
differ by a millisecond. Rows of the trajectory are `T rx ry rz tx ty tz`: world to camera, the rotation
as its axis times its angle, metres, camera x right, y down, z forward; they are inverted. Frames are the
depth images that have a pose within max_difference, a sixth of those of a video.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from ..files.frame_files import list_names
from ..files.images import read_color, read_depth, read_levels
from ..files.text_rows import finite_or_none, parse_numbers, read_lines, split_row
from ..files.trajectories import Pose
from ..geometry import se3
from ..geometry.time_stamps import check_max_difference, nearest
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .file_recording import check_depth_scale
from .shared_view import Confidence, SharedView, Shot

DEPTH_SCALE = 1000.0
MAX_DIFFERENCE = 0.005  # [s] between an image and its pose
SAME_TIME = 0.0015  # [s] between an image and what else is named after its time
TRAJECTORY = "lowres_wide.traj"
_NAME = re.compile(r".*_([0-9.]+)\.(?:png|pincam)")


def open_arkitscenes(
    path: Path,
    *,
    depth_scale: float | None = None,
    max_difference: float = MAX_DIFFERENCE,
    min_confidence: int = 1,
    weigh_confidence: bool = False,
    color_detail: int = 1,
) -> SharedView:
    """The frames of a video's folder."""
    confidence = Confidence(min_confidence, weigh_confidence)
    check_max_difference(max_difference)
    scale = DEPTH_SCALE if depth_scale is None else check_depth_scale(depth_scale, str(path))
    depth = _stamped(path / "lowres_depth")
    if not depth:
        raise DatasetError(f"{path / 'lowres_depth'}: no VIDEO_T.png here")
    color, cameras, sure = (
        _stamped(path / folder)
        for folder in ("lowres_wide", "lowres_wide_intrinsics", "confidence")
    )
    stamps = np.array(sorted(depth))
    warnings, no_poses, poses = [], "", [None] * len(stamps)
    trajectory = path / TRAJECTORY
    if trajectory.exists():
        poses = _poses_at(stamps, trajectory, max_difference)
        kept = [i for i, pose in enumerate(poses) if pose is not None]
        if not kept:
            raise DatasetError(f"{trajectory}: no pose within {max_difference} s of a depth image")
        if len(kept) < len(stamps):
            warnings.append(
                f"{len(stamps) - len(kept)} of {len(stamps)} depth images have no pose within {max_difference} s, left "
                "out"
            )
        stamps, poses = stamps[kept], [poses[i] for i in kept]
    else:
        no_poses = f"{trajectory}: no such file"
    shots = []
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        image, level = _near(color, stamp), _near(sure, stamp)
        shots.append(
            Shot(
                str(depth[stamp]),
                partial(_lens, _near(cameras, stamp), str(depth[stamp])),
                partial(read_depth, depth[stamp], scale),
                partial(read_color, image) if image else None,
                partial(read_levels, level) if level else None,
                pose,
                stamp,
            )
        )
    return SharedView(
        f"arkitscenes {path}",
        shots,
        confidence=confidence,
        detail=color_detail,
        warnings=warnings,
        no_poses=no_poses,
    )


def _stamped(folder: Path) -> dict[float, Path]:
    """Time stamp [s] -> file in a folder; none where it does not exist."""
    found: dict[float, Path] = {}
    for name in list_names(folder) if folder.is_dir() else ():
        match = _NAME.fullmatch(name)
        stamp = finite_or_none(match[1]) if match else None
        if stamp is not None:
            found[stamp] = folder / name
    return found


def _near(files: dict[float, Path], stamp: float) -> Path | None:
    """The file of a time, whose stamp may differ in its last digit."""
    if stamp in files:
        return files[stamp]
    for step in (-0.001, 0.001):
        if (near := round(stamp + step, 3)) in files:
            return files[near]
    return None


def _lens(file: Path | None, where: str) -> LensCamera:
    """The camera that a .pincam file holds."""
    if file is None:
        raise FrameError(f"{where}: no .pincam file within a millisecond of its time")
    try:
        words = [word for _, line in read_lines(file) for word in split_row(line)]
        numbers = parse_numbers(words, str(file))
        if len(numbers) != 6:
            raise DatasetError(f"{file}: expected w h fx fy cx cy, found {len(numbers)} numbers")
        if not all(0 < side < 1e5 for side in numbers[:2]):
            raise DatasetError(f"{file}: images of {numbers[0]:g}x{numbers[1]:g} make no sense")
        size = int(numbers[0]), int(numbers[1])
        return LensCamera(make_camera(str(file), size, *numbers[2:]), ())
    except DatasetError as error:
        raise FrameError(str(error)) from None


def _poses_at(stamps: NDArray[np.float64], file: Path, max_difference: float) -> list[Pose | None]:
    """The pose of every time, None where there is none near enough."""
    rows, sources = [], []
    for number, line in read_lines(file):
        words = split_row(line)
        if len(words) != 7:
            raise DatasetError(
                f"{file}, line {number}: expected T rx ry rz tx ty tz, found {len(words)} columns"
            )
        rows.append(parse_numbers(words, f"{file}, line {number}"))
        sources.append(f"{file}, line {number}")
    if not rows:
        raise DatasetError(f"{file}: holds no poses")
    values = np.array(rows)
    order = np.argsort(values[:, 0], kind="stable")
    order = order[np.isfinite(values[order, 0])]
    if not len(order):
        raise DatasetError(f"{file}: holds no poses with a time")
    times = values[order, 0]
    found = nearest(times, stamps)
    return [
        _pose(values[order[at]], sources[order[at]])
        if abs(times[at] - stamp) <= max_difference
        else None
        for at, stamp in zip(found, stamps, strict=True)
    ]


def _pose(row: NDArray[np.float64], source: str) -> Pose:
    if not np.isfinite(row).all():
        return Pose(source, problem="holds NaN or infinite numbers")
    T_camera_world = se3.exp(np.array([0.0, 0.0, 0.0, *row[1:4]]))
    T_camera_world[:3, 3] = row[4:]
    return Pose(source, se3.inverse(T_camera_world))

"""Recordings of Open3D's reconstruction system and of Redwood: `color/` (or `rgb/`, `image/`), `depth/`, a
camera and a trajectory.

Depth: 16-bit PNG, 1000 units a metre. Camera: `intrinsic.json` or `camera_intrinsic.json` (width, height,
intrinsic_matrix column by column), else the default of a PrimeSense, 525 525 319.5 239.5. Poses: a `.log`
(three numbers, then a camera-to-world matrix, for every frame), Open3D's `.json` of camera parameters
(world-to-camera, column by column), or a `.txt` with rows `timestamp tx ty tz qx qy qz qw`, one for every
frame. Depth and colour belong together by the number that their names begin with, else by their order.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..files.frame_files import files_by_stem, in_order, list_names
from ..files.open3d_trajectories import is_log, read_json, read_json_trajectory, read_log
from ..files.trajectories import Pose, read_stamped_poses
from ..types import PinholeCamera
from .depth_camera import check_size, make_camera
from .file_recording import FrameFiles, Recording, depth_size

DEPTH_SCALE = 1000.0
COLOR_FOLDERS = ("color", "rgb", "image")
CAMERA_FILES = ("intrinsic.json", "camera_intrinsic.json", "camera_primesense.json")
PRIMESENSE = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
TRAJECTORIES = ("trajectory.log", "trajectory.json", "trajectory.txt", "scene/trajectory.log")


def open_open3d(
    path: Path,
    *,
    trajectory: Path | None = None,
    depth_scale: float | None = None,
    camera: PinholeCamera | None = None,
    drop_alpha: bool = False,
) -> Recording:
    """The recording in folder `path`; `trajectory` names the file of poses where there are several."""
    names = list_names(path)
    if "depth" not in names:
        raise DatasetError(
            f"{path}: no depth/ here; a recording of Open3D or Redwood has depth/, color/ (or rgb/, image/), a "
            "camera and a trajectory"
        )
    depth = _images(path / "depth", (".png",))
    if not depth:
        raise DatasetError(f"{path / 'depth'}: no *.png here")
    folder = next((path / name for name in COLOR_FOLDERS if name in names), None)
    color = _images(folder, (".jpg", ".jpeg", ".png")) if folder else []
    warnings: list[str] = []
    partners = _partners(depth, color, warnings)
    source = _trajectory(path, trajectory)
    poses = [None] * len(depth) if source is None else _read_poses(source, len(depth))
    frames = [
        FrameFiles(image, partner, pose)
        for image, partner, pose in zip(depth, partners, poses, strict=True)
    ]
    return Recording(
        f"open3d {path}",
        frames,
        _camera(path, camera, depth_size(frames), warnings),
        DEPTH_SCALE if depth_scale is None else depth_scale,
        fit_color=True,
        drop_alpha=drop_alpha,
        warnings=warnings,
        no_poses="" if source else f"{path}: no trajectory (.log, .json or .txt) here",
    )


def _images(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    found = files_by_stem(folder, suffixes)
    return [found[stem] for stem in in_order(found)]


def _partners(
    depth: Sequence[Path], color: Sequence[Path], warnings: list[str]
) -> list[Path | None]:
    """The colour image of every depth image; None for all where there is no colour."""
    if not color:
        return [None] * len(depth)
    by_stem = {image.stem: image for image in color}
    if all(image.stem in by_stem for image in depth):
        return [by_stem[image.stem] for image in depth]
    numbers = [_number(image) for image in color]
    by_number = dict(zip(numbers, color, strict=True))
    if None not in by_number and len(by_number) == len(color) and None not in map(_number, depth):
        found = [by_number.get(_number(image)) for image in depth]
        if any(found):
            lacking = sum(image is None for image in found)
            if lacking:
                warnings.append(f"{lacking} of {len(depth)} depth images have no colour image")
            return found
    if len(depth) == len(color):
        return list(color)
    raise DatasetError(
        f"{depth[0].parent}: {len(depth)} depth and {len(color)} colour images whose names do not match; give "
        "those of a frame the same name or number"
    )


def _number(image: Path) -> int | None:
    """The number that a name begins with, as in 000001-000000033369.jpg."""
    found = re.match(r"[0-9]{1,18}", image.name)
    return int(found[0]) if found else None


def _trajectory(path: Path, given: Path | None) -> Path | None:
    """The file of poses: given, or the only one that could be meant."""
    if given is not None:
        return path / given if (path / given).exists() else Path(given)
    known = [path / name for name in TRAJECTORIES if (path / name).exists()]
    if known:
        return known[0]
    others = [
        path / name
        for name in list_names(path)
        if name.endswith((".log", "traj.txt", "trajectory.json", "groundtruth.txt"))
    ]
    if len(others) > 1:
        names = ", ".join(each.name for each in others)
        raise DatasetError(
            f"{path}: several files could be the trajectory; name one with --option trajectory=, of {names}"
        )
    return others[0] if others else None


def _read_poses(file: Path, frames: int) -> list[Pose]:
    """The pose of every frame."""
    if file.suffix.lower() == ".json":
        found = dict(enumerate(read_json_trajectory(file)))
    elif is_log(file):
        entries = read_log(file)
        numbers = [number for number, _ in entries]
        whole = len(entries) == frames or len(set(numbers)) < len(numbers)
        found = {i if whole else number: pose for i, (number, pose) in enumerate(entries)}
    else:
        found = {i: row.pose for i, row in enumerate(read_stamped_poses(file))}
    return [
        found.get(i) or Pose(str(file), problem=f"no pose for frame {i}") for i in range(frames)
    ]


def _camera(
    path: Path, given: PinholeCamera | None, size: tuple[int, int], warnings: list[str]
) -> PinholeCamera:
    if given is not None:
        return check_size(given, size, "camera")
    file = next((path / name for name in CAMERA_FILES if (path / name).exists()), None)
    if file is None:
        if size != PRIMESENSE.size:
            raise DatasetError(
                f"{path}: no intrinsic.json here, and {size[0]}x{size[1]} is not the size of a PrimeSense's images"
            )
        warnings.append(
            f"{path}: no intrinsic.json here; intrinsics assumed: a PrimeSense's, 525 525 319.5 239.5"
        )
        return PRIMESENSE
    values = read_json(file)
    try:
        K = np.array(values["intrinsic_matrix"], np.float64).reshape(3, 3).T
        own = int(values["width"]), int(values["height"])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise DatasetError(
            f"{file}: expected width, height and intrinsic_matrix, 9 numbers column by column"
        ) from None
    if not K[0, 2] or not K[1, 2]:
        raise DatasetError(f"{file}: intrinsic_matrix holds no principal point; is it row by row?")
    camera = make_camera(str(file), own, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    return check_size(camera, size, str(file))

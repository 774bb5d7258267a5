"""TUM RGB-D: `rgb.txt` and `depth.txt` (`timestamp filename`), `groundtruth.txt` (`timestamp tx ty
tz qx qy qz qw`).

Depth: 16 bits, 5000 units a metre, 0 no reading, registered to colour. Poses: camera-to-world in
metres from motion capture, camera x right, y down, z forward. Colour and depth are paired by time
stamp, one to one, nearest first; the pose is the ground truth nearest to the depth image's stamp.
Intrinsics: the published ones of freiburg1, 2 or 3 if the folder's name says which, else the ROS
default 525 525 319.5 239.5; lens distortion is ignored.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from ..files.frame_files import list_names
from ..files.text_rows import finite_or_none, read_lines
from ..files.trajectories import Pose, read_stamped_poses
from ..geometry.time_stamps import associate, check_max_difference, nearest
from ..types import PinholeCamera
from .depth_camera import check_size
from .file_recording import FrameFiles, Recording, depth_size

DEPTH_SCALE = 5000.0
MAX_DIFFERENCE = 0.02  # [s], the benchmark's
CAMERAS = {  # published calibration of the three Kinects
    "freiburg1": PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3),
    "freiburg2": PinholeCamera(640, 480, 520.9, 521.0, 325.1, 249.7),
    "freiburg3": PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6),
}
ROS_CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
Item = TypeVar("Item")
SENSOR_IN_NAME = re.compile(r"(?:^|[^a-z])fr(?:eiburg)?([123])", re.IGNORECASE)


@dataclass(frozen=True)
class Stamped(Generic[Item]):
    """Something with a time stamp [s]: an image's file or a pose, and the line it stands in."""

    timestamp: float
    line: str
    value: Item


def open_tum(
    path: Path,
    *,
    depth_scale: float | None = None,
    camera: PinholeCamera | None = None,
    drop_alpha: bool = False,
    max_difference: float = MAX_DIFFERENCE,
) -> Recording:
    """The sequence in folder `path`; stamps further apart than `max_difference` [s] do not belong
    together.
    """
    check_max_difference(max_difference)
    missing = {"rgb.txt", "depth.txt"} - set(list_names(path))
    if missing:
        raise DatasetError(
            f"{path}: no {' and no '.join(sorted(missing))} here; a TUM sequence has rgb.txt, depth.txt and "
            "groundtruth.txt"
        )
    warnings: list[str] = []
    depth, color = _paired_images(path, max_difference, warnings)
    truth = path / "groundtruth.txt"
    poses = (
        _poses_for(depth, truth, max_difference, warnings)
        if truth.exists()
        else [None] * len(depth)
    )
    frames = [
        FrameFiles(image.value, partner.value, pose, image.timestamp)
        for image, partner, pose in zip(depth, color, poses, strict=True)
    ]
    return Recording(
        f"tum {path}",
        frames,
        _camera(path, frames, camera, warnings),
        DEPTH_SCALE if depth_scale is None else depth_scale,
        drop_alpha=drop_alpha,
        warnings=warnings,
        no_poses="" if truth.exists() else f"{truth}: no such file",
    )


def _paired_images(
    path: Path, max_difference: float, warnings: list[str]
) -> tuple[list[Stamped[Path]], list[Stamped[Path]]]:
    """Depth images and the colour image of each; what is left out is added to `warnings`."""
    color = _in_time_order(_read_image_list(path / "rgb.txt"), warnings)
    depth = _in_time_order(_read_image_list(path / "depth.txt"), warnings)
    pairs = associate(_stamps(depth), _stamps(color), max_difference)
    if not len(pairs):
        raise DatasetError(
            f"{path}: none of {len(color)} colour and {len(depth)} depth images are within {max_difference} s "
            "of each other; raise max_difference if their clocks differ"
        )
    alone = len(color) - len(pairs), len(depth) - len(pairs)
    if any(alone):
        warnings.append(
            f"{alone[0]} colour and {alone[1]} depth images have no partner within {max_difference} s, left out"
        )
    return [depth[i] for i, _ in pairs], [color[j] for _, j in pairs]


def _read_image_list(file: Path) -> list[Stamped[Path]]:
    images = []
    for number, line in read_lines(file):
        where, words = f"{file}, line {number}", line.split(maxsplit=1)
        timestamp = finite_or_none(words[0])
        if timestamp is None or len(words) < 2:
            raise DatasetError(f"{where}: expected 'timestamp filename', found '{line[:60]}'")
        images.append(Stamped(timestamp, where, file.parent / words[1]))
    if not images:
        raise DatasetError(f"{file}: lists no images")
    return images


def _in_time_order(items: Sequence[Stamped[Item]], warnings: list[str]) -> list[Stamped[Item]]:
    """Sorted by time stamp; of equal stamps the first counts, the others are left out and said."""
    kept: dict[float, Stamped[Item]] = {}
    for item in items:
        kept.setdefault(item.timestamp, item)
    if len(kept) < len(items):
        again = next(item for item in items if kept[item.timestamp] is not item)
        warnings.append(
            f"{again.line}: time stamp {again.timestamp!r} appears again; of equal stamps the first counts "
            f"({len(items) - len(kept)} left out)"
        )
    return sorted(kept.values(), key=lambda item: item.timestamp)


def _stamps(items: Sequence[Stamped[Any]]) -> NDArray[np.float64]:
    return np.array([item.timestamp for item in items])


def _poses_for(
    depth: Sequence[Stamped[Path]], file: Path, max_difference: float, warnings: list[str]
) -> list[Pose]:
    """The ground truth nearest to each depth image, or why there is none."""
    truth = _in_time_order(
        [Stamped(row.timestamp, row.pose.source, row.pose) for row in read_stamped_poses(file)],
        warnings,
    )
    poses = []
    for image, found in zip(depth, nearest(_stamps(truth), _stamps(depth)), strict=True):
        gap = abs(truth[found].timestamp - image.timestamp)
        poses.append(
            truth[found].value
            if gap <= max_difference
            else Pose(
                str(file),
                problem=f"nearest pose to {image.value} is {gap:.3f} s off, more than {max_difference} s",
            )
        )
    return poses


def _camera(
    path: Path, frames: Sequence[FrameFiles], camera: PinholeCamera | None, warnings: list[str]
) -> PinholeCamera:
    size = depth_size(frames)
    if camera is not None:
        return check_size(camera, size, "camera")
    match = SENSOR_IN_NAME.search(path.resolve().name)
    name = f"freiburg{match[1]}" if match else "the ROS default"
    camera = check_size(CAMERAS[name] if match else ROS_CAMERA, size, f"{path}: {name}")
    reason = "from the folder's name" if match else "as the folder's name tells no other"
    warnings.append(
        f"intrinsics assumed: {name} ({camera.fx:g} {camera.fy:g} {camera.cx:g} {camera.cy:g}, distortion ignored) "
        f"{reason}; to give others, use format 'folder' with a camera.yaml, or in Python "
        "camera=PinholeCamera(...)"
    )
    return camera

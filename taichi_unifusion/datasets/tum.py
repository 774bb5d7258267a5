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
from ..files.text_rows import is_stamp, read_lines
from ..files.trajectories import Pose, read_stamped_poses
from ..geometry.time_stamps import (
    LONGEST_DIFFERENCE,
    associate,
    check_max_difference,
    nearest,
    range_of,
    since,
    to_nanoseconds,
    unit_of,
)
from ..types import PinholeCamera
from .depth_camera import Intrinsics, check_size
from .file_recording import FrameFiles, Recording, depth_size
from .pose_rows import are_numbers, said_in_order, say_unit

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
    """Something with a time stamp: an image's file or a pose, and the line it stands in."""

    nanoseconds: int
    line: str
    value: Item

    @property
    def timestamp(self) -> float:
        """The time stamp [s]."""
        return self.nanoseconds / 10**9


def open_tum(
    path: Path,
    *,
    depth_scale: float | None = None,
    camera: PinholeCamera | Intrinsics | None = None,
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
    color = _in_time_order(_read_image_list(path / "rgb.txt", warnings), warnings)
    depth = _in_time_order(_read_image_list(path / "depth.txt", warnings), warnings)
    first = depth[0].nanoseconds
    at_depth, at_color = _stamps(depth, first), _stamps(color, first)
    pairs = associate(at_depth, at_color, max_difference)
    if not len(pairs):
        gap = np.abs(at_color[nearest(at_color, at_depth)] - at_depth).min()
        what = (
            f"raise max_difference to {1.5 * gap:.2g}"
            if 1.5 * gap <= LONGEST_DIFFERENCE
            else "their clocks differ, or they are of two recordings"
        )
        raise DatasetError(
            f"{path}: none of {len(color)} colour and {len(depth)} depth images are within {max_difference} s of "
            f"each other: colour is of {_range(color)} s, depth of {_range(depth)} s, and the nearest two are "
            f"{gap:.3g} s apart; {what}"
        )
    alone = len(color) - len(pairs), len(depth) - len(pairs)
    if any(alone):
        warnings.append(
            f"{alone[0]} colour and {alone[1]} depth images have no partner within {max_difference} s, left out"
        )
    return [depth[i] for i, _ in pairs], [color[j] for _, j in pairs]


def _read_image_list(file: Path, warnings: list[str]) -> list[Stamped[Path]]:
    rows = []
    for number, line in read_lines(file):
        where, words = f"{file}, line {number}", line.split(maxsplit=1)
        if not is_stamp(words[0]) or len(words) < 2:
            raise DatasetError(f"{where}: expected 'timestamp filename', found '{line[:60]}'")
        rows.append((where, *words))
    if not rows:
        raise DatasetError(f"{file}: lists no images")
    unit = unit_of([stamp for _, stamp, _ in rows])
    say_unit(file, unit, warnings)
    return [
        Stamped(to_nanoseconds(stamp, unit), where, file.parent / name)
        for where, stamp, name in rows
    ]


def _range(items: Sequence[Stamped[Any]]) -> str:
    return range_of([item.nanoseconds for item in items])


def _in_time_order(items: Sequence[Stamped[Item]], warnings: list[str]) -> list[Stamped[Item]]:
    """Sorted by time stamp; of equal stamps the first counts, the others are left out and said."""
    kept: dict[int, Stamped[Item]] = {}
    for item in items:
        kept.setdefault(item.nanoseconds, item)
    if len(kept) < len(items):
        again = next(item for item in items if kept[item.nanoseconds] is not item)
        warnings.append(
            f"{again.line}: time stamp {again.timestamp!r} appears again; of equal stamps the first counts "
            f"({len(items) - len(kept)} left out)"
        )
    return sorted(kept.values(), key=lambda item: item.nanoseconds)


def _stamps(items: Sequence[Stamped[Any]], first: int) -> NDArray[np.float64]:
    return since([item.nanoseconds for item in items], first)


def _poses_for(
    depth: Sequence[Stamped[Path]], file: Path, max_difference: float, warnings: list[str]
) -> list[Pose]:
    """The ground truth nearest to each depth image, or why there is none."""
    rows = read_stamped_poses(file)
    say_unit(file, rows[0].unit, warnings)
    truth = _in_time_order(
        [Stamped(row.nanoseconds, row.pose.source, row.pose) for row in rows], warnings
    )
    if are_numbers([image.nanoseconds for image in depth], [row.nanoseconds for row in truth]):
        return _numbered(depth, truth, file, warnings)
    first, poses = depth[0].nanoseconds, []
    at_truth, at_depth = _stamps(truth, first), _stamps(depth, first)
    for image, at, found in zip(depth, at_depth, nearest(at_truth, at_depth), strict=True):
        gap = abs(at_truth[found] - at)
        poses.append(
            truth[found].value
            if gap <= max_difference
            else Pose(
                str(file),
                problem=f"nearest pose to {image.value} is {gap:.3f} s off, more than {max_difference} s",
            )
        )
    return poses


def _numbered(
    depth: Sequence[Stamped[Path]],
    truth: Sequence[Stamped[Pose]],
    file: Path,
    warnings: list[str],
) -> list[Pose]:
    """Poses in the order of the images, where these are numbered instead of timed."""
    if len(depth) != len(truth):
        raise DatasetError(
            f"{file}: its time stamps run from {_range(truth)} s, but the images are numbered, "
            f"{_range(depth)}; write the images' times into depth.txt and rgb.txt, or one pose for each image"
        )
    warnings.append(said_in_order(file, len(truth)))
    return [row.value for row in truth]


def _camera(
    path: Path,
    frames: Sequence[FrameFiles],
    camera: PinholeCamera | Intrinsics | None,
    warnings: list[str],
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
        f"{reason}; to give others: --intrinsics FX,FY,CX,CY, or in Python camera=PinholeCamera(...)"
    )
    return camera

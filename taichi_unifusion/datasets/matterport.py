"""Matterport3D: a scan's folder with `matterport_depth_images/`, `matterport_color_images/`,
`matterport_camera_intrinsics/` and `matterport_camera_poses/`, or all of it in one folder.

Files are `UUID_dC_Y.png` (depth, 16 bits, 4000 units a metre), `UUID_iC_Y.jpg`, `UUID_intrinsics_C.txt`
(`w h fx fy cx cy k1 k2 p1 p2 k3`) and `UUID_pose_C_Y.txt` (4x4, camera to world, metres, camera x right,
y down, z forward), for camera C (0..2) turned to Y (0..5). Lens distortion is undone.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

from ..errors import DatasetError, FrameError
from ..files.frame_files import list_names
from ..files.images import read_color, read_depth
from ..files.text_rows import parse_numbers, read_lines, split_row
from ..files.trajectories import read_pose_file
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .file_recording import check_depth_scale
from .shared_view import SharedView, Shot

DEPTH_SCALE = 4000.0
_DEPTH = re.compile(r"([0-9a-f]{32})_d(\d)_(\d)\.png")


def open_matterport(path: Path, *, depth_scale: float | None = None) -> SharedView:
    """The images in a scan's folder, by place, camera and turn."""
    scale = DEPTH_SCALE if depth_scale is None else check_depth_scale(depth_scale, str(path))
    depth = _folder(path, "depth_images")
    found = [match for name in list_names(depth) if (match := _DEPTH.fullmatch(name))]
    if not found:
        raise DatasetError(f"{depth}: no UUID_dC_Y.png here")
    color, poses, cameras = (
        _folder(path, each) for each in ("color_images", "camera_poses", "camera_intrinsics")
    )
    shots = []
    for match in found:
        uuid, camera, turn = match.groups()
        image = color / f"{uuid}_i{camera}_{turn}.jpg"
        shots.append(
            Shot(
                str(image),
                partial(_lens, cameras / f"{uuid}_intrinsics_{camera}.txt"),
                partial(read_depth, depth / match[0], scale),
                partial(read_color, image),
                pose=read_pose_file(poses / f"{uuid}_pose_{camera}_{turn}.txt"),
            )
        )
    return SharedView(f"matterport {path}", shots)


def _folder(path: Path, kind: str) -> Path:
    """Where files of a kind lie."""
    inner = path / f"matterport_{kind}"
    return inner if inner.is_dir() else path


def _lens(file: Path) -> LensCamera:
    try:
        words = [word for _, line in read_lines(file) for word in split_row(line)]
        numbers = parse_numbers(words, str(file))
        if len(numbers) != 11 or not all(0 < side < 1e5 for side in numbers[:2]):
            raise DatasetError(
                f"{file}: expected w h fx fy cx cy k1 k2 p1 p2 k3, found '{' '.join(words)[:60]}'"
            )
        camera = make_camera(str(file), (int(numbers[0]), int(numbers[1])), *numbers[2:6])
    except DatasetError as error:
        raise FrameError(str(error)) from None
    return LensCamera(camera, (*numbers[6:], 0.0, 0.0, 0.0))

"""ScanNet++, the iPhone's part of a scene: `iphone/` with `rgb.mkv` (or .mp4), `depth.bin` and
`pose_intrinsic_imu.json`.

Colour is a video of 1920x1440. Depth is 256x192 of the same view, for every picture: float32 metres of
all pictures deflated as one, or, picture by picture, a size of 4 bytes and that many of LZ4 (16 bits,
millimetres) or deflate (float32 metres). The JSON file holds, under `frame_NNNNNN`, `aligned_pose` (else
`pose`), 4x4 camera to world in metres, camera x right, y down, z forward, and `intrinsic`, 3x3, of the
video's pictures. Frame N is picture N.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, FrameError
from ..files.depth_stream import DepthStream
from ..files.frame_files import first_existing
from ..files.strict_json import numbers, read_object
from ..files.trajectories import Pose
from ..files.video_reading import VideoPictures
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .shared_view import SharedView, Shot

FILE, DEPTH, VIDEOS = "pose_intrinsic_imu.json", "depth.bin", ("rgb.mkv", "rgb.mp4")
DEPTH_SIZE, PICTURE = (256, 192), (1920, 1440)
_FRAME = re.compile(r"frame_(\d{1,9})")


def open_scannetpp(path: Path, *, color_detail: int = 1) -> SharedView:
    """The frames of a scene's folder, or of its `iphone/`."""
    folder = path / "iphone" if (path / "iphone").is_dir() else path
    for name in (FILE, DEPTH):
        if not (folder / name).exists():
            raise DatasetError(
                f"{folder}: no {name} here; the iPhone's part of a scene has rgb.mkv, {DEPTH} and {FILE}"
            )
    file = folder / FILE
    frames = {
        int(match[1]): each
        for key, each in read_object(file).items()
        if (match := _FRAME.fullmatch(key)) and isinstance(each, dict)
    }
    if not frames:
        raise DatasetError(f"{file}: no frame_NNNNNN in it")
    depth = DepthStream(folder / DEPTH, DEPTH_SIZE)
    video = first_existing(folder / name for name in VIDEOS)
    pictures = VideoPictures(video) if video else None
    warnings = [] if pictures else [f"no {VIDEOS[0]} here, so the frames have no colour"]
    size = pictures.size if pictures else PICTURE
    shots = [
        Shot(
            f"{folder / DEPTH} frame_{i:06}",
            partial(_lens, frames[i], size, f"{file}: frame_{i:06}"),
            partial(depth.read, i),
            partial(pictures.read, i) if pictures else None,
            pose=_pose(frames[i], f"{file}: frame_{i:06}"),
            timestamp=_stamp(frames[i]),
        )
        for i in sorted(frames)
    ]
    return SharedView(f"scannetpp {folder}", shots, detail=color_detail, warnings=warnings)


def _matrix(value: Any, side: int, where: str) -> np.ndarray:
    """A square matrix, as rows or as one list."""
    flat = isinstance(value, list) and len(value) == side * side
    return numbers(value, (side * side,) if flat else (side, side), where).reshape(side, side)


def _pose(frame: Mapping[str, Any], where: str) -> Pose:
    key = "aligned_pose" if "aligned_pose" in frame else "pose"
    try:
        return Pose(where, _matrix(frame.get(key), 4, f"{where}: {key}"))
    except DatasetError as error:
        return Pose(where, problem=str(error).removeprefix(f"{where}: "))


def _lens(frame: Mapping[str, Any], size: tuple[int, int], where: str) -> LensCamera:
    try:
        K = _matrix(frame.get("intrinsic"), 3, f"{where}: intrinsic")
        return LensCamera(make_camera(where, size, K[0, 0], K[1, 1], K[0, 2], K[1, 2]), ())
    except DatasetError as error:
        raise FrameError(str(error)) from None


def _stamp(frame: Mapping[str, Any]) -> float | None:
    stamp = frame.get("timestamp")
    return float(stamp) if isinstance(stamp, int | float) and abs(stamp) < 1e300 else None

"""Polycam's raw data (iPhone and iPad with LiDAR): the folder `keyframes/`.

`images/T.jpg` and `cameras/T.json` (T: microseconds), or, where Polycam has optimised poses,
`corrected_images/` and `corrected_cameras/`, which count then; `depth/T.png`, 16 bits, millimetres,
smaller, of the same view; `confidence/T.png`, 8 bits, 0, 127 or 255, of newer versions. A camera's
file holds `fx fy cx cy width height` and `t_00`..`t_23`, rows of camera to world in metres with
ARKit's axes (y up, z backward), turned to ours. Black borders of corrected images give no colour.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from ..files.frame_files import files_by_stem, in_order
from ..files.images import read_color, read_depth, read_levels
from ..files.strict_json import number, read_object
from ..files.text_rows import finite_or_none
from ..files.trajectories import Pose
from ..geometry.se3 import FLIP_YZ
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .file_recording import check_depth_scale
from .shared_view import ARKIT_UP, Confidence, SharedView, Shot

DEPTH_SCALE = 1000.0
FOLDER = "keyframes"
MICROSECONDS = 1e-6


def open_polycam(
    path: Path,
    *,
    depth_scale: float | None = None,
    min_confidence: int = 1,
    weigh_confidence: bool = False,
    color_detail: int = 1,
) -> SharedView:
    """The key frames in a folder of raw data (or in its `keyframes/`)."""
    confidence = Confidence(min_confidence, weigh_confidence)
    folder = path / FOLDER if (path / FOLDER).is_dir() else path
    scale = DEPTH_SCALE if depth_scale is None else check_depth_scale(depth_scale, str(folder))
    corrected = _files(folder / "corrected_cameras", ".json")
    cameras = corrected or _files(folder / "cameras", ".json")
    if not cameras:
        raise DatasetError(
            f"{folder}: no cameras/T.json and no corrected_cameras/T.json here; export 'raw data' in Polycam"
        )
    prefix = "corrected_" if corrected else ""
    images = _files(folder / f"{prefix}images", ".jpg", ".jpeg", ".png")
    depth, sure = _files(folder / "depth", ".png"), _files(folder / "confidence", ".png")
    stems = [stem for stem in in_order(cameras) if stem in depth]
    if not stems:
        raise DatasetError(
            f"{folder / 'depth'}: no depth image for any of {len(cameras)} cameras; only the LiDAR mode has depth"
        )
    warnings = []
    if len(stems) < len(cameras):
        warnings.append(f"{len(cameras) - len(stems)} cameras without a depth image left out")
    shots = []
    for stem in stems:
        image = images.get(stem) or folder / f"{prefix}images" / f"{stem}.jpg"
        shots.append(_shot(stem, cameras[stem], image, depth[stem], sure.get(stem), scale))
    return SharedView(
        f"polycam {folder}",
        shots,
        confidence=confidence,
        detail=color_detail,
        up=ARKIT_UP,
        warnings=warnings,
        black_border=bool(corrected),
    )


def _files(folder: Path, *suffixes: str) -> dict[str, Path]:
    """Stem -> file in a folder, none where it does not exist."""
    return files_by_stem(folder, suffixes) if folder.is_dir() else {}


def _shot(
    stem: str, camera: Path, image: Path, depth: Path, sure: Path | None, scale: float
) -> Shot:
    """What belongs to a stem; a camera's file that cannot be used costs its own frame only."""
    stamp = finite_or_none(stem)
    try:
        values = read_object(camera)
        pose = _pose(values, str(camera))
    except DatasetError as error:
        values, pose = {}, Pose(str(camera), problem=str(error).removeprefix(f"{camera}: "))
    return Shot(
        str(image),
        partial(_lens, values, str(camera)),
        partial(read_depth, depth, scale),
        partial(read_color, image),
        partial(_confidence, sure) if sure else None,
        pose,
        None if stamp is None else stamp * MICROSECONDS,
    )


def _pose(values: Mapping[str, Any], where: str) -> Pose:
    T = np.eye(4)
    for row in range(3):
        for column in range(4):
            T[row, column] = number(values, f"t_{row}{column}", where)
    return Pose(where, T @ FLIP_YZ)


def _lens(values: Mapping[str, Any], where: str) -> LensCamera:
    try:
        size = int(number(values, "width", where)), int(number(values, "height", where))
        intrinsics = (number(values, key, where) for key in ("fx", "fy", "cx", "cy"))
        return LensCamera(make_camera(where, size, *intrinsics), ())
    except DatasetError as error:
        raise FrameError(str(error)) from None


def _confidence(path: Path) -> NDArray[np.uint8]:
    """0, 127 and 255 as 0, 1 and 2."""
    return ((read_levels(path).astype(np.uint16) + 64) // 128).astype(np.uint8)

"""Hypersim: a scene's folder with `_detail/` and `images/`.

`images/scene_CAM_geometry_hdf5/frame.NNNN.depth_meters.hdf5` is the distance from the camera's centre
along the ray, turned into depth along the axis; colour is `images/scene_CAM_final_preview/
frame.NNNN.tonemap.jpg`. Poses: `_detail/CAM/camera_keyframe_orientations.hdf5` and `_positions.hdf5`,
camera to world with OpenGL's axes (y up, z backward), turned to ours, in asset units, of which
`_detail/metadata_scene.csv` says how many metres they are. The field of view is 60 degrees across; the
few scenes whose cameras are shifted or tilted are not told apart. World: z up. All cameras are read.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from ..files.frame_files import list_names, numbered_files
from ..files.hdf5 import check_hdf5, read_hdf5
from ..files.images import read_color
from ..files.text_rows import finite_or_none, read_lines
from ..files.trajectories import Pose
from ..geometry.se3 import FLIP_YZ
from ..types import PinholeCamera
from .depth_registration import LensCamera
from .shared_view import SharedView, Shot

FIELD_OF_VIEW = np.pi / 3
METRES = "meters_per_asset_unit"


def open_hypersim(path: Path) -> SharedView:
    """The frames of all cameras of a scene."""
    check_hdf5()
    metres = _metres_a_unit(path / "_detail" / "metadata_scene.csv")
    images = path / "images"
    cameras = [
        match[1]
        for name in list_names(images)
        if (match := re.fullmatch(r"scene_(cam_\d+)_geometry_hdf5", name))
    ]
    shots = [shot for camera in cameras for shot in _shots(path, camera, metres)]
    if not shots:
        raise DatasetError(
            f"{images}: no scene_cam_XX_geometry_hdf5/frame.NNNN.depth_meters.hdf5 here"
        )
    return SharedView(f"hypersim {path}", shots, up=(0.0, 0.0, 1.0))


def _metres_a_unit(file: Path) -> float:
    for _, line in read_lines(file):
        name, _, value = line.partition(",")
        metres = finite_or_none(value)
        if name.strip() == METRES and metres is not None and metres > 0:
            return metres
    raise DatasetError(f"{file}: no {METRES} in it")


def _shots(path: Path, camera: str, metres: float) -> list[Shot]:
    folder = path / "images" / f"scene_{camera}_geometry_hdf5"
    found = numbered_files(folder, r"frame\.(\d{1,6})\.depth_meters\.hdf5")
    preview = path / "images" / f"scene_{camera}_final_preview"
    colors = numbered_files(preview, r"frame\.(\d{1,6})\.tonemap\.jpg") if preview.is_dir() else {}
    detail = path / "_detail" / camera
    try:
        R = read_hdf5(detail / "camera_keyframe_orientations.hdf5", (None, 3, 3))
        t = read_hdf5(detail / "camera_keyframe_positions.hdf5", (len(R), 3))
    except FrameError as error:
        raise DatasetError(str(error)) from None
    return [
        Shot(
            str(colors.get(i, found[i])),
            partial(_lens, found[i]),
            partial(_depth, found[i]),
            partial(read_color, colors[i]) if i in colors else None,
            pose=_pose(R, t, i, metres, str(detail)),
        )
        for i in sorted(found)
    ]


def _pose(R: NDArray, t: NDArray, i: int, metres: float, where: str) -> Pose:
    source = f"{where} frame {i}"
    if i >= len(R):
        return Pose(source, problem=f"there are {len(R)} poses only")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R[i], t[i] * metres
    return Pose(source, T @ FLIP_YZ)


def _camera(width: int, height: int) -> PinholeCamera:
    focal = 0.5 * width / np.tan(0.5 * FIELD_OF_VIEW)
    return PinholeCamera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))


def _lens(file: Path) -> LensCamera:
    height, width = read_hdf5(file, (None, None)).shape
    return LensCamera(_camera(width, height), ())


def _depth(file: Path) -> NDArray[np.float32]:
    distance = read_hdf5(file, (None, None))
    depth = distance / np.linalg.norm(_camera(*distance.shape[::-1]).rays(), axis=-1)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)

"""A `transforms.json` with depth: nerfstudio, instant-ngp, NeRFCapture, SplaTAM, and what Polycam,
KIRI, Luma and others export for them.

`frames` holds, for each image, `file_path` (its suffix may be missing), a depth image, and
`transform_matrix`, 4x4, camera to world with OpenGL's axes (y up, z backward), turned to ours;
`applied_transform` and `applied_scale` are undone. Intrinsics, for all images or in each frame:
`fl_x fl_y cx cy w h k1 k2 k3 k4 p1 p2`, or `camera_angle_x`; pixels are counted from the image's
corner, so half a pixel is taken off. `camera_model` is OPENCV, OPENCV_FISHEYE or a pinhole.
Depth: 16-bit PNG or .npy, smaller than the image if of the same shape: `depth_file_path` (nerfstudio:
`depth_unit_scale_factor` metres a unit, 0.001 by default) or `depth_path` (instant-ngp, NeRFCapture:
`integer_depth_scale` metres a unit, without which the option depth_scale is needed).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError, FrameError, shortened
from ..files.frame_files import in_order
from ..files.images import color_file_size, read_color, read_scaled_depth
from ..files.strict_json import list_of, number, read_object
from ..files.transforms import Applied
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .file_recording import check_depth_scale
from .shared_view import SharedView, Shot

FILE = "transforms.json"
METRES_A_UNIT = 1e-3  # nerfstudio's
SUFFIXES = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")  # that a name may lack
FISHEYE = "OPENCV_FISHEYE"
MODELS = ("OPENCV", FISHEYE, "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
CORNER = 0.5  # [pixels] from the image's corner to the centre of its first pixel


def open_nerfstudio(
    path: Path,
    *,
    depth_scale: float | None = None,
    drop_alpha: bool = True,
    color_detail: int = 1,
) -> SharedView:
    """The frames of a `transforms.json`, or of the folder that holds it."""
    file = path / FILE if path.is_dir() else path
    values = read_object(file)
    frames = [each for each in list_of(values, "frames", str(file)) if isinstance(each, dict)]
    with_depth = [each for each in frames if _depth_key(each)]
    if not with_depth:
        raise DatasetError(
            f"{file}: none of its {len(frames)} frames names a depth image (depth_file_path or depth_path)"
        )
    warnings = []
    if len(with_depth) < len(frames):
        warnings.append(f"{len(frames) - len(with_depth)} frames without depth left out")
    applied = Applied(values, str(file))
    names = in_order({str(each.get("file_path")) for each in with_depth})
    order = {name: i for i, name in enumerate(names)}
    with_depth.sort(key=lambda each: order[str(each.get("file_path"))])
    shots = [
        _shot(
            file,
            {**values, **each},
            applied,
            _scale(depth_scale, {**values, **each}, file),
            drop_alpha,
        )
        for each in with_depth
    ]
    return SharedView(f"nerfstudio {file}", shots, detail=color_detail, warnings=warnings)


def _depth_key(frame: Mapping[str, Any]) -> str | None:
    """The key under which a frame names its depth image."""
    return next(
        (key for key in ("depth_file_path", "depth_path") if isinstance(frame.get(key), str)), None
    )


def _scale(given: float | None, frame: Mapping[str, Any], file: Path) -> float:
    """Units of the depth image that make a metre."""
    if given is not None:
        return check_depth_scale(given, str(file))
    if _depth_key(frame) == "depth_file_path":
        metres = number(frame, "depth_unit_scale_factor", str(file), METRES_A_UNIT)
    else:
        metres = number(frame, "integer_depth_scale", str(file), 1.0)
        if metres == 1.0:
            raise DatasetError(
                f"{file}: 'depth_path' without 'integer_depth_scale' does not say what a unit of depth is; give "
                "depth_scale, the units that make a metre"
            )
    if not metres > 0:
        raise DatasetError(f"{file}: a unit of depth cannot be {metres:g} metres")
    return 1.0 / metres


def _shot(
    file: Path, frame: Mapping[str, Any], applied: Applied, depth_scale: float, drop_alpha: bool
) -> Shot:
    name, key = frame.get("file_path"), _depth_key(frame)
    if not isinstance(name, str) or key is None:
        raise DatasetError(f"{file}: 'file_path' must be text, found {shortened(name)}")
    color, depth = _existing(file.parent / name), _existing(file.parent / frame[key])
    stamp = frame.get("timestamp")
    return Shot(
        str(color),
        partial(_lens, frame, color, str(file)),
        partial(read_scaled_depth, depth, depth_scale),
        partial(read_color, color, drop_alpha=drop_alpha),
        None,
        applied.pose_of(frame, f"{file}: {name}"),
        float(stamp) if isinstance(stamp, int | float) and abs(stamp) < 1e300 else None,
    )


def _existing(path: Path) -> Path:
    """The file, or the one whose suffix was left out."""
    try:
        if not path.exists():
            options = (path.with_name(path.name + suffix) for suffix in SUFFIXES)
            return next((each for each in options if each.exists()), path)
    except (OSError, ValueError):  # a name that no file can have
        pass
    return path


def _lens(frame: Mapping[str, Any], color: Path, where: str) -> LensCamera:
    """The camera of an image, pixel centres at whole numbers."""
    try:
        return _checked_lens(frame, color, where)
    except FrameError:
        raise
    except DatasetError as error:
        raise FrameError(str(error)) from None


def _checked_lens(frame: Mapping[str, Any], color: Path, where: str) -> LensCamera:
    model = str(frame.get("camera_model", "OPENCV"))
    if model not in MODELS:
        raise DatasetError(f"{where}: camera_model '{model[:40]}' is none of {', '.join(MODELS)}")
    fisheye = model == FISHEYE or frame.get("is_fisheye") is True
    if "w" in frame and "h" in frame:
        size = int(number(frame, "w", where)), int(number(frame, "h", where))
    else:
        size = color_file_size(color)
    if "fl_x" in frame:
        fx = number(frame, "fl_x", where)
    else:
        angle = number(frame, "camera_angle_x", where)
        if not 0 < angle < np.pi:
            raise DatasetError(f"{where}: camera_angle_x must be within 0 and pi, found {angle:g}")
        fx = 0.5 * size[0] / np.tan(0.5 * angle)
    fy = number(frame, "fl_y", where, fx)
    cx = number(frame, "cx", where, size[0] / 2) - CORNER
    cy = number(frame, "cy", where, size[1] / 2) - CORNER
    k1, k2, k3, k4, p1, p2 = (
        number(frame, key, where, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    distortion = (k1, k2, k3, k4) if fisheye else (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    if not fisheye and k4:
        raise DatasetError(f"{where}: k4 of a lens that is no fisheye is not known; leave it out")
    return LensCamera(make_camera(where, size, fx, fy, cx, cy), distortion, fisheye=fisheye)

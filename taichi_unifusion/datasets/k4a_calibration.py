"""The factory calibration that an Azure Kinect writes into its recordings: intrinsics, distortion
and the pose of its cameras.

Numbers in it are for the whole sensor, lengths as shares of its size; every mode crops or bins the
sensor in its own way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, PoseError
from ..files.json_text import parse_json
from ..types import check_rigid
from .depth_camera import make_camera
from .depth_registration import MAX_RADIUS, LensCamera

DEPTH_MODES = {  # (width, height) of depth images -> size of the binned sensor, first column and row that are kept
    (320, 288): ((512, 512), (96, 90)),  # NFOV 2x2 binned
    (640, 576): ((1024, 1024), (192, 180)),  # NFOV unbinned
    (512, 512): ((512, 512), (0, 0)),  # WFOV 2x2 binned
    (1024, 1024): ((1024, 1024), (0, 0)),  # WFOV unbinned
}
DEPTH_LOCATION, COLOR_LOCATION = "CALIBRATION_CameraLocationD0", "CALIBRATION_CameraLocationPV0"


@dataclass(frozen=True)
class K4aCalibration:
    """Both cameras of a recording, and where they are."""

    depth: LensCamera  # of depth and infrared
    color: LensCamera | None
    T_color_depth: NDArray[np.float64]  # (4, 4) [m]


def read_calibration(
    data: bytes, source: str, depth_size: tuple[int, int], color_size: tuple[int, int] | None
) -> K4aCalibration:
    """The calibration in the bytes of a recording's calibration.json, for images of these sizes
    (width, height) [pixels].

    Raises DatasetError where it is not one, or knows no such mode.
    """
    if depth_size not in DEPTH_MODES:
        raise DatasetError(
            f"{source}: no mode of an Azure Kinect has depth images of {depth_size[0]}x{depth_size[1]}; modes: "
            f"{', '.join(f'{w}x{h}' for w, h in DEPTH_MODES)}"
        )
    try:
        cameras = {
            camera["Location"]: camera
            for camera in parse_json(data)["CalibrationInformation"]["Cameras"]
        }
        depth = _lens(cameras[DEPTH_LOCATION], source, depth_size, *DEPTH_MODES[depth_size])
        color = (
            None
            if color_size is None
            else _lens(cameras[COLOR_LOCATION], source, color_size, *_color_mode(*color_size))
        )
        T_color_depth = np.eye(4)
        T_color_depth[:3, :3] = np.reshape(cameras[COLOR_LOCATION]["Rt"]["Rotation"], (3, 3))
        T_color_depth[:3, 3] = cameras[COLOR_LOCATION]["Rt"]["Translation"]
        return K4aCalibration(depth, color, check_rigid(T_color_depth, f"{source}: T_color_depth"))
    except (KeyError, TypeError, ValueError) as error:  # JSON and Unicode errors are ValueErrors
        if isinstance(error, DatasetError) and not isinstance(error, PoseError):
            raise
        raise DatasetError(
            f"{source}: not the factory calibration of an Azure Kinect ({type(error).__name__}: {error})"
        ) from None


def _color_mode(width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Size of the scaled colour sensor, which is 4:3, and the first column and row that a mode of
    4:3 or 16:9 keeps.
    """
    full = width * 3 // 4
    return (width, full), (0, (full - height) // 2)


def _lens(
    camera: dict,
    source: str,
    size: tuple[int, int],
    sensor: tuple[int, int],
    first: tuple[int, int],
) -> LensCamera:
    """A camera of the file for images of `size`, cut from a sensor of size `sensor` at pixel
    `first`.
    """
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, codx, cody, p2, p1 = map(
        float, camera["Intrinsics"]["ModelParameters"][:14]
    )
    if codx or cody:
        raise DatasetError(
            f"{source}: the centre of distortion lies off the principal point, which is not supported"
        )
    pinhole = make_camera(
        source,
        size,
        fx * sensor[0],
        fy * sensor[1],
        cx * sensor[0] - first[0] - 0.5,
        cy * sensor[1] - first[1] - 0.5,
    )
    return LensCamera(
        pinhole, (k1, k2, p1, p2, k3, k4, k5, k6), float(camera.get("MetricRadius") or MAX_RADIUS)
    )

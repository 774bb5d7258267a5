"""The colour camera of a recording whose images are not registered to depth: what it is, where it
stands beside the depth camera, and how late its images are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ..errors import DatasetError, InputError, SizeMismatch
from ..files.atomic import write_text
from ..files.images import SAME_ASPECT
from ..geometry import se3
from ..geometry.image_view import ColorView
from ..types import Frame, PinholeCamera, check_rigid
from .depth_camera import make_camera
from .depth_registration import LensCamera, color_for_depth
from .fields import convert_fields, read_fields

LENS = 8  # numbers of the distortion model


@dataclass(frozen=True)
class ColorCamera:
    """A colour camera beside a depth camera: X_color = T_color_depth X_depth."""

    pinhole: PinholeCamera  # of the colour images, of their size
    T_color_depth: NDArray[np.float64]  # (4, 4) [m]
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 k3 k4 k5 k6 as OpenCV has them; fewer: then 0
    clock_offset: float = 0.0  # [s] that a colour image was taken after its depth image

    def __post_init__(self) -> None:
        T = check_rigid(self.T_color_depth, "colour camera: T_color_depth")
        object.__setattr__(self, "T_color_depth", T)
        numbers = (*self.distortion, self.clock_offset)
        if len(self.distortion) > LENS or not all(np.isfinite(numbers)):
            raise InputError(
                f"colour camera: distortion is at most {LENS} finite numbers and clock_offset one, got "
                f"{self.distortion} and {self.clock_offset}"
            )

    @property
    def lens(self) -> LensCamera:
        """The camera with its distortion."""
        return LensCamera(self.pinhole, (*self.distortion, *[0.0] * (LENS - len(self.distortion))))

    def register(
        self, frame: Frame, color: NDArray[np.uint8], velocity: NDArray | None, where: str
    ) -> Frame:
        """The frame with this camera's image `color` as its depth camera would see it.

        Its picture is whole; its image "color", RGB in [0, 1], which maps take, is NaN where the
        point of a reading is hidden from this camera, or outside its image.

        `velocity` (6,) is the twist a second of the depth camera in its own frame, [m/s] and
        [rad/s]: it has moved on by the time the colour image is taken. None: it stands still.
        SizeMismatch, naming `where`, for an image of another shape than this camera's.
        """
        height, width = color.shape[:2]
        resized = self.resized(width, height, where)
        T_color_depth = self.T_color_depth
        if velocity is not None:
            T_color_depth = T_color_depth @ se3.exp(-self.clock_offset * velocity)
        whole, seen = color_for_depth(color, resized.lens, frame.depth, frame.camera, T_color_depth)
        known = whole.astype(np.float32)
        known /= np.float32(255)
        known[~seen] = np.nan
        view = ColorView(resized.pinhole, T_color_depth, resized.lens.distortion)
        return replace(frame, color=whole, color_view=view).with_image("color", known)

    def resized(self, width: int, height: int, where: str) -> ColorCamera:
        """The same camera for its images resampled to another size."""
        own = self.pinhole
        if own.size == (width, height):
            return self
        if abs(width * own.height / (height * own.width) - 1) > SAME_ASPECT:
            raise SizeMismatch(
                f"{where}: colour is {width}x{height} but the colour camera is {own.width}x{own.height}, another "
                "shape; give the camera of these images"
            )
        return ColorCamera(
            own.resized(width, height), self.T_color_depth, self.distortion, self.clock_offset
        )

    def to_values(self) -> dict[str, Any]:
        """The camera as plain numbers and lists, the keys of a colour camera's file."""
        camera = self.pinhole
        return {
            "width": camera.width,
            "height": camera.height,
            "fx": float(camera.fx),
            "fy": float(camera.fy),
            "cx": float(camera.cx),
            "cy": float(camera.cy),
            "distortion": [float(k) for k in self.distortion],
            "T_color_depth": self.T_color_depth.tolist(),
            "clock_offset": float(self.clock_offset),
        }

    @classmethod
    def from_values(cls, values: Mapping[str, Any], source: str) -> ColorCamera:
        """The camera that `to_values` gave; DatasetError names the `source` of wrong ones."""
        return _made(convert_fields(ColorCameraFile, dict(values), source), source)


@dataclass(frozen=True)
class ColorCameraFile:
    """The keys of a colour camera's file, their types and their defaults."""

    width: int  # [pixels] of the colour images
    height: int
    fx: float  # [pixels]
    fy: float
    cx: float
    cy: float
    T_color_depth: tuple[tuple[float, ...], ...]  # 4 rows of 4 [m]
    distortion: tuple[float, ...] = field(default=())
    clock_offset: float = 0.0  # [s]


def read_color_camera(path: Path) -> ColorCamera:
    """Read and check a colour camera's file; DatasetError names what is wrong in it."""
    if not path.exists():
        raise DatasetError(
            f"{path}: no such file; a colour camera's file holds width, height, fx, fy, cx, cy and T_color_depth, "
            "see docs/formats.md"
        )
    return _made(read_fields(path, ColorCameraFile), str(path))


def write_color_camera(path: Path, camera: ColorCamera) -> None:
    """Write a file that `read_color_camera` reads back, atomically."""
    write_text(path, yaml.safe_dump(camera.to_values(), sort_keys=False, default_flow_style=None))


def kinect_color_camera() -> ColorCamera:
    """The nominal geometry of a Kinect v1, for images of 640x480 or resampled ones: the colour
    camera 2.5 cm to the right of the depth camera, looking the same way, with a focal length of 525
    pixels (the values that ROS's openni_launch falls back to).
    """
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = -0.025
    return ColorCamera(PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5), T_color_depth)


def _made(values: ColorCameraFile, source: str) -> ColorCamera:
    size = values.width, values.height
    camera = make_camera(source, size, values.fx, values.fy, values.cx, values.cy)
    try:
        T_color_depth = np.array(values.T_color_depth, np.float64)
    except ValueError:  # rows of different lengths
        T_color_depth = np.empty(0)
    if T_color_depth.shape != (4, 4):
        raise DatasetError(f"{source}: T_color_depth must be 4 rows of 4 numbers")
    try:
        return ColorCamera(camera, T_color_depth, values.distortion, values.clock_offset)
    except InputError as error:
        raise DatasetError(f"{source}: {error}") from None
    except DatasetError as error:  # no rotation
        raise DatasetError(f"{source}: {error}") from None

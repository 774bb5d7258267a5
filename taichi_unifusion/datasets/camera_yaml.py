"""`camera.yaml` of a `folder` recording: the depth images' camera, their unit, and where the poses
are. Strict.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import DatasetError
from ..files.images import INVALID_DEPTH
from ..types import PinholeCamera
from .depth_camera import make_camera
from .fields import read_fields


@dataclass(frozen=True)
class CameraFile:
    """The keys of camera.yaml, their types and their defaults."""

    width: int  # [pixels] of the depth images
    height: int
    fx: float  # [pixels]
    fy: float
    cx: float
    cy: float
    # units a metre; None: 1000 of integer depth images, 1 of floats
    depth_scale: float | None = None
    depth_invalid: tuple[int, ...] = INVALID_DEPTH  # units that mean no reading
    poses: str | None = None  # file or folder beside camera.yaml
    body_camera: str | None = None  # file: where the camera sits on the body of EuRoC's poses

    def camera(self, source: str) -> PinholeCamera:
        """The pinhole camera; an impossible one is a DatasetError naming its source."""
        return make_camera(source, (self.width, self.height), self.fx, self.fy, self.cx, self.cy)


def read_camera_yaml(path: Path) -> CameraFile:
    """Read and check the file; DatasetError names the key that is unknown, missing or of another
    type.
    """
    if not path.exists():
        raise DatasetError(
            f"{path}: no such file; it holds width, height, fx, fy, cx, cy of the depth images, "
            "see docs/formats.md"
        )
    return read_fields(path, CameraFile)

"""`camera.yaml` of a `folder` recording: the depth images' camera, their unit, and where the poses
are. Strict.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import get_type_hints

from ..errors import DatasetError, FileError, InputError, convert, did_you_mean
from ..files.images import INVALID_DEPTH
from ..files.strict_yaml import read_yaml
from ..types import PinholeCamera
from .depth_camera import make_camera


@dataclass(frozen=True)
class CameraFile:
    """The keys of camera.yaml, their types and their defaults."""

    width: int  # [pixels] of the depth images
    height: int
    fx: float  # [pixels]
    fy: float
    cx: float
    cy: float
    depth_scale: float = 1000.0  # units a metre of integer depth images
    depth_invalid: tuple[int, ...] = INVALID_DEPTH  # units that mean no reading
    poses: str | None = None  # file or folder beside camera.yaml

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
    types, required = get_type_hints(CameraFile), _required_keys()
    try:
        values = read_yaml(path)
        if not isinstance(values, dict):
            raise DatasetError(f"{path}: expected lines of the form 'fx: 525.0'")
        for key in values:
            if key not in types:
                raise DatasetError(
                    f"{path}: unknown key '{str(key)[:40]}'{did_you_mean(key, types)} "
                    f"(keys: {', '.join(types)})"
                )
        missing = [key for key in required if key not in values]
        if missing:
            raise DatasetError(f"{path}: no {', '.join(missing)} in it")
        return CameraFile(
            **{key: convert(value, types[key], f"{path}: {key}") for key, value in values.items()}
        )
    except (FileError, InputError) as error:
        raise DatasetError(str(error)) from None


def _required_keys() -> list[str]:
    return [field.name for field in fields(CameraFile) if field.default is MISSING]

"""Depth in EXR files, through OpenEXR: one channel of floats, in metres."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, MissingDependency
from .image_headers import MAX_PIXELS

MAGIC = b"v/1\x01"
DEPTH_CHANNELS = ("R", "Y", "Z")  # the first of them that a file has


def check_exr() -> None:
    """Raise MissingDependency without OpenEXR."""
    try:
        import OpenEXR  # noqa: F401
    except ImportError:
        raise MissingDependency(
            "EXR files are read with OpenEXR; run: pip install 'taichi-unifusion[phone]'"
        ) from None


def read_exr_depth(path: Path) -> NDArray[np.float32]:
    """The depth image at `path` as (H, W) metres, 0 where there is no reading."""
    import OpenEXR

    try:
        with open(path, "rb") as file:
            start = file.read(4)
    except OSError as error:
        raise FrameError(f"{path}: cannot be read ({error.strerror})") from None
    if start != MAGIC:
        raise FrameError(f"{path}: not an EXR file")
    try:
        with OpenEXR.File(os.fspath(path), header_only=True) as file:
            _check_size(file.header(), path)
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = file.channels()
            name = next((name for name in DEPTH_CHANNELS if name in channels), None)
            if name is None:
                raise FrameError(
                    f"{path}: has channels {', '.join(channels)}, expected one named R, Y or Z"
                )
            depth = np.array(channels[name].pixels, np.float32)
    except FrameError:
        raise
    except Exception as error:  # noqa: BLE001 - its errors have no type of their own
        raise FrameError(f"{path}: the EXR file is damaged ({str(error)[:80]})") from None
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _check_size(header: dict, path: Path) -> None:
    low, high = header["dataWindow"]
    width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise FrameError(
            f"{path}: the header says {width}x{height} pixels, refused (at most {MAX_PIXELS})"
        )

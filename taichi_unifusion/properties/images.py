"""Images: property images computed before, by any program, one file a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from ..files.frame_files import FrameFolder, files_by_stem
from ..files.images import read_values
from ..rendering.look import Look
from ..types import Frame
from .base import SurfaceProperty

SUFFIXES = (".npy", ".png", ".jpg", ".jpeg")
VOXEL_SIZE = 0.05  # [m] of what nothing is known of


def folder_images(
    file: Path, *, colormap: str = "viridis", low: float | None = None, high: float | None = None
) -> SurfaceProperty:
    """The images in folder `file`: `.npy`, (H, W) or (H, W, c) numbers, or 8-bit and 16-bit
    pictures, taken as [0, 1].

    A frame's image bears its name (`000017.npy` for `000017.png`) or its number (`17.npy` for
    `frame-000017.depth.png`). All have the channels of the first. Values from `low` to `high` are
    coloured; without these, where most lie.
    """
    files = files_by_stem(file, SUFFIXES)
    if not files:
        raise InputError(f"{file}: no *{', *'.join(SUFFIXES)} here")
    folder = FrameFolder(file, files)
    channels = read_values(next(iter(files.values()))).shape[2]
    if (low is None) != (high is None):
        raise InputError("images: give both low and high, or none of them")

    def function(frame: Frame) -> NDArray[np.float32]:
        path = folder.file_of(frame.name, frame.index)
        if path is None:
            raise FrameError(f"{file} holds no image of that name or number")
        values = read_values(path)
        if values.shape != (*frame.depth.shape, channels):
            raise FrameError(
                f"{path}: is {values.shape}, but the frame needs {(*frame.depth.shape, channels)}"
            )
        return values

    look = Look(colormap, None if low is None or high is None else (low, high), file.name)
    return SurfaceProperty("images", channels, function, look, voxel_size=VOXEL_SIZE)

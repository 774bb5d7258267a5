"""Images: property images computed before, by any program, one file a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..datasets.depth_registration import LensCamera, values_for_depth
from ..errors import FrameError, InputError, check_choice
from ..files.frame_files import FrameFolder, files_by_stem
from ..files.images import read_values
from ..geometry.image_view import ColorView
from ..rendering.look import Look
from ..types import Frame
from .base import SurfaceProperty

SUFFIXES = (".npy", ".png", ".jpg", ".jpeg")
VOXEL_SIZE = 0.05  # [m] of what nothing is known of


def folder_images(
    file: Path,
    *,
    of: Literal["depth", "color"] = "depth",
    colormap: str = "viridis",
    low: float | None = None,
    high: float | None = None,
) -> SurfaceProperty:
    """The images in folder `file`: `.npy`, (H, W) or (H, W, c) numbers, or 8-bit and 16-bit
    pictures, taken as [0, 1].

    A frame's image bears its name (`000017.npy` for `000017.png`) or its number (`17.npy` for
    `frame-000017.depth.png`). All have the channels of the first. They have the pixels of the depth
    images; `of` "color" says that they were made of colour images as recorded, which are registered to
    depth: then so are they. Values from `low` to `high` are
    coloured; without these, where most lie.
    """
    files = files_by_stem(file, SUFFIXES)
    if not files:
        raise InputError(f"{file}: no *{', *'.join(SUFFIXES)} here")
    folder = FrameFolder(file, files)
    channels = read_values(next(iter(files.values()))).shape[2]
    check_choice("images: of", of, ("depth", "color"))
    if (low is None) != (high is None):
        raise InputError("images: give both low and high, or none of them")

    def function(frame: Frame) -> NDArray[np.float32]:
        path = folder.file_of(frame.name, frame.index)
        if path is None:
            raise FrameError(f"{file} holds no image of that name or number")
        values = read_values(path)
        if of == "color" and frame.color_view is not None:
            values = _registered(values, frame, frame.color_view)
        if values.shape != (*frame.depth.shape, channels):
            raise FrameError(
                f"{path}: is {values.shape}, but the frame needs {(*frame.depth.shape, channels)}"
            )
        return values

    look = Look(colormap, None if low is None or high is None else (low, high), file.name)
    return SurfaceProperty("images", channels, function, look, voxel_size=VOXEL_SIZE)


def _registered(values: NDArray[np.float32], frame: Frame, view: ColorView) -> NDArray[np.float32]:
    """An image of the colour camera as the depth camera would see it."""
    lens = LensCamera(view.camera.resized(values.shape[1], values.shape[0]), view.distortion)
    return values_for_depth(values, lens, frame.depth, frame.camera, view.T_color_depth)

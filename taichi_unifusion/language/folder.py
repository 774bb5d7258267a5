"""Features computed before, by any program: one file a frame, read in strips and made small on the
way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FrameError, InputError, check_choice
from ..files.arrays import open_planes
from ..files.frame_files import FrameFolder, files_by_stem
from ..networks.encoders import unit_length
from ..types import Frame

SUFFIXES = (".npy", ".npz", ".pt")
LONGEST_SIDE = 96  # pixels of a feature image; more only repeats what the networks made
# of image-text networks, to tell (h, w, c) from (c, h, w)
USUAL_CHANNELS = (512, 640, 768, 1024, 1152, 1280)
MAX_SIDE, MAX_CHANNELS = 16384, 8192
SAME_ASPECT = 0.1  # relative difference, besides a pixel of rounding


@dataclass(frozen=True)
class FolderFeatures:
    """Features of frames by the frame's file name, or by its number; made of colour images as they were
    `recorded`, or as they were registered to depth.
    """

    name: str
    files: FrameFolder
    layout: Literal["auto", "hwc", "chw"] = "auto"
    recorded: bool = True

    def image_features(self, frame: Frame) -> NDArray[np.float32]:
        """(h, w, c) unit length, no larger than LONGEST_SIDE; raises FrameError where there is no
        file or it is damaged.
        """
        path = self.files.file_of(frame.name, frame.index)
        if path is None:
            raise FrameError(f"{self.name}: has no features for {frame.label}")
        view = frame.color_view if self.recorded else None
        width, height = (frame.camera if view is None else view.camera).size
        try:
            return unit_length(read_features(path, self.layout, width / height))
        except (FileError, InputError) as error:
            raise FrameError(str(error)) from error


def folder_features(
    folder: str | Path,
    *,
    layout: Literal["auto", "hwc", "chw"] = "auto",
    images: Literal["recorded", "registered"] = "recorded",
) -> FolderFeatures:
    """The feature files in a folder, of colour images as they were recorded or as they were registered to
    depth; raises FileError where there are none.
    """
    folder = Path(folder)
    check_choice("layout", layout, ("auto", "hwc", "chw"))
    check_choice("images", images, ("recorded", "registered"))
    if not folder.is_dir():
        raise FileError(f"{folder}: no such folder")
    files = files_by_stem(folder, SUFFIXES)
    if not files:
        raise FileError(f"{folder}: no *{', *'.join(SUFFIXES)} here")
    return FolderFeatures(str(folder), FrameFolder(folder, files), layout, images == "recorded")


def read_features(
    path: Path, layout: str = "auto", aspect: float | None = None
) -> NDArray[np.float32]:
    """Mean features (h, w, c) of the blocks of a stored array (H, W, c) or (c, H, W); at no time is
    all of it in memory. `aspect` of the image that they were made of, width by height, tells "auto"
    which of both it is.

    Raises FileError where the file is missing, damaged or would run code, InputError where it holds
    something else.
    """
    with open_planes(path) as (shape, planes):
        if len(shape) == 4 and shape[0] == 1:
            raise InputError(f"{path}: has a batch axis, shape {shape}; save the one image alone")
        if len(shape) != 3 or not all(0 < n <= MAX_SIDE for n in shape):
            raise InputError(f"{path}: features must be (H, W, c) or (c, H, W), got {shape}")
        if layout == "auto":
            layout = _layout_of(shape, aspect)
        height, width, channels = shape if layout == "hwc" else (*shape[1:], shape[0])
        if channels > MAX_CHANNELS:
            raise InputError(
                f"{path}: {channels} channels; is the layout another one than {layout}?"
            )
        block = -(-max(height, width) // LONGEST_SIDE)
        h, w = max(height // block, 1), max(width // block, 1)
        small = np.zeros((h, w, channels), np.float32)
        if layout == "chw":
            for c, plane in enumerate(planes):
                small[..., c] = _block_mean(_block_mean(plane, h).T, w).T
            return small
        rows = []
        for i, plane in enumerate(planes):  # strips of `block` rows
            rows.append(_block_mean(plane, w))
            first = min(i * h // height, h - 1)
            if i == height - 1 or min((i + 1) * h // height, h - 1) != first:
                small[first] = np.mean(rows, axis=0)
                rows = []
        return small


def _layout_of(shape: Sequence[int], aspect: float | None) -> Literal["hwc", "chw"]:
    """The order of height, width and channels in which an array has the shape of its image, or of a
    square that it was made to; where that does not tell, the one whose channels are usual.
    """
    for wanted in (aspect, 1.0):
        hwc, chw = (_has_aspect(h, w, wanted) for h, w in (shape[:2], shape[1:]))
        if hwc != chw:
            return "hwc" if hwc else "chw"
    return "chw" if shape[0] in USUAL_CHANNELS and shape[2] not in USUAL_CHANNELS else "hwc"


def _has_aspect(height: int, width: int, aspect: float | None) -> bool:
    return aspect is not None and abs(width - aspect * height) <= max(1, SAME_ASPECT * width)


def _block_mean(values: NDArray, count: int) -> NDArray[np.float32]:
    """Means over `count` runs of rows of (n, ...)."""
    starts = np.arange(count) * len(values) // count
    sums = np.add.reduceat(values.astype(np.float32), starts, axis=0)
    lengths = np.diff(np.append(starts, len(values))).astype(np.float32)
    return (sums / lengths.reshape(-1, *[1] * (values.ndim - 1))).astype(np.float32, copy=False)
